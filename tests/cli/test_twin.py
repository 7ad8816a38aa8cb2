"""``mirrorskin twin serve`` in a process of its own, as another terminal meets it."""

from __future__ import annotations

import contextlib
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from commands import run

from mirrorskin.hw.rig_file import load_rig

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
        said = ""
        try:
            for line in child.stdout:
                said += line
                if "Ctrl-C" in line:
                    break
            yield child, said
        finally:
            child.kill()


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 0), ("SIGTERM", 128 + signal.SIGTERM)])
def test_a_rig_is_served_until_it_is_told_to_end(name: str, code: int, tmp_path: Path) -> None:
    folder = tmp_path / "rig"
    with serving(folder, "--pattern", "linear", "--rate", "60") as (child, said):
        path = folder / "rig.toml"
        settings = load_rig(path)
        assert f"{path}: sphere under 42 x 31 pixels at 60 frames a second" in said
        assert f"mirrorskin rig check {path}" in said
        assert (settings.camera.shape, settings.camera.rate) == ((31, 42), 60.0)
        assert settings.camera.zenith_gain is not None
        assert np.nanmean(np.load(folder / "bright.npy")) > 200
        assert Path(settings.stage.port).exists()
        match = re.fullmatch(r"tcp://(.+):(\d+)", str(settings.camera.source))
        assert match is not None
        with socket.create_connection((match[1], int(match[2])), PATIENCE) as line:
            assert line.recv(9, socket.MSG_WAITALL) == b"YUV4MPEG2"
        child.send_signal(getattr(signal, name))
        assert child.wait(PATIENCE) == code
        assert child.stdout is not None
        assert "Traceback" not in child.stdout.read()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((match[1], int(match[2])), PATIENCE)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--size", "42"), "--size"),
        (("--rate", "0"), "frame rate"),
        (("--delay", "3"), "--delay"),
        (("--jitter=-1ms",), "jitter"),
        (("--object", "cube"), "cube"),
        (("--pattern", "dots"), "dots"),
    ],
)
def test_what_cannot_be_served_is_refused(words: tuple[str, ...], told: str, tmp_path: Path) -> None:
    ended = run("twin", "serve", "-o", tmp_path / "rig", *SMALL, *words)
    assert ended.code == 2
    assert told in ended.said
    assert ended.said.count("\n") == 1
    assert not (tmp_path / "rig").exists()


def test_someone_elses_rig_file_is_kept(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("# mine\n")
    ended = run("twin", "serve", "-o", tmp_path, *SMALL)
    assert (ended.code, ended.said.count("\n")) == (2, 1)
    assert "-o" in ended.said
    assert (tmp_path / "rig.toml").read_text() == "# mine\n"
