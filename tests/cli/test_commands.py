"""The commands, run as a user runs them."""

import contextlib
import json
import shutil
import signal
import subprocess
import sys
import time

import cv2
import h5py
import numpy as np
import pytest
from commands import refused, run

from mirrorskin import io

SMALL = ["--size", "70x60", "--pixel-size", "0.15mm"]


def mirrorskin(*words, cwd=None):
    with contextlib.chdir(cwd or "."):
        ended = run(*words)
    assert ended.code == 0, ended.said
    return ended.out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a small sphere, pressed and reconstructed."""
    place = tmp_path_factory.mktemp("sphere")
    mirrorskin("simulate", "vertical", *SMALL, "-o", "sphere.h5", cwd=place)
    mirrorskin("reconstruct", "sphere.h5", cwd=place)
    return place


HEAVY = "{'numpy', 'h5py', 'pyopencl', 'matplotlib', 'cv2', 'rich', 'scipy', 'trimesh'}"


def help_of(*words):
    """Return what a command's help says, if it imports nothing heavy for it."""
    code = (
        f"import sys; sys.argv = ['mirrorskin', *{words!r}, '--help']\n"
        "from mirrorskin.cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"heavy = {HEAVY} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_help_imports_nothing_heavy():
    text = help_of()
    commands = ("reconstruct", "correlate", "simulate", "score", "import", "demo", "devices", "info", "bench")
    for command in commands:
        assert f"\n  {command} " in text


@pytest.mark.parametrize(
    ("command", "word"), [("simulate", "--displacement-step"), ("demo", "--output"), ("batch", "--scheduler")]
)
def test_a_command_s_help_imports_nothing_heavy(command, word):
    assert word in help_of(command)


def test_a_sphere_is_pressed_reconstructed_and_scored(folder):
    score = json.loads(mirrorskin("score", "sphere-result.h5", "--truth", "sphere.h5", "--json", cwd=folder))
    assert score["height"]["answered"] > 1000
    assert score["height"]["median"] < 0.05
    assert "height RMS error" in mirrorskin("score", "sphere-result.h5", "--truth", "sphere.h5", cwd=folder)


def test_a_result_states_how_it_was_made(folder):
    result = io.open_result(folder / "sphere-result.h5")
    assert result.process["threshold"] == 0.5
    assert result.process["hold"] == 2
    assert result.process["subframe"] is True
    assert len(str(result.process["source_fingerprint"])) == 64
    assert result.x is not None
    assert result.x[1] - result.x[0] == pytest.approx(0.15)


def test_options_reach_the_engine(folder):
    words = [
        "--threshold",
        "0.3",
        "--hold",
        "1",
        "--no-subframe",
        "--memory",
        "100kB",
        "--device",
        "0",
        "--no-fill",
    ]
    report = json.loads(mirrorskin("reconstruct", "sphere.h5", "-o", "o.h5", *words, "--json", cwd=folder))
    process = report["process"]
    assert (process["threshold"], process["hold"], process["subframe"]) == (0.3, 1, False)
    assert report["summary"]["answered"] > 1000
    assert {record["name"] for record in report["profile"]} >= {"onset_scan"}
    result = io.open_result(folder / "o.h5")
    heights = result.height[np.isfinite(result.height)]
    assert set(np.unique(heights)) <= set((-0.1 * np.arange(1, 31)).astype(np.float32))


def test_a_memory_limit_changes_nothing(folder):
    mirrorskin("reconstruct", "sphere.h5", "-o", "small.h5", "--memory", "20kB", cwd=folder)
    small, large = (io.open_result(folder / name) for name in ("small.h5", "sphere-result.h5"))
    np.testing.assert_array_equal(small.height, large.height)


def test_info_prints_what_a_file_holds(folder):
    assert "30 of 70 x 60, uint8" in mirrorskin("info", "sphere.h5", cwd=folder)
    assert json.loads(mirrorskin("info", "sphere-result.h5", "--json", cwd=folder))["kind"] == "result"


def test_a_damaged_frame_is_found(folder, tmp_path):
    assert "all 30 frames are as they were recorded" in mirrorskin(
        "info", "--verify", "sphere.h5", cwd=folder
    )
    copy = tmp_path / "copy.h5"
    shutil.copy(folder / "sphere.h5", copy)
    with h5py.File(copy, "r+") as file:
        file["/entry/instrument/detector/data"][7, 3, 2] ^= 1
    refused("1 of 30 frames differ from what was recorded (7): copy it again", "info --verify", copy)


def test_devices_lists_what_there_is():
    listed = json.loads(mirrorskin("devices", "--json"))
    assert listed["devices"][listed["default"]]["name"] in mirrorskin("devices")


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--dark", "30"], "dark", 30.0),
        (["--bright", "200"], "bright", 200.0),
        (["--noise", "4"], "noise", 4.0),
        (["--travel-step", "0.2mm", "--travel-start", "5mm"], "motion", None),
    ],
)
def test_what_is_given_is_used(folder, words, name, value):
    words = ["-o", "g.h5", "--overwrite", *words, "--json"]
    report = json.loads(mirrorskin("reconstruct", "sphere.h5", *words, cwd=folder))
    if value is None:
        assert report["summary"]["highest"] < -5
    else:
        assert report["process"][name] == value


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--bogus", "--bogus"),
        ("simulate sideways -o a.h5", "sideways"),
        ("reconstruct", "REC.h5"),
        ("nonsense", "nonsense"),
        ("reconstruct . --travel-start 1mm", "--travel-step"),
        ("import . -o a.h5 --motion axial --phase-step 45deg --travel-step 1mm", "travel"),
    ],
)
def test_a_wrong_call_is_one_line(tmp_path, words, message):
    ended = run(words)
    assert ended.code == 2
    assert message in ended.said
    assert ended.said.count("\n") == 1


