"""Commands of the README and the twin's page run unchanged, and give right numbers.

Some simulations of the twin's page run with fewer pixels.
"""

import contextlib
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from background import end, install, process_of
from commands import run
from mishaps import starved
from right_scores import check_score

from mirrorskin import engine, io
from mirrorskin.evaluation.scenes.rotations import Setup, direction, expose

ROOT = Path(__file__).parent.parent
TEXT = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in ("README.md", "docs/twin.md"))
BLOCKS = re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
PYTHON = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
(RIG,) = (block for block in BLOCKS if "twin serve" in block)
COMMANDS = [
    line
    for block in BLOCKS
    if block is not RIG
    for line in block.splitlines()
    if line.startswith("mirrorskin ")
]
SUPPORT = Path(__file__).parent / "support"
OF_THEIR_OWN = ("batch",)  # in processes, which they start or end
FEWER = "--size", "424x296", "--pixel-size", "0.035mm"  # where a simulation takes the default; a ball fits in
TRIES = 5  # of what a machine may be too busy for to emulate in time
ZENITH = 0.2  # degrees that a calibration leaves


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder in which the commands run one after the other, each with what those before have made."""
    return tmp_path_factory.mktemp("desk")


def test_there_are_commands_to_run():
    assert len(COMMANDS) >= 8
    assert sum(line.startswith("mirrorskin score ") for line in COMMANDS) == 4


@pytest.mark.slow
@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_runs(desk, line, monkeypatch):
    words = shlex.split(line, comments=True)[1:]
    if words[0] == "simulate" and "--size" not in words:
        words += FEWER
    monkeypatch.chdir(desk)
    if words[0] in OF_THEIR_OWN:
        process = subprocess.run(
            [sys.executable, "-P", "-m", "mirrorskin.cli.main", *words], capture_output=True, text=True
        )
        assert process.returncode == 0, process.stderr
        return
    ended = run(*words)
    assert ended.code == 0, ended.said
    if words[0] == "score":
        check_score(words, line.partition("#")[2])
    elif words[:2] == ["calibrate", "check"]:
        check_zenith(words)


def check_zenith(words):
    """Hold the zeniths of a ball that no calibration was made with against what they must be."""
    assert json.loads(run(*words, "--json").out)["after"]["zenith"]["rms"] < ZENITH


@pytest.mark.slow
@pytest.mark.real_time
def test_the_block_of_the_emulated_rig_runs_as_it_is_pasted(tmp_path):
    environment = install(tmp_path / "bin")
    for attempt in range(TRIES):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        shell = ["bash", "-ec", RIG]
        process = subprocess.run(shell, cwd=folder, env=environment, capture_output=True, text=True)
        if "end it with" in process.stdout:
            end(process_of(process.stdout))
            assert not (folder / "rig" / "rig.toml").exists()
        if process.returncode == 0 or not starved(process.stderr):
            break
    assert process.returncode == 0, process.stderr
    with contextlib.chdir(folder):
        quantities = json.loads(run("measure", "steps-result.h5", "--json").out)["quantities"]
        live, again = io.open_result("live-result.h5"), io.open_result("again.h5")
    for name, true in (("sphere radius", 5.0), ("sphere top", 0.0)):
        assert quantities[name]["value"] == pytest.approx(true, abs=0.03), name
    np.testing.assert_array_equal(again.height, live.height)


def test_the_python_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("press", "turn"):
        assert run("sample", name, "-o", f"{name}.h5").code == 0
    assert len(PYTHON) == 2
    namespace = arrays()
    for block in PYTHON:
        exec(block, namespace)
    assert np.isfinite(namespace["onset"].height).any()
    assert np.isfinite(namespace["surface"].height).all()
    with io.open_recording("press.h5") as recording:
        assert engine.score(namespace["both"], recording.truth).height.rms < 0.001  # mm
    assert namespace["twin"].shape == (4, 480, 640)


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
