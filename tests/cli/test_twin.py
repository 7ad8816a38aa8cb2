"""``mirrorskin twin serve`` in a separate process, as used from another terminal."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from background import end, install, process_of
from commands import refused

from mirrorskin.hw import load_rig
from mirrorskin.hw.base.rig_file import RigSettings
from mirrorskin.hw.cameras.video import VideoCamera

PATIENCE = 60.0  # seconds, for a busy machine
SMALL = ("--size", "42x31", "--pixel-size", "0.3mm")


@contextlib.contextmanager
def serving(folder: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start it, and wait until it has said all."""
    command = [
        sys.executable,
        "-m",
        "mirrorskin.cli.main",
        "twin",
        "serve",
        "-o",
        str(folder),
        *SMALL,
        *words,
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as child:
        assert child.stdout is not None
        text = ""
        try:
            for line in child.stdout:
                text += line
                if "Ctrl-C" in line:
                    break
            yield child, text
        finally:
            child.kill()


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 0), ("SIGTERM", 128 + signal.SIGTERM)])
def test_a_rig_is_served_until_it_is_stopped(name: str, code: int, tmp_path: Path) -> None:
    folder = tmp_path / "rig"
    with serving(folder, "--pattern", "linear", "--rate", "60") as (child, text):
        path = folder / "rig.toml"
        settings = load_rig(path)
        assert f"{path}: sphere under 42 x 31 pixels at 60 frames a second" in text
        assert f"mirrorskin rig check {path}" in text
        assert (settings.camera.shape, settings.camera.rate) == ((31, 42), 60.0)
        assert settings.camera.zenith_gain is not None
        assert np.nanmean(np.load(folder / "bright.npy")) > 200
        assert Path(settings.stage.port).exists()
        with connected(settings) as line:
            assert line.recv(9, socket.MSG_WAITALL) == b"YUV4MPEG2"
        with VideoCamera(settings.camera) as camera:
            assert camera.set_exposure(0.01) == 0.01
        child.send_signal(getattr(signal, name))
        assert child.wait(PATIENCE) == code
        assert child.stdout is not None
        assert "Traceback" not in child.stdout.read()
        assert not path.exists()
    with pytest.raises(OSError, match="refused"):
        connected(settings)


