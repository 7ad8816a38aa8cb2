"""The stage of docs/stages.md moves a rig with a fake controller, and stops on faults."""

import builtins
import contextlib
import re
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from commands import run
from installed_packages import install
from rig_fakes import FakeCamera, settings
from simulated import on_clock, write_film_rig

from mirrorskin import io
from mirrorskin.hw.base.drivers import STAGES, stage_driver
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import StageSettings, TravelAxis, load_rig
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.rig.plans import AxialPlan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig, open_stage
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.hw.rig.sweep import SweepScan

STAGE = StageSettings(
    port="/dev/ttyUSB0", press=2.0, travel=TravelAxis(letter="Z", limits=(-10.0, 3.0), speed=100.0)
)
PAGE = Path(__file__).parents[3] / "docs" / "stages.md"
EXAMPLE = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0]


class Controller:
    """Goes evenly to where it is sent, and answers each line; in the place of a serial port."""

    def __init__(self, clock):
        self.clock = clock
        self.way = [(0.0, -1.0, 0.0), (0.0, -1.0, 0.0)]  # time, travel; speed of what began last
        self.answers, self.silent, self.stopped, self.closed = [], False, 0, False
        self.instead = {}  # a command to what it is answered instead

    def travel(self, at):
        (t0, a, _), (t1, b, _) = self.way
        return b if at >= t1 else a + (b - a) * max(0.0, at - t0) / (t1 - t0)

    def write(self, data):
        now, words = self.clock.now(), data.decode().split()
        if words[0] == "MOVE":
            here, target, speed = self.travel(now), float(words[1]), float(words[2])
            self.way = [(now, here, speed), (now + abs(target - here) / speed, target, speed)]
        elif words[0] == "STOP":
            self.stopped += 1
            self.way = [(now, self.travel(now), 0.0)] * 2
        state = "run" if now < self.way[1][0] else "idle"
        answer = f"{self.travel(now):.5f} {state}" if words[0] == "WHERE?" else "ok"
        self.answers.append(self.instead.get(words[0], answer))

    def readline(self):
        answer = self.answers.pop(0)
        return b"" if self.silent else f"{answer}\n".encode()

    def close(self):
        self.closed = True


@pytest.fixture
def line(clock, monkeypatch):
    """A controller behind every port."""
    controller = Controller(clock)
    monkeypatch.setattr("serial.serial_for_url", lambda *_words, **_named: controller)
    return controller


@pytest.fixture
def lab(line, clock, monkeypatch):
    """The page's class, opened on a controller."""
    namespace = {"__name__": __name__}
    exec(EXAMPLE, namespace)
    namespace |= on_clock(clock)
    stage = namespace["LabStage"](STAGE)
    yield stage, line
    stage.close()
    assert line.closed


def rig_of(stage, line):
    camera = FakeCamera(
        line.clock,
        lambda at: Position(line.travel(at)),
        lambda place: np.full((4, 4), 20 + 100 * (place.travel > 0.25), np.uint8),
        rate=50.0,
    )
    return Rig(stage, camera, settings((4, 4), delay=0.0, dark=5.0), line.clock)


def test_steps_and_sweeps_are_recorded(lab, tmp_path):
    stage, line = lab
    with rig_of(stage, line) as rig:
        plan = VerticalPlan(0.0, 0.5, step=0.1)
        with io.StreamRecorder(StepScan(rig, plan, settle=0.0), tmp_path / "steps.h5") as recorder:
            while recorder.read() is not None:
                pass
        with io.StreamRecorder(
            SweepScan(rig, VerticalPlan(0.0, 0.5, speed=0.5)), tmp_path / "s.h5"
        ) as recorder:
            while recorder.read(np.empty((8, 4, 4), np.uint8)) is not None:
                pass
    with io.open_recording(tmp_path / "steps.h5") as steps, io.open_recording(tmp_path / "s.h5") as sweep:
        np.testing.assert_allclose(steps.travel, 0.1 * np.arange(6), atol=1e-9)
        bright = sweep.read(np.empty(sweep.shape, np.uint8)).frames[:, 0, 0] > 100
        assert sweep.travel[bright].min() == pytest.approx(0.25, abs=0.02)  # 0.5 mm/s, 50 frames a second


def test_what_it_cannot_do_is_refused_before_it_moves(lab):
    stage, line = lab
    with rig_of(stage, line) as rig:
        for plan, message in (
            (VerticalPlan(0.0, 1.0, speed=101.0), "cannot go at 101 mm"),
            (VerticalPlan(0.0, 2.5, speed=1.0), "exceeds the maximum"),
            (AxialPlan(1.0, 0.02, rate=0.5), "tilt"),
        ):
            with pytest.raises(io.InputError, match=message):
                SweepScan(rig, plan)
    assert line.way[1][1] == -1.0


def test_settings_take_the_class_itself(lab):
    kind = type(lab[0])
    with contextlib.closing(open_stage(msgspec.structs.replace(STAGE, firmware=kind))) as stage:
        assert isinstance(stage, kind)
    with pytest.raises(io.InputError, match=r"^Controller has no name, no limits"):
        open_stage(msgspec.structs.replace(STAGE, firmware=Controller))


