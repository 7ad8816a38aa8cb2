"""FIFOs, sockets, devices and folders instead of files: refused in one line before they are opened."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from mirrorskin.io import InputError
from mirrorskin.io.base.system import check_regular, open_regular, read_regular

LIMIT = 120  # seconds; opening a FIFO that nobody writes to would take for ever
STEPS = ("--motion", "vertical", "--travel-step", "0.1mm", "-o", "out.h5")
PRESS = ("simulate", "vertical", "--size", "8x8", "--frames", "2", "-o", "out.h5")
SCALE = ("--board", "dots:5x4:1mm", "-o", "cal.h5")
COMMANDS = {
    "a.h5": ("info",),
    "frames.npy": ("import", "{}", *STEPS),
    "frames.npz": ("import", "{}", *STEPS),
    "pages.tif": ("import", "{}", *STEPS),
    "messages.mcap": ("import", "{}", *STEPS),
    "film.avi": ("import", "{}", *STEPS),
    "film.mp4": ("import", "{}", *STEPS),
    "listed.npy": ("info",),
    "listed.npz": ("info",),
    "ball.stl": (*PRESS, "--object"),
    "ball.ply": (*PRESS, "--object"),
    "ball.obj": (*PRESS, "--object"),
    "scan.x3p": ("measure",),
    "scan.sur": ("info",),
    "heights.npy": (*PRESS, "--object"),
    "heights.png": (*PRESS, "--object"),
    "heights.tif": (*PRESS, "--object"),
    "wall.png": (*PRESS, "--optics", "cylinder", "--pattern"),
    "board.png": ("calibrate", "scale", "{}", *SCALE),
    "board.tif": ("calibrate", "scale", "{}", *SCALE),
    "travel.csv": ("reconstruct", "sound.npy", "-o", "out.h5", "--travel"),
    "travel.npy": ("reconstruct", "sound.npy", "-o", "out.h5", "--travel"),
    "phases.txt": ("correlate", "sound.h5", "-o", "out.h5", "--phases"),
    "readings.csv": ("calibrate", "force", "sound.h5", "-o", "cal.h5", "--readings"),
    "batch.toml": ("batch", "sound.h5", "-o", "results", "--settings"),
    "rig.toml": ("rig", "check"),
    "run.json": ("bench", "--quick", "--against"),
    "calibration.h5": ("reconstruct", "sound.h5", "-o", "out.h5", "--calibration"),
}
"""Files of each kind, and a command that reads one."""

PROGRAM = """
import json, os, sys
import numpy as np
from commands import run
for folder, lines in json.loads(sys.argv[1]):
    os.chdir(folder)
    np.save("sound.npy", np.zeros((4, 8, 8), np.uint8))
    run("simulate", "vertical", "--size", "8x8", "--frames", "4", "-o", "sound.h5")
    for words in lines:
        ended = run(*words)
        print(json.dumps([words, ended.code, ended.said]), flush=True)
"""


def commands_for(make, folder):
    """Return the commands, each of a file that was made so in a folder."""
    lines = []
    for name, words in COMMANDS.items():
        make(folder / name)
        arguments = [name if word == "{}" else word for word in words]
        lines.append(arguments if "{}" in words else [*arguments, name])
    return lines


def outcomes(lines_by_folder):
    """Run commands in a process that is ended when one of them waits; return code and message of each."""
    support = Path(__file__).parents[2] / "support"
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(lines_by_folder)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(support), os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    actual = [json.loads(line) for line in ended.stdout.splitlines()]
    expected = [line for _, lines in lines_by_folder for line in lines]
    assert len(actual) == len(expected), f"{expected[len(actual)]} did not end: {ended.stderr}"
    return actual


def make_socket(path):
    with socket.socket(socket.AF_UNIX) as item:
        item.bind(str(path))


SPECIAL = {
    "fifo": (os.mkfifo, "regular file"),
    "socket": (make_socket, "regular file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "regular file"),
    "folder": (lambda path: path.mkdir(), ""),
}
"""How to make what is not a file, and words of the message."""


@pytest.fixture(scope="module")
def refusals(tmp_path_factory):
    """Command, code and message for each kind, of all kinds in one process, whose start takes longest."""
    lines_by_folder = []
    for kind, (make, _) in SPECIAL.items():
        folder = tmp_path_factory.mktemp(kind)
        lines_by_folder.append((str(folder), commands_for(make, folder)))
    actual = outcomes(lines_by_folder)
    count = len(COMMANDS)
    return {kind: actual[at * count : (at + 1) * count] for at, kind in enumerate(SPECIAL)}


@pytest.mark.parametrize("kind", SPECIAL)
def test_what_is_not_a_file_is_refused_by_every_reader(refusals, kind):
    for line, code, message in refusals[kind]:
        assert code == 2, (line, message)
        assert message.startswith("mirrorskin: "), line
        assert message.count("\n") == 1, (line, message)
        assert SPECIAL[kind][1] in message, (line, message)


def test_a_fifo_in_a_folder_of_pictures_is_left_out(tmp_path):
    (tmp_path / "frames").mkdir()
    os.mkfifo(tmp_path / "frames" / "frame1.png")
    ((_, code, message),) = outcomes([(str(tmp_path), [["import", "frames", *STEPS]])])
    assert (code, "without numbered pictures" in message) == (2, True)


@pytest.mark.parametrize("opens", [check_regular, open_regular, read_regular])
def test_only_regular_files_are_opened(tmp_path, opens):
    os.mkfifo(tmp_path / "pipe")
    for path, words in (
        (tmp_path / "pipe", "is not a regular file: save its contents in one first"),
        (Path("/dev/zero"), "is not a regular file"),
        (tmp_path, "cannot be read: Is a directory"),
        (tmp_path / "gone", "cannot be read: No such file or directory"),
        (Path("a\0b"), "cannot be read"),
    ):
        with pytest.raises(InputError, match=words):
            opens(path)


def test_a_file_that_is_read_whole_has_a_limit(tmp_path):
    with (tmp_path / "sparse.csv").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=r"sparse\.csv has 1099511627776 bytes, and at most"):
        read_regular(tmp_path / "sparse.csv")


def test_a_length_that_no_file_has_is_not_read(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    with open_regular(tmp_path / "a") as file, pytest.raises(ValueError, match="states a length"):
        file.read(1 << 40)
