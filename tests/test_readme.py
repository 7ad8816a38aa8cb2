"""Every mirrorskin command of the README runs as it stands there; the demo with fewer pixels and frames."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
COMMANDS = [line for block in BLOCKS for line in block.splitlines() if line.startswith("mirrorskin ")]
SUPPORT = Path(__file__).parent / "support"
RUN = "import sys; sys.path.insert(0, sys.argv.pop(1)); import commands; commands.main_with_a_small_demo()"


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with the files that the README takes for granted."""
    place = tmp_path_factory.mktemp("desk")
    frames = np.full((8, 24, 32), 20, np.uint8)
    frames[4:, 6:18, 8:24] = 220
    (place / "frames").mkdir()
    video = cv2.VideoWriter(str(place / "press.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
    for number, frame in enumerate(frames):
        cv2.imwrite(str(place / "frames" / f"frame{number}.png"), frame)
        video.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    video.release()
    with h5py.File(place / "theirs.h5", "w") as file:
        file["raw/images"] = frames
    return place


def test_there_are_commands_to_run():
    assert len(COMMANDS) >= 8


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_of_the_readme_runs(desk, line):
    words = shlex.split(line, comments=True)[1:]
    run = subprocess.run(
        [sys.executable, "-c", RUN, str(SUPPORT), *words], cwd=desk, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
