"""Wrong calls of commands that move a stage: each is one line, before a port or a camera is opened."""

import re
import sys

import numpy as np
import pytest
from commands import refused, run
from simulated import simulate, simulated_rig

from mirrorskin import io

PRESS = "live vertical --stop 1mm --speed 1mm/s"
TURN = "live axial --press 1mm --rate 1"
SLIDE = "live horizontal --press 1mm --distance 0.5mm --speed 0.5mm/s"
CAPTURE = "capture vertical --stop 1mm --step 0.5mm"
ZENITH = "calibrate zenith --ball 4mm --press 0.4mm -o cal.h5"
TILT = "calibrate tilt --ball 4mm --press 0.4mm -o cal.h5"
ELASTIC = "calibrate elastic --ball 4mm --press 0.4mm -o cal.h5"

OWN = """
from mirrorskin import engine, io

class Rise(engine.Operation):
    def push(self, frames):
        pass
    def result(self):
        return {}

class Twice(Rise):
    passes = 2

class Posed(Rise):
    def push(self, frames, *, pose):
        pass

class Deep(Rise):
    dtypes = ("uint16",)

class Large(Rise):
    def start(self, shape, dtype):
        raise io.InputError("larger frames are needed")

class Crowded(Rise):
    def push(self, frames):
        raise io.InputError("more frames are needed")
"""

