# make [demo|test|test-all|test-older|test-lowest|test-browser|test-cameras|test-hardware|docs|package|lint|types|fuzz|bench|bench-check|accuracy|portability|gpu-check|gpu|gpu-wheels|clean]; each installs what it needs in .venv first.
# PYTHON=/path/to/python3.12 chooses the interpreter (3.11 or newer).

SHELL := /bin/sh
.SHELLFLAGS := -ec
.ONESHELL:
.PHONY: demo test test-all test-older test-lowest test-browser test-cameras test-hardware docs package lint types fuzz bench bench-check accuracy portability gpu-check gpu gpu-wheels clean

PYTHON ?= $(shell for python in python3.13 python3.12 python3.11 python3; do \
	"$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$$python" && break; done)
PACKAGES := $(patsubst %/__init__.py,%,$(wildcard */__init__.py))
MODULES := $(filter-out setup.py,$(wildcard *.py)) py.typed $(PACKAGES)
BIN := .venv/bin
DEMO := .venv/.demo
READY := .venv/.ready
TESTS := -m pytest --numprocesses auto --dist loadfile --ignore tests/browser
PYTEST := $(BIN)/python $(TESTS)
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# Modules are compiled when they are imported, which few are, or here where Python must not write what it compiles.
# setuptools warns of every editable installation.
COMPILE := $(if $(PYTHONDONTWRITEBYTECODE),--compile,--no-compile)
INSTALL := PYTHONWARNINGS=ignore $(PIP) install $(COMPILE) --editable
LOWEST := build/lowest
# mypy and editors do not follow an editable install; they do follow links.
define LINK
site=$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
mkdir -p "$$site/mirrorskin"
for name in $(MODULES); do ln -sfn "$$PWD/$$name" "$$site/mirrorskin/$$name"; done
endef

demo: $(DEMO)
	@$(BIN)/mirrorskin demo -o demo --overwrite

# A process for each core, each with files of its own. Types are checked meanwhile.
test: lint
	@$(MAKE) --no-print-directory types & types=$$!
	$(PYTEST) -m 'not slow'
	wait $$types

# What 'make test' leaves out: a few captures in real time, with nothing beside them; the second work shape of
# every device, statistics over many draws, recordings of full size, batches that are killed, older processors, the
# documentation, and reports in a real browser.
test-all: $(READY)
	@$(BIN)/python -m pytest --ignore tests/browser -m 'slow and real_time'
	$(PYTEST) -m 'slow and not real_time'
	$(MAKE) --no-print-directory test-older docs package test-browser

# Golden results, the contract of operations, and kernels against their references, with the instructions of an older
# PROCESSOR only, whose floats have other last bits.
PROCESSOR ?= haswell sandybridge
test-older: $(READY)
	@for processor in $(PROCESSOR); do
		$(BIN)/python evaluation/portability/older_processor.py $$processor $(TESTS) -m 'not slow' \
		    tests/golden tests/engine/test_contract.py tests/kernels/test_references.py
	done

# Each command with the lowest versions of all dependencies that pyproject.toml allows, from the package index, in
# an environment of their own; it needs Python 3.11.
test-lowest: $(READY)
	@$(PIP) install uv
	mkdir -p $(LOWEST)
	uv() { $(BIN)/python -m uv --quiet --no-python-downloads "$$@"; }
	uv pip compile --resolution lowest-direct --python-version 3.11 --output-file $(LOWEST)/requirements.txt \
	    $(addprefix --extra ,app cluster live mcap mesh metrology s3 video view xarray zarr) pyproject.toml
	uv venv --clear --python 3.11 $(LOWEST)/venv
	uv pip install --python $(LOWEST)/venv --requirement $(LOWEST)/requirements.txt pytest
	uv pip install --python $(LOWEST)/venv --no-deps --editable .
	uv pip list --python $(LOWEST)/venv
	$(LOWEST)/venv/bin/python -m pytest tests/test_smoke.py

# Pages in a real browser, which the system brings: Debian's package chromium.
test-browser: .venv/.browser
	@$(BIN)/python -m pytest tests/browser

# The rig before GRBL's own firmware, the program GRBL; docs/rig.md tells how it is built.
test-hardware: $(READY)
	@test -x "$(GRBL)" || { echo 'make test-hardware GRBL=PATH: PATH must be a program (docs/rig.md)' >&2; exit 1; }
	GRBL="$(realpath $(GRBL))" $(BIN)/python -m pytest tests/hw/stages/test_transcript.py tests/hw/rig/test_faults.py tests/hw/stages/test_grbl_emulated.py
	PYTHONPATH=tests/support $(BIN)/python tests/support/rig_faults.py "$(realpath $(GRBL))"

# Aravis' fake cameras by GigE Vision; docs/camera.md tells what the system must bring.
test-cameras: .venv/.genicam
	@$(BIN)/python -m pytest tests/hw/cameras/test_genicam.py

# The site, in site/; warnings are errors.
docs: .venv/.docs
	@(cd tests && MYPYPATH=../docs/site ../$(BIN)/mypy --strict --no-error-summary --config-file ../pyproject.toml -m hooks -m declared_options -m option_tables)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The distribution packages, in dist/; the wheel is tried in an environment of its own, outside of this folder.
