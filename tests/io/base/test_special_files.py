"""FIFOs, sockets, devices and folders instead of files: refused in one line before they are opened."""

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
import json, sys
import numpy as np
from commands import run
np.save("sound.npy", np.zeros((4, 8, 8), np.uint8))
run("simulate", "vertical", "--size", "8x8", "--frames", "4", "-o", "sound.h5")
for words in json.loads(sys.argv[1]):
    ended = run(*words)
    print(json.dumps([words, ended.code, ended.said]), flush=True)
"""


def commands_for(make):
    """Return the commands, each of a file that was made so."""
    lines = []
    for name, words in COMMANDS.items():
        make(Path(name))
        arguments = [name if word == "{}" else word for word in words]
        lines.append(arguments if "{}" in words else [*arguments, name])
    return lines


def outcomes(lines):
    """Run commands in a process that is ended when one of them waits; return code and message of each."""
    import json

    support = Path(__file__).parents[2] / "support"
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(lines)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(support), os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    actual = [json.loads(line) for line in ended.stdout.splitlines()]
    assert len(actual) == len(lines), f"{lines[len(actual)]} did not end: {ended.stderr}"
    return actual


def make_socket(path):
    with socket.socket(socket.AF_UNIX) as item:
        item.bind(str(path))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (os.mkfifo, "regular file"),
        (make_socket, "regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "regular file"),
        (lambda path: path.mkdir(), ""),
    ],
    ids=["fifo", "socket", "device", "folder"],
)
def test_what_is_not_a_file_is_refused_by_every_reader(tmp_path, monkeypatch, make, words):
    monkeypatch.chdir(tmp_path)
    for line, code, message in outcomes(commands_for(make)):
        assert code == 2, (line, message)
        assert message.startswith("mirrorskin: "), line
        assert message.count("\n") == 1, (line, message)
        assert words in message, (line, message)


def test_a_fifo_in_a_folder_of_pictures_is_left_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("frames").mkdir()
    os.mkfifo("frames/frame1.png")
    ((_, code, message),) = outcomes([["import", "frames", *STEPS]])
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