# Differences of further rig files from the first one: what is replaced, and by what.
RIGS = {
    "rig.toml": ("", ""),
    "unscaled.toml": (r"\npixel_size = .*\n", "\n"),
    "slow.toml": (r"\nrate = .*\n", "\nrate = 2.0\n"),
    "dim.toml": (r"\nbright = .*\n", "\n"),
    "triggered.toml": (r"\[camera\]", '[camera]\ntrigger = "coolant"'),
}


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A folder with rig files, classes, results and calibrations; and a list of what is opened."""
    folder, opened = tmp_path_factory.mktemp("work"), []
    with simulated_rig(folder / "rigs", (24, 32), rate=40.0, delay=0.02) as (rig, file):
        text = file.read_text()
        for name, (pattern, replacement) in RIGS.items():
            (file.parent / name).write_text(re.sub(pattern, replacement, text))
        marlin = re.sub("firmware = .*", 'firmware = "marlin"', (file.parent / "triggered.toml").read_text())
        (file.parent / "marlin.toml").write_text(marlin)
        (folder / "own.py").write_text(OWN)
        io.save_result(io.Result(contact=np.ones((5, 5), np.uint8)), folder / "small.h5")
        for name, camera in (("other.h5", "other"), ("same.h5", rig.settings.camera.name)):
            camera_id = io.CameraId(camera, (24, 32), np.dtype(np.uint8))
            io.save_calibration(io.Calibration(camera_id), folder / name)

        def opening(*_, **__):
            opened.append("opened")
            raise AssertionError("opened")

        with pytest.MonkeyPatch.context() as patch:
            simulate(patch, rig.clock, opening, opening)
            yield folder, opened


@pytest.fixture
def opened(prepared, monkeypatch):
    """What is opened by commands in the folder."""
    monkeypatch.chdir(prepared[0])
    prepared[1].clear()
    return prepared[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"{PRESS} --operation own.py:Twice", "needs all frames twice, so it cannot run live"),
        (f"{PRESS} --operation own.py:Posed", "Posed needs pose"),
        (f"{PRESS} --operation own.py:Deep", "frames of type uint8"),
        (f"{PRESS} --operation own.py:Large", "larger frames are needed"),
        (f"{PRESS} --operation own.py:Crowded", "more frames are needed"),
        (f"{PRESS} --operation own.py:Missing", "has no class Missing"),
        (f"{PRESS} --operation mirrorskin.engine:Normals", "Normals needs axial motion"),
        (f"{TURN} --operation mirrorskin.engine:Onset", "Onset needs vertical motion"),
        (f"{TURN} --operation mirrorskin.engine:Normals", "a zenith gain is needed"),
        (f"{PRESS} --operation mirrorskin.engine:ChangePoint --rig rigs/dim.toml", "needs all frames twice"),
        (f"{TURN} --rig rigs/slow.toml", "2 frames a turn: at least 3 are needed"),
        (f"{TURN} --window-frames 60", "a turn has only 40 frames"),
        ("live axial --rock --press 1mm --speed 5deg/s", "has no zenith gain"),
        (f"{SLIDE} --rig rigs/unscaled.toml", "the pixel size is missing"),
        (f"{SLIDE} --contact small.h5", "contact has shape (5, 5), the frames are 24 x 32"),
        (f"{SLIDE} --contact none.h5", "none.h5: no such file"),
        (f"{SLIDE} --window-size 1001", "6 to 24 pixels are possible"),
        (f"{PRESS} --latency -1s", "latency -1.0: a number of seconds of at least 0 is needed"),
        (f"{PRESS} --device nonsense", "no such device"),
        (f"{PRESS} --calibration other.h5", "other"),
        (f"{PRESS} --view nowhere", "give window, browser or a FILE.rrd"),
        (f"{PRESS} --view none/live.rrd", "there is no folder none"),
        (f"{PRESS} --record rec.h5 -o rec.h5", "--record and -o are both rec.h5: name two files"),
        (f"{PRESS} --record rec.h5 -o ./rec.h5 --overwrite", "name two files"),
        (f"{PRESS} --record none/rec.h5", "there is no folder none"),
        (f"{PRESS} --record small.h5", "small.h5 exists"),
        (f"{PRESS} --record rec.mcap --calibration same.h5", "an MCAP file cannot contain a calibration"),
        (f"{PRESS} -o none/res.h5", "there is no folder none"),
        (f"{PRESS} -o res.csv", "a result is HDF5"),
        (f"{PRESS} -o small.h5", "small.h5 exists"),
        (f"{PRESS} --rig rigs/triggered.toml", "camera.trigger works only for captures in steps"),
        (f"{CAPTURE} -o rec.mcap --calibration same.h5", "an MCAP file cannot contain a calibration"),
        (f"{CAPTURE} -o rec.h5 --calibration other.h5", "other"),
        (f"{CAPTURE} -o none/rec.h5", "there is no folder none"),
        (f"{CAPTURE} -o rec.h5 --rig rigs/marlin.toml", "camera.trigger needs a GRBL controller"),
        ("rig probe rigs/rig.toml --from 9mm", "does not go down"),
        ("rig probe rigs/rig.toml --from -9mm", "beyond the axis"),
        ("rig probe rigs/rig.toml --step 0mm", "step 0 mm cannot be"),
        ("rig probe rigs/rig.toml --step 3mm", "3 positions between travels of -4.5 and 3 mm are too few"),
        ("rig jog rigs/rig.toml travel --by 1deg", "--by 1deg"),
        (ZENITH, "there are no dark and bright references"),
        (f"{ZENITH} --rig rigs/unscaled.toml", "has no pixel size"),
        (ZENITH.replace("4mm", "0mm", 1), "the ball's diameter is 0 mm"),
        (f"{ZENITH} --body-radius 0mm", "both must be above 0"),
        (ZENITH.replace("cal.h5", "none/cal.h5"), "there is no folder none"),
        (TILT, "no zenith gain and offset"),
        (f"{TILT} --rig rigs/unscaled.toml", "has no pixel size"),
        (f"{TILT} --flat none.h5", "none.h5: no such file"),
        (f"{ELASTIC} --rig rigs/unscaled.toml", "has no pixel size"),
        (f"{ELASTIC} --device nonsense", "no such device"),
        (ELASTIC.replace("cal.h5", "other.h5"), "other"),
        ("calibrate references -o other.h5", "other"),
        ("calibrate references --dark none.h5 -o cal.h5", "none.h5: no such file"),
        ("calibrate scale none.png --board chessboard:8x6:1mm -o cal.h5", "none.png"),
    ],
)
def test_a_call_that_cannot_be_opens_nothing(opened, words, message):
    line = words if "rigs/" in words else f"{words} --rig rigs/{'dim' if words == ZENITH else 'rig'}.toml"
    refused(message, line)
    assert opened == []


@pytest.mark.parametrize("line", [f"{PRESS} --record rec.mcap", f"{CAPTURE} -o rec.mcap"])
def test_a_package_that_is_missing_opens_nothing(opened, monkeypatch, line):
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    refused("pip install", f"{line} --rig rigs/rig.toml")
    assert opened == []


@pytest.mark.parametrize("line", [PRESS, TURN, f"{PRESS} --operation own.py:Rise", f"{ELASTIC} --places 1"])
def test_a_call_that_can_be_opens_the_rig(opened, line):
    with pytest.raises(AssertionError, match="opened"):
        run(f"{line} --rig rigs/rig.toml")
    assert opened == ["opened"]
