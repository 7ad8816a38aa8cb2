"""Commands of the README and the twin's page run as they stand there; demo, rig, twin with fewer pixels."""

import contextlib
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import run
from mishaps import starved
from rotations import Setup, direction, expose

ROOT = Path(__file__).parent.parent
TEXT = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in ("README.md", "docs/twin.md"))
BLOCKS = re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
PYTHON = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = [line for block in BLOCKS for line in block.splitlines() if line.startswith("mirrorskin ")]
SUPPORT = Path(__file__).parent / "support"
SERVERS = []
OF_THEIR_OWN = (
    "demo",
    "batch",
    "bench",
    "rig",
    "capture",
    "live",
)  # in processes, which they start or end
FEWER = "--size", "424x296", "--pixel-size", "0.035mm"  # where a simulation takes the default; a ball fits in
TRIES = 5  # of what a machine may be too busy for to emulate in time
RUN = "import sys; sys.path.insert(0, sys.argv.pop(1)); import commands; commands.main_with_a_small_demo()"


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder in which the commands run one after the other, each with what those before have made."""
    place = tmp_path_factory.mktemp("desk")
    yield place
    while SERVERS:
        with SERVERS.pop() as server:
            server.terminate()
            assert server.wait(timeout=60) == 128 + signal.SIGTERM


def test_there_are_commands_to_run():
    assert len(COMMANDS) >= 8


@pytest.mark.slow
@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_runs(desk, line):
    words = shlex.split(line, comments=True)[1:]
    if words[-1] == "&":
        serve(desk, words[:-1])
        return
    if words[0] == "simulate" and "--size" not in words:
        words += FEWER
    if words[0] not in OF_THEIR_OWN:
        with contextlib.chdir(desk):
            ended = run(*words)
        assert ended.code == 0, ended.said
        return
    for _ in range(TRIES):
        done = subprocess.run(
            [sys.executable, "-c", RUN, str(SUPPORT), *words], cwd=desk, capture_output=True, text=True
        )
        if done.returncode == 0 or not starved(done.stderr):
            break
    assert done.returncode == 0, done.stderr


def serve(desk, words):
    """Start what goes on in the background, a small rig, and wait until it is there."""
    program = "from mirrorskin.cli.main import main; main()"
    small = "--size", "80x60", "--pixel-size", "0.16mm", "--rate", "10"
    server = subprocess.Popen(
        [sys.executable, "-P", "-c", program, *words, *small], cwd=desk, stdout=subprocess.PIPE, text=True
    )
    SERVERS.append(server)
    assert "rig.toml" in server.stdout.readline()


def test_the_python_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--size", "48x40", "--pixel-size", "0.25mm", "--frames", "12"]
    assert run("simulate", "vertical", *words, "-o", "press.h5").code == 0
    assert len(PYTHON) == 2
    known = arrays()
    for block in PYTHON:
        exec(block, known)
    assert np.isfinite(known["onset"].height).any()
    assert np.isfinite(known["surface"].height).all()
    assert known["twin"].shape == (4, 480, 640)


def arrays():
    """Return what the README takes for granted in Python: a slope of 20 degrees that falls to the right."""
    shape, setup = (30, 40), Setup()
    x = np.broadcast_to(0.1 * np.arange(40), shape)
    travel = 0.1 * np.arange(1, 21)
    slope = np.full(shape, -np.tan(np.radians(20)))
    return {
        "frames": np.where(travel[:, None, None] >= np.tan(np.radians(20)) * x, 200, 20).astype(np.uint8),
        "travel": travel,
        "dark": 20,
        "bright": 200,
        "turn": expose(direction(np.full(shape, np.radians(20)), np.zeros(shape)), setup, seed=1),
        "phase": setup.phase,
        "tilt": setup.tilt,
        "gain": setup.slope,
        "offset": setup.offset,
        "pixel_size": 0.1,
        "dz_dx": slope,
        "dz_dy": 0 * slope,
        "mask": np.ones(shape, np.uint8),
        "weights": 1 + x,
        "edges": np.zeros(shape, np.uint8),
        "heights": np.where(x == 0, 0.0, np.nan),
    }
