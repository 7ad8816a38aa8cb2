"""The import rules of the layers (pyproject.toml, importlinter) hold."""

import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest
from import_graph import FILES, folder_of, imports, knots

ROOT = Path(__file__).parent.parent


def test_imports_follow_the_layers():
    # In a process of its own: within this one it would disable the loggers of all tests that follow.
    command = Path(sys.executable).with_name("lint-imports"), "--no-cache"
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stdout + process.stderr
    assert "Contracts: 2 kept, 0 broken" in process.stdout


def test_every_folder_is_under_the_rule():
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    assert packages == {name.removeprefix("mirrorskin.") for layer in layers for name in layer.split(" | ")}


def test_no_modules_import_each_other():
    assert knots(imports()) == []


def test_no_packages_import_each_other():
    pairs = {(folder_of(module), folder_of(other)) for module, other in imports()}
    assert knots((name, other) for name, other in pairs if name != other) == []


@pytest.mark.parametrize(
    ("pairs", "groups"),
    [
        ({("a", "b"), ("b", "c")}, []),
        ({("a", "b"), ("b", "c"), ("c", "a"), ("d", "a")}, [{"a", "b", "c"}]),
        ({("a", "b"), ("b", "a"), ("c", "d"), ("d", "c")}, [{"a", "b"}, {"c", "d"}]),
    ],
    ids=["none", "three", "two pairs"],
)
def test_knots_are_found(pairs, groups):
    assert sorted(knots(pairs), key=min) == groups


@pytest.mark.parametrize(
    "pair",
    [
        ("mirrorskin.engine.base.reconstruction", "mirrorskin.io.storage.calibration_file"),
        ("mirrorskin.io.files.result_file", "mirrorskin.io.files.zarr_export"),  # in a function
        ("mirrorskin.engine.press.press", "mirrorskin.engine.base.method"),
    ],
    ids=["by a public name", "in a function", "at the top"],
)
def test_imports_are_found(pair):
    assert pair in imports()


def test_no_folder_has_more_than_20_modules():
    modules = [folder_of(module) for module, file in FILES.items() if file.stem != "__init__"]
    counts = Counter(folder for folder in modules if folder != "cli/commands")  # a module for each command
    assert {folder: count for folder, count in counts.items() if count > 20} == {}


SMALL = {
    "engine/base/errors.py": "other packages import it alone",
    "evaluation/base/object_store.py": "tests and benchmarks start the same server",
    "hw/base/errors.py": "other packages import it alone",
    "kernels/array_types.py": "all references import it alone",
    "kernels/bitcode.py": "the one place that knows how PoCL keeps programs",
    "kernels/errors.py": "other packages import it alone",
    "kernels/layout.py": "tests choose a layout without the device",
    "kernels/optical/fringes.py": "it belongs to fringes.cl",
}
"""Why a module has less than 40 lines; a command may."""


def test_small_modules_have_a_reason():
    files = [file for file in FILES.values() if file.stem != "__init__" and file.parent.name != "commands"]
    lines = {file.relative_to(ROOT).as_posix(): len(file.read_text().splitlines()) for file in files}
    assert {name for name, count in lines.items() if count < 40} == SMALL.keys()


IMPORT = re.compile(r"^\s*(?:from|import) (?:mirrorskin\.)?(bench|evaluation|examples|tests)\b", re.MULTILINE)


def development_imports(folder):
    """Return which of the folders for developers each file of a folder imports."""
    files = {file.relative_to(ROOT): file.read_text(encoding="utf-8") for file in folder.rglob("*.py")}
    return {file.as_posix(): set(IMPORT.findall(text)) for file, text in files.items() if IMPORT.search(text)}


def test_the_product_imports_no_development_tool():
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"bench", "evaluation"}
    assert [development_imports(ROOT / package) for package in packages] == [{}] * len(packages)


def test_only_tests_of_the_benchmark_import_it():
    modules = development_imports(ROOT / "tests")
    assert [
        file for file in modules if "bench" in modules[file] and not file.startswith("tests/bench/")
    ] == []
    assert set().union(*modules.values()) == {"bench", "evaluation"}


def test_the_package_has_its_parts_and_its_version():
    import mirrorskin

    assert mirrorskin.__version__ == importlib.metadata.version("mirrorskin")
    assert callable(mirrorskin.engine.reconstruct)
    assert {"engine", "hw", "io", "twin", "view"} <= set(dir(mirrorskin))
    with pytest.raises(AttributeError, match="nothing"):
        _ = mirrorskin.nothing
