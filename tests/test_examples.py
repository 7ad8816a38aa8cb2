"""The examples in docstrings run, with the printed output; those of the folder of examples run."""

import doctest
import importlib
import inspect
import re
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import done

from mirrorskin import engine, io

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = "kernels", "io", "engine", "hw", "twin", "view"
FILES = [
    file for name in FOLDERS for file in sorted((ROOT / name).rglob("*.py")) if ">>> " in file.read_text()
]
MODULES = [".".join(("mirrorskin", *file.relative_to(ROOT).with_suffix("").parts)) for file in FILES]


@pytest.mark.parametrize("name", [name.removesuffix(".__init__") for name in MODULES])
def test_examples_run(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    printed = []
    runner = doctest.DocTestRunner(verbose=False)
    for example in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        runner.run(example, out=printed.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(printed)


@pytest.mark.parametrize("package", [engine, io], ids=["engine", "io"])
def test_every_public_function_has_an_example(package):
    functions = {name: getattr(package, name) for name in package.__all__}
    lacking = [name for name, it in functions.items() if inspect.isfunction(it) and ">>> " not in it.__doc__]
    assert lacking == []


def forces(printed):
    for values, sigma, true in numbers(printed, r": (\S+) ± (\S+) N, true (\S+) N"):
        assert values == pytest.approx(true, rel=0.02)
        assert 0 < sigma < 0.02 * true


def moved(printed):
    for values, true in numbers(printed, r"translation .*: (\S+) mm, true (\S+) mm"):
        assert values == pytest.approx(true, abs=0.015)  # a quarter of a pixel
    for values, true in numbers(printed, r"rotation .*: (\S+) degrees, true (\S+) degrees"):
        assert values == pytest.approx(true, abs=0.25)


def slipped(printed):
    for values, true, closed in numbers(printed, r"found (\S+), true (\S+), closed form (\S+)"):
        assert true == pytest.approx(closed, abs=0.02)
        assert values == pytest.approx(true, abs=0.05)
    for (error,) in numbers(printed, r"within (\S+) µm"):
        assert error < 5
    ((values, true),) = numbers(printed, r"(\S+) degrees, true (\S+)")
    assert values == pytest.approx(true, rel=0.02)


def held(printed):
    (on, off) = numbers(printed, r"force (\S+) to (\S+) N, (\d+) onsets? of slip, slid by (\S+) µm")
    assert on[0] > 0.48 > off[0]
    assert on[2] > 0
    assert on[3] < 10 < off[3]


def vibrated(printed):
    for values, expected in numbers(printed, r"RMS error (\S+?)(?: µm)?, expected (\S+)"):
        assert 0.2 * expected < values < 1.5 * expected  # the twin has no lens, whose blur is in the sigma
    ((values, true),) = numbers(printed, r"hysteresis: (\S+) µm, true (\S+) µm")
    assert values == pytest.approx(true, abs=2)
    ((values, true),) = numbers(printed, r"grows by (\S+) .* true (\S+)")
    assert values == pytest.approx(true, rel=0.01)


def compared(printed):
    values = numbers(printed, r"RMS error (\S+) mm.* at (\d+) pixels; (\d+) pixels")
    assert len(values) == 8
    for number, (error, answered, untouched) in enumerate(values):
        elastic = number % 4 >= 2
        assert untouched > 0.3 * answered if elastic else untouched < 0.02 * answered
        assert error > 0.4 if elastic else error < 0.3


def fused(printed):
    ((error,),) = numbers(printed, r"RMS error (\S+) µm")
    assert error < 5


def rose(printed):
    assert "median error 0.0" in printed


def measured(printed):
    ((error,),) = numbers(printed, r"RMS (?:error )?(\S+) mm")
    assert 0 < error < 0.05


def numbers(printed, pattern):
    """Return the numbers of all matches of a pattern; there is at least one."""
    values = [tuple(map(float, match.groups())) for match in re.finditer(pattern, printed)]
    assert values, printed
    return values


SLOW = {
    "force": forces,
    "hold": held,
    "moving_object": moved,
    "sensors": compared,
    "slip": slipped,
    "vibration": vibrated,
}


def streamed(printed):
    ((frames, lowest, highest),) = numbers(printed, r"(\d+) frames: from (\S+) to (\S+) mm")
    assert (frames, lowest, highest) == (31, pytest.approx(-1.9, abs=0.1), pytest.approx(0.0, abs=0.02))


def unwrapped(printed):
    ((chi2,),) = numbers(printed, r"\(error / standard error\)² (\S+)")
    assert chi2 == pytest.approx(1, abs=0.1)
    ((error,),) = numbers(printed, r"RMS error (\S+) nm")
    assert error < 15


def focused(printed):
    ((fraction, error),) = numbers(printed, r"(\d+) % of the pixels, RMS error (\S+) µm")
    assert fraction > 95
    assert error < 3


def lit(printed):
    ((angle,),) = numbers(printed, r"median error (\S+) degrees")
    assert angle < 0.5
    ((error,),) = numbers(printed, r"RMS error (\S+) µm")
    assert error < 1


def grown(printed):
    ((error,),) = numbers(printed, r"RMS error (\S+) µm")
    assert error < 8


def clicked(printed):
    values = numbers(printed, r"onset at (\S+) ± (\S+) mm, true (\S+) mm")
    ((onset, sigma, true),) = values
    assert abs(onset - true) < 3 * sigma


QUICK = {
    "app": clicked,
    "coin": measured,
    "focus": focused,
    "fringes": unwrapped,
    "fused": fused,
    "touch": fused,
    "lamps": lit,
    "live_heights": grown,
    "own_camera": streamed,
    "own_data": measured,
    "sphere": measured,
    "steepest_rise": rose,
}


def test_every_script_of_the_examples_is_tested():
    assert {file.stem for file in (ROOT / "examples").glob("*.py")} == set(SLOW) | set(QUICK)


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_a_script_of_the_examples_runs_and_prints_what_is_true(name, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    if name == "own_camera":  # a video takes the place of a camera
        done("sample video -o press.avi")
        monkeypatch.setattr(sys, "argv", ["own_camera.py", "press.avi"])
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
    (SLOW | QUICK)[name](capsys.readouterr().out)
    drawn = list(tmp_path.glob("*.png"))
    assert drawn or name in ("own_camera", "steepest_rise")
    for picture in drawn if name in SLOW else ():
        check_shown(picture, f"sensors-{picture.name}" if name == "sensors" else picture.name)


def check_shown(drawn, name):
    """Compare a picture with that of the documentation."""
    picture, shown = (cv2.imread(str(path)) for path in (drawn, ROOT / "docs" / "images" / name))
    assert picture.shape == shown.shape, name
    assert np.abs(picture.astype(int) - shown).mean() < 0.3, f"docs/images/{name}: copy what the script draws"
