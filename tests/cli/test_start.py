"""Imports of commands: slow libraries are loaded only by commands that need them."""

import subprocess
import sys

import pytest
from commands import done, loaded

from mirrorskin.kernels import bitcode
from mirrorskin.kernels.device import list_devices

SIZE = "--size", "48x40", "--pixel-size", "0.25mm"
SLOW = {
    "asyncio",
    "dask",
    "matplotlib",
    "matplotlib.pyplot",
    "numpy.polynomial",
    "numpy.testing",
    "pyopencl",
    "rich",
    "scipy",
    "tifffile",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A press, a rotation, and the surface from both."""
    place = tmp_path_factory.mktemp("start")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        done("simulate", "vertical", *SIZE, "-o", "press.h5")
        done("simulate", "axial", *SIZE, "--pattern", "linear", "-o", "turn.h5")
        done("fuse", "press.h5", "turn.h5", "-o", "fused.h5")
    return place


@pytest.mark.parametrize(
    ("words", "needed"),
    [
        ("reconstruct press.h5 -o press-result.h5", {"pyopencl"}),
        ("reconstruct turn.h5 -o turn-result.h5", {"pyopencl"}),
        ("fuse press.h5 turn.h5 -o surface.h5", {"pyopencl"}),
        ("view fused.h5", {"matplotlib"}),
        ("view fused.h5 -o fused.png", {"matplotlib"}),
        ("report fused.h5 -o fused.html", {"matplotlib", "numpy.polynomial", "numpy.testing", "scipy"}),
    ],
)
def test_a_command_imports_only_what_it_needs(words, needed, folder, monkeypatch):
    monkeypatch.chdir(folder)
    modules = loaded(*words.split(), DISPLAY="", WAYLAND_DISPLAY="")
    assert {f"mirrorskin.cli.commands.{words.split()[0]}", "numpy"} <= modules
    assert modules & SLOW == needed


COMPILED = """
import contextlib, io, sys
from mirrorskin.cli.main import main
from mirrorskin.kernels.device import Device
compiled, compile = [], Device._compile
Device._compile = lambda *given: compiled.append(given) or compile(*given)
sys.argv = ["mirrorskin", *sys.argv[1:]]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main()
print(len(compiled))
"""


def test_a_command_compiles_no_program_that_was_compiled_before(folder, monkeypatch):
    if not any(bitcode.works_with(device.driver) for device in list_devices()[:1]):
        pytest.skip("another OpenCL than PoCL 3.0")
    monkeypatch.chdir(folder)
    command = [sys.executable, "-c", COMPILED, "fuse", "press.h5", "turn.h5", "-o", "again.h5"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "0\n"


def test_the_package_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "mirrorskin", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()[0], done.stderr) == (0, "mirrorskin", "")
    wrong = subprocess.run([sys.executable, "-m", "mirrorskin", "chekc"], capture_output=True, text=True)
    assert (wrong.returncode, wrong.stderr.split(":")[0]) == (2, "mirrorskin")