package: .venv/.package
	@rm -rf dist build/package build/lib
	$(BIN)/python -m build --quiet --outdir dist
	$(BIN)/twine check --strict dist/*
	"$$($(BIN)/python -c 'import sys; print(sys._base_executable)')" -m venv build/package
	cd build/package
	bin/python -m pip --disable-pip-version-check --quiet install "$$(echo ../../dist/*.whl)[view]"
	bin/mirrorskin sample press -o press.h5
	bin/mirrorskin reconstruct press.h5
	bin/mirrorskin score press-result.h5 --truth press.h5
	bin/mirrorskin report press-result.h5 -o press.html

lint: $(READY)
	@$(BIN)/ruff check --quiet
	$(BIN)/ruff format --check --diff --quiet

# From tests: at the top, mypy takes our io for the standard library's.
types: $(READY)
	@$(LINK)
	cd tests
	../$(BIN)/mypy --strict --no-error-summary --config-file ../pyproject.toml $(PACKAGES:%=-p mirrorskin.%)

# Damaged files and replies, MINUTES of them; what is neither read nor refused in one line is kept.
MINUTES ?= 60
SEED ?= 0
fuzz: $(READY)
	@$(BIN)/python tests/fuzz/fuzz.py --minutes $(MINUTES) --seed $(SEED)

# The suite of the developers; 'mirrorskin bench' rates a device in half a minute.
bench: $(READY)
	@$(BIN)/python bench/run.py run

# Fails if a function takes more than twice as long as in the stored run, relative to what a user would write instead.
bench-check: $(READY)
	@$(BIN)/python -m pip install --quiet 'numba>=0.61'
	@$(BIN)/python bench/run.py check bench/results/peers-xeon-2-cores.json

# The tables of docs/accuracy.md, from stored results; MEASURE='normals ramps' measures these first.
accuracy: $(READY)
	@$(BIN)/python evaluation/accuracy.py $(MEASURE)

portability: $(READY)
	@$(BIN)/python evaluation/portability/portability.py

# What calls and kernels would have a GPU do that is not here: launches, waits and copies; then registers, for which
# clang and libclc come from the system, ptxas from the package index.
gpu-check: .venv/.ptxas
	@$(BIN)/python evaluation/portability/gpu_counts.py
	$(BIN)/python evaluation/portability/gpu_check.py

# With a GPU: copies, whole calls, answers and device tests, in gpu.json and gpu.md.
gpu: $(READY)
	@$(BIN)/python evaluation/portability/gpu.py

# Wheels for a machine with a GPU and without network: carry the checkout there, and run
# 'evaluation/portability/gpu.sh build/gpu-wheels'. VERSION is that machine's Python.
VERSION ?= 3.12
gpu-wheels: $(READY)
	@rm -rf build/gpu-wheels build/lib build/bdist.*  # what lies there would be part of the wheel
	$(PIP) wheel --no-deps --wheel-dir build/gpu-wheels .
	$(PIP) download --no-deps --only-binary=:all: --dest build/gpu-wheels --python-version $(VERSION) \
	    $(patsubst %,--platform manylinux%_x86_64,2014 _2_17 _2_27 _2_28 _2_34) click isal lazy_loader \
	    msgspec platformdirs pyopencl pyserial pytools siphash24 tifffile typing_extensions

clean:
	@rm -rf .venv build site dist *.egg-info .hypothesis .import_linter_cache
	find . -name .git -prune -o -type d \( -name __pycache__ -o -name '.*_cache' \) -prune -exec rm -rf {} +

# The stamp is written last, so a half-made environment never passes for done.
$(DEMO): pyproject.toml
	@trap '[ $$? = 0 ] || rm -rf .venv' EXIT
	# The interpreter below any active environment, which may be the one that is rebuilt here.
	python=$$("$(PYTHON)" -c 'import sys; assert sys.version_info >= (3, 11); print(sys._base_executable)' \
	    2>/dev/null) || {
	    echo 'make: Python 3.11 or newer is needed; install it, or name it: make PYTHON=/path/to/python3' >&2
	    exit 1
	}
	rm -rf .venv
	if "$$python" -c 'import ensurepip, venv' 2>/dev/null; then "$$python" -m venv .venv
	elif command -v uv >/dev/null; then uv venv --quiet --seed --python "$$python" .venv
	elif command -v virtualenv >/dev/null; then virtualenv --quiet --python "$$python" .venv
	else
	    echo "make: $$python cannot make environments; install Debian's python3-venv, or uv, or virtualenv" >&2
	    exit 1
	fi
	echo 'installing what the demo needs in .venv (once, half a minute)'
	$(INSTALL) '.[view]'
	$(BIN)/mirrorskin devices >/dev/null || {
	    echo 'adding a linker for OpenCL kernels: this machine has none that works (100 MB)'
	    $(INSTALL) '.[linker]'
	}
	$(if $(PYTHONDONTWRITEBYTECODE),$(BIN)/python -m compileall -q $(PACKAGES))
	touch $@

$(READY): $(DEMO)
	@echo 'adding to .venv what tests and checks need (once, a minute or two)'
	$(INSTALL) '.[dev]'
	$(LINK)
	touch $@

# What only some need comes with the first of them.
.venv/.browser .venv/.docs .venv/.genicam .venv/.package .venv/.ptxas: $(READY)
	@$(INSTALL) '.[$(@F:.%=%)]'
	touch $@