def test_debug_shows_where_and_keeps_the_exit_code(tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "mirrorskin.cli.main", "--debug", "info", "nothing.h5"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert run.returncode == 2
    assert "Traceback" in run.stderr


def test_a_terminated_simulation_leaves_nothing(tmp_path):
    frames = ["--frames", "5000", "--travel-step", "1um", "--references", "exact"]
    words = ["simulate", "vertical", "--size", "1500x1500", *frames, "-o", "a.h5"]
    child = subprocess.Popen([sys.executable, "-m", "mirrorskin.cli.main", *words], cwd=tmp_path)
    while not list(tmp_path.iterdir()):
        assert child.poll() is None
        time.sleep(0.01)
    child.terminate()
    assert child.wait(timeout=60) == 128 + signal.SIGTERM
    assert not list(tmp_path.iterdir())


PROGRAM = """
import signal, sys, time
from mirrorskin.cli import main
from mirrorskin.cli.commands import info
{command}
info.command = command
sys.argv = ["mirrorskin", "info"]
main.main()
"""
CARELESS = """
class Careless:
    def __del__(self):
        signal.raise_signal(signal.{name})  # what is raised here is lost

def command():
    Careless()
    time.sleep(30)
    print("went on")
"""
CONFUSED = """
def command():
    try:
        signal.raise_signal(signal.{name})
    except BaseException:
        raise TypeError("as compiled libraries make of it") from None
"""


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 128 + signal.SIGTERM), ("SIGINT", 130)])
@pytest.mark.parametrize("command", [CARELESS, CONFUSED], ids=["lost", "made another error of"])
def test_a_signal_ends_the_command_whatever_becomes_of_its_exception(command, name, code):
    program = PROGRAM.format(command=command.format(name=name))
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stdout, run.stderr) == (code, "", "")


def test_an_import_does_not_overwrite_its_own_pictures(tmp_path):
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), np.full((8, 9), 9, np.uint8))
    words = ["import", ".", "-o", "frame1.png", "--motion", "vertical", "--travel-step", "1mm"]
    ended = run(*words)
    assert ended.code == 2
    assert "is the input" in ended.said


def test_an_import_names_what_it_left_out(tmp_path):
    for name in ("frame0", "frame1", "ambient"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((8, 9), 9, np.uint8))
    words = [
        "import",
        ".",
        "-o",
        "press.h5",
        "--motion",
        "vertical",
        "--travel-step",
        "1mm",
        "--pixel-size",
        "1mm",
    ]
    ended = run(*words)
    assert ended.code == 0
    assert ended.said.splitlines() == ["left out: ambient.png"]
    assert ended.out == "press.h5: 2 frames of 9 x 8, uint8, vertical motion\n"
