"""Every command that reads frames refuses damaged ones, or uses them if it is told to."""

from pathlib import Path

import h5py
import pytest
from batches import press, rotation
from commands import done, refused, run

from mirrorskin.io.storage.layout import STACK

DAMAGE = "frame 3 differs from what was recorded: copy the file again, or use the frames as they are with"


@pytest.fixture
def damaged():
    for path in (press(Path("press.h5")), rotation(Path("turn.h5"))):
        with h5py.File(path, "r+") as file:
            file[STACK][3, 2, 1] ^= 1


READERS = [
    "check press.h5",
    "reconstruct press.h5",
    "reconstruct turn.h5",
    "run mirrorskin.engine:Onset press.h5",
    "correlate turn.h5",
    "fuse press.h5 turn.h5 --no-register",
    "import press.h5 -o new.h5 --motion vertical",
    "export press.h5 -o press.zarr",
    "export press.h5 -o press.mcap",
    "calibrate references --dark press.h5 --bright press.h5 -o cal.h5",
    "calibrate scale press.h5 --board dots:5x4:1mm -o cal.h5",
    "calibrate elastic press.h5 --ball 4mm -o cal.h5",
]


@pytest.mark.parametrize("line", READERS)
@pytest.mark.usefixtures("damaged")
def test_damaged_frames_are_refused(line):
    refused(DAMAGE, line)


@pytest.mark.parametrize("line", READERS)
@pytest.mark.usefixtures("damaged")
def test_damaged_frames_are_used_if_asked_for(line):
    assert DAMAGE not in run(line, "--no-verify").said


@pytest.mark.usefixtures("damaged")
def test_a_batch_refuses_damaged_frames_and_names_its_setting():
    ended = run("batch press.h5 -o out")
    assert ended.code == 1
    assert f"{DAMAGE} verify = false in [stack] of --settings" in ended.out


@pytest.mark.usefixtures("damaged")
def test_a_batch_uses_damaged_frames_with_a_setting():
    Path("a.toml").write_text("[stack]\nverify = false\n", encoding="utf-8")
    done("batch press.h5 -o out --settings a.toml")


@pytest.mark.parametrize(
    "line",
    [
        "reconstruct press.h5",
        "run mirrorskin.engine:Onset press.h5",
        "correlate turn.h5",
        "fuse press.h5 turn.h5 --no-register",
    ],
)
def test_a_crop_reports_that_it_is_not_verified(line):
    press(Path("press.h5"))
    rotation(Path("turn.h5"))
    text = run(line, "--region", "1,1,4x3").said
    assert text.count("the frames were not verified") == line.count(".h5")