def connected(settings: RigSettings) -> socket.socket:
    """Connect to a rig's camera."""
    match = re.fullmatch(r"tcp://(.+):(\d+)\?exposure_port=\d+", str(settings.camera.source))
    assert match is not None
    return socket.create_connection((match[1], int(match[2])), PATIENCE)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--size", "42"), "--size"),
        (("--rate", "0"), "frame rate"),
        (("--delay", "3"), "--delay"),
        (("--jitter=-1ms",), "jitter"),
        (("--object", "cube"), "cube"),
        (("--pattern", "dots"), "dots"),
    ],
)
def test_what_cannot_be_served_is_refused(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    refused(message, "twin serve -o", tmp_path / "rig", *SMALL, *words)
    assert not (tmp_path / "rig").exists()


@pytest.mark.parametrize("background", [(), ("--background",)])
def test_another_users_rig_file_is_kept(background: tuple[str, ...], terminal: Terminal) -> None:
    (terminal.folder / "rig").mkdir()
    path = terminal.folder / "rig" / "rig.toml"
    path.write_text("# mine\n")
    ended = terminal("twin", "serve", "-o", "rig", *SMALL, *background)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "-o" in ended.stderr
    assert path.read_text() == "# mine\n"


def test_a_pipe_in_place_of_a_rig_file_is_refused(terminal: Terminal) -> None:
    (terminal.folder / "rig").mkdir()
    os.mkfifo(terminal.folder / "rig" / "rig.toml")
    ended = terminal("twin", "serve", "-o", "rig", *SMALL)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "rig.toml is not a regular file" in ended.stderr


class Terminal:
    """Runs commands in a folder, as a terminal does, and ends what goes on in the background."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._processes = folder, list[int]()
        self._environment = install(folder / "bin")

    def __call__(self, *words: str) -> subprocess.CompletedProcess[str]:
        command = ["mirrorskin", *words]
        return subprocess.run(
            command, cwd=self.folder, env=self._environment, capture_output=True, text=True, check=False
        )

    def serve(self) -> int:
        """Start a small rig in the background, and return its process."""
        ended = self("twin", "serve", "-o", "rig", "--background", *SMALL)
        assert (ended.returncode, ended.stderr) == (0, "")
        self._processes.append(process_of(ended.stdout))
        return self._processes[-1]

    def end(self, process: int, number: int) -> None:
        self._processes.remove(process)
        end(process, number)

    def close(self) -> None:
        for process in self._processes:
            end(process)


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    with contextlib.closing(Terminal(tmp_path)) as opened:
        yield opened


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", pytest.param("SIGINT", marks=pytest.mark.slow)])
def test_a_rig_in_the_background_is_ready_at_once_and_removes_its_file(name: str, terminal: Terminal) -> None:
    process, folder = terminal.serve(), terminal.folder / "rig"
    settings = load_rig(folder / "rig.toml")
    assert Path(settings.stage.port).exists()
    with connected(settings) as line:
        assert line.recv(9, socket.MSG_WAITALL) == b"YUV4MPEG2"
    terminal.end(process, getattr(signal, name))
    assert {path.name for path in folder.iterdir()} == {"twin.log"}
    assert "Traceback" not in (folder / "twin.log").read_text()


def test_a_rig_in_the_background_has_no_terminal(terminal: Terminal) -> None:
    process = terminal.serve()
    session, terminal_number = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[3:5]
    assert (int(session), int(terminal_number)) == (process, 0)  # so a terminal that closes does not end it
    for number in (0, 1, 2):
        assert not os.isatty(os.open(f"/proc/{process}/fd/{number}", os.O_RDONLY))


def test_the_file_of_a_killed_rig_is_refused_and_replaced(terminal: Terminal) -> None:
    terminal.end(terminal.serve(), signal.SIGKILL)
    ended = terminal("rig", "check", "rig/rig.toml")
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "port /dev/pts/" in ended.stderr
    assert "'mirrorskin twin serve -o rig --background'" in ended.stderr
    terminal.serve()
    assert terminal("rig", "check", "rig/rig.toml").returncode == 0


def test_a_rig_that_runs_is_not_replaced(terminal: Terminal) -> None:
    process = terminal.serve()
    before = (terminal.folder / "rig" / "rig.toml").read_text()
    ended = terminal("twin", "serve", "-o", "rig", "--background", *SMALL)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert f"'kill {process}'" in ended.stderr
    assert (terminal.folder / "rig" / "rig.toml").read_text() == before


def test_a_copy_with_a_port_of_its_own_is_a_rig_file_like_any_other(terminal: Terminal) -> None:
    process, path = terminal.serve(), terminal.folder / "rig" / "rig.toml"
    text = re.sub('port = ".*"', 'port = "/dev/ttyUSB0"', path.read_text())
    terminal.end(process, signal.SIGKILL)
    path.write_text(text)
    assert load_rig(path).stage.port == "/dev/ttyUSB0"
    assert terminal("twin", "serve", "-o", "rig", "--background", *SMALL).returncode == 2
    assert path.read_text() == text


@pytest.mark.parametrize(
    ("words", "message"),
    [(("--object", "cube"), "cube"), (("-o", "/proc/rig"), "-o")],
)
def test_what_cannot_be_served_in_the_background_is_refused(
    words: tuple[str, ...], message: str, terminal: Terminal
) -> None:
    ended = terminal("twin", "serve", "-o", "rig", "--background", *SMALL, *words)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert message in ended.stderr
    assert not (terminal.folder / "rig").exists()