def test_silence_stops_it(lab):
    stage, line = lab
    stage.move(Position(1.0), 0.5)
    line.silent = True
    with pytest.raises(HardwareError, match="no longer answers"):
        stage.wait(timeout=60.0)
    assert line.stopped


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_is_none_is_refused(lab, speed):
    stage, line = lab
    with pytest.raises(io.InputError, match="cannot go at"):
        stage.move(Position(1.0), speed)
    assert line.way[1][1] == -1.0


def test_a_move_that_the_controller_refuses_stops_it(lab):
    stage, line = lab
    line.instead["MOVE"] = "error 7"
    with pytest.raises(HardwareError, match="'error 7'"):
        stage.move(Position(1.0), 0.5)
    assert line.stopped


@pytest.mark.parametrize(
    ("answer", "message"),
    [("garbage", "look at its cable"), ("nan run", "no place"), ("2.50000 run", "beyond its limits")],
)
def test_a_report_that_cannot_be_stops_it(lab, answer, message):
    stage, line = lab
    stage.move(Position(1.0), 0.5)
    line.instead["WHERE?"] = answer
    with pytest.raises(HardwareError, match=message):
        stage.wait(timeout=60.0)
    assert line.stopped


def test_a_wait_that_is_interrupted_stops_it(lab, monkeypatch):
    stage, line = lab
    stage.move(Position(1.0), 0.5)

    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(stage, "report", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stage.wait()
    assert line.stopped


RIG = """
[stage]
firmware = "my_stage:LabStage"
port = "/dev/ttyUSB0"
home = false
press = 2.0
[stage.travel]
letter = "Z"
limits = [-10.0, 3.0]
speed = 50.0
"""


@pytest.fixture
def folder(line, simulated, tmp_path, monkeypatch):
    """A rig file, the page's class beside it, a film of 200 s, and the controller behind the port."""
    monkeypatch.delitem(sys.modules, "my_stage", raising=False)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "my_stage.py").write_text(EXAMPLE.replace("import threading\nimport time\n", ""))
    write_film_rig(tmp_path, RIG)
    for name, module in on_clock(simulated).items():  # in the place of the modules that it imports
        monkeypatch.setattr(builtins, name, module, raising=False)
    return tmp_path


def test_commands_move_it_from_a_rig_file(folder):
    rig, recording = folder / "rig.toml", folder / "steps.h5"
    checked = run("rig", "check", rig, "--move")
    assert checked.code == 0, checked
    assert re.search(r"firmware .*my_stage\.py:LabStage", checked.out)
    assert "$" not in checked.out
    moved = run(*f"capture vertical --stop 0.4mm --step 0.2mm --settle 0s --rig {rig} -o {recording}".split())
    assert moved.code == 0, moved
    with io.open_recording(recording) as steps:
        np.testing.assert_allclose(steps.travel, [0.0, 0.2, 0.4])


@pytest.mark.parametrize(
    ("words", "change", "message"),
    [
        (
            "home",
            ("def home(", "def seek("),
            "my_stage.py:LabStage has no home: mirrorskin.hw.Stage",
        ),
        ("unlock", ("", ""), "only GRBL can be unlocked"),
        ("lift", (":LabStage", ":NoStage"), "has no class NoStage"),
        ("lift", ("my_stage:", "no_stage:"), "there is no no_stage in"),
        ("lift", ("my_stage:LabStage", "collections:namedtuple"), "namedtuple(settings) failed"),
        ("lift", ("my_stage:LabStage", "copy:copy"), "copy:copy has no name, no error"),
        (
            "check",
            ("def precess(", "def spin("),
            "my_stage.py:LabStage has no precess: mirrorskin.hw.Stage",
        ),
    ],
)
def test_what_a_class_lacks_is_refused_in_a_line(folder, words, change, message):
    for file in ("rig.toml", "my_stage.py"):
        (folder / file).write_text((folder / file).read_text().replace(*change))
    ended = run("rig", words, folder / "rig.toml")
    assert (ended.code, ended.said.count("\n")) == (2, 1), ended
    assert message in ended.said


@pytest.fixture
def named_stage(tmp_path, monkeypatch):
    """Install a package that gives the stage of the page a name."""
    install(tmp_path / "site", STAGES, lab="lab_stage:LabStage")
    (tmp_path / "site" / "lab_stage.py").write_text("class LabStage:\n    pass\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path / "site")


@pytest.mark.usefixtures("named_stage")
def test_an_entry_point_names_a_stage(tmp_path):
    write_film_rig(tmp_path, RIG.replace("my_stage:LabStage", "lab"))
    assert str(stage_driver(load_rig(tmp_path / "rig.toml").stage.firmware)) == "lab_stage:LabStage"


@pytest.mark.usefixtures("named_stage")
def test_an_unknown_firmware_is_refused_with_those_that_exist(tmp_path):
    write_film_rig(tmp_path, RIG.replace("my_stage:LabStage", "grlb"))
    with pytest.raises(io.InputError, match=r"stage\.firmware is grlb, and there are grbl, marlin, lab"):
        load_rig(tmp_path / "rig.toml")
