"""Promises of docs/security.md that no other test checks."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
from commands import done, run
from traps import Trap

from mirrorskin import io

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
PROMISES = [line for line in PAGE.splitlines() if line.startswith("| ") and line != "| Promise | Test |"]
NAMED = re.findall(r"`(tests/[^`\s]+)::(\w+)`", PAGE)
PLACES = ("--motion", "vertical", "--travel-step", "0.1mm", "-o", "out.h5")
PRESS = ("simulate", "vertical", "--size", "8x8", "--frames", "2", "-o", "out.h5")
MARKUP = "<script>alert(1)</script>"


def test_every_promise_has_a_test():
    assert all("| `tests/" in line for line in PROMISES)
    assert len(PROMISES) >= 14
    assert all(f"def {test}(" in (ROOT / file).read_text(encoding="utf-8") for file, test in NAMED)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("frames.npy", ("import", "{}", *PLACES)),
        ("frames.npz", ("import", "{}", *PLACES)),
        ("travel.npy", ("reconstruct", "sound.npy", "-o", "out.h5", "--travel", "{}")),
        ("heights.npy", (*PRESS, "--object", "{}")),
    ],
)
def test_no_pickle_of_an_array_is_decoded(name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("sound.npy", np.zeros((4, 8, 8), np.uint8))
    trap = np.array([Trap(tmp_path / "run")], dtype=object)
    np.savez(name, frames=trap) if name.endswith("z") else np.save(name, trap)
    ended = run(*(name if word == "{}" else word for word in words))
    assert (ended.code, ended.said.count("\n"), Path("run").exists()) == (2, 1, False)


STARTED = """
import contextlib, sys
from mirrorskin.cli.main import main

for line in sys.stdin:
    sys.argv = ["mirrorskin", *line.split()]
    with contextlib.suppress(SystemExit):
        main()
"""
IN_ONE_PROCESS = """
run mirrorskin.engine:ChangePoint press.h5 -o points.h5
run fractions:Fraction press.h5
run mine.py:Mine press.h5
reconstruct press.h5 -o result.h5
report result.h5 -o page.html
view result.h5 -o maps.png
export result.h5 -o heights.tif
export result.h5 -o surface.ply
measure result.h5
simulate axial --size 8x8 -o turn.h5
reconstruct turn.h5 -o turned.h5
app nothing.h5
twin serve -o press.h5
doctor
"""
OWN = """
from mirrorskin import engine

class Mine(engine.Onset):
    pass
"""


@pytest.fixture
def strange_folder(tmp_path, monkeypatch):
    """The working folder, with a module of each name that may be imported, which leaves a file."""
    monkeypatch.chdir(tmp_path)
    done("simulate vertical --size 48x48 --pixel-size 0.2mm --frames 16 --travel-step 0.1mm -o press.h5")
    for name in {*packages_distributions(), *sys.stdlib_module_names, "cupy", "torch", "sitecustomize"}:
        Path(f"{name}.py").write_text("open(f'{__file__}.run', 'w').close()")
    Path("mine.py").write_text(OWN)
    Path("matplotlibrc").write_text("text.usetex: True")  # runs LaTeX
    return tmp_path


@pytest.mark.parametrize(
    "lines",
    [IN_ONE_PROCESS, pytest.param("batch press.h5 --workers 1 -o out", marks=pytest.mark.slow)],
    ids=["one process", "workers"],
)
def test_no_module_of_the_current_folder_runs(strange_folder, tmp_path_factory, lines):
    program = tmp_path_factory.mktemp("bin") / "program.py"
    program.write_text(STARTED)
    ended = subprocess.run(
        [sys.executable, program], input=lines.strip(), capture_output=True, text=True, cwd=strange_folder
    )
    assert [path.name for path in strange_folder.glob("*.run")] == []
    assert "Traceback" not in ended.stderr
    if "--workers" in lines:
        assert list(strange_folder.glob("out/*.h5"))
    else:
        assert {"points.h5", "press-Mine.h5", "maps.png", "surface.ply"} <= {
            path.name for path in strange_folder.iterdir()
        }


def test_texts_are_not_markup_in_a_notebook():
    units = io.Map(MARKUP, MARKUP, "float32", "pixels")
    result = io.Result(
        height=np.zeros((8, 8), np.float32),
        own=np.zeros((8, 8), np.float32),
        process={"source": MARKUP},
        declarations={"own": units},
    )
    assert "<script" not in result._repr_html_()
