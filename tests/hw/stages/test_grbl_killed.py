"""Motion in pieces equals that of one line, and ends soon after the host was killed."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from scripted_grbl import stage_settings

from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.stages.moves import PIECE, Axes
from mirrorskin.hw.stages.replies import AHEAD, Window
from mirrorskin.twin.emulator.motion import BLOCKS
from mirrorskin.twin.emulator.port import GrblMachine, GrblPort
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SETTINGS = dict.fromkeys((110, 111, 112), 6000) | dict.fromkeys((120, 121, 122), 100)
ZEROED = {name: structs.replace(axis, zero=0.0) for name, axis in stage_settings().axes.items()}
LEAN = math.radians(2.5)
PATIENCE = 60.0  # seconds, for a busy machine


def axes() -> Axes:
    able = Axes(stage_settings(**ZEROED), "rig")
    for motion in ZEROED:
        able.limit_acceleration(motion, 100.0)
    return able


class Played:
    """A controller that is sent some commands as the stage sends them."""

    def __init__(self, commands, silent_at=math.inf):
        clock = SimulatedClock(0.0)
        self.machine = GrblMachine(SETTINGS, clock=clock)
        window = Window()
        for command in commands:
            window.add(command.line, command.duration, command.ramp)
        while (window.busy or self.machine.moving()) and clock.now() <= silent_at + 10:
            while clock.now() < silent_at and (data := window.next(clock.now())) is not None:
                self.machine.receive(data)
            for _ in range(self.machine.take().count(b"ok")):
                window.answer()
            clock.sleep(0.005)
        self.now = clock.now()

    def places(self):
        times = np.arange(0, self.now, 0.01)
        return times, np.array([list(self.machine.position(at).values()) for at in times])


def strokes(able, cut_leg):
    places = [Position(), Position(2.0), Position(0.5), Position(2.0, 0.02, 0.03)]
    return [item for leg in pairwise(places) for item in cut_leg(able, *leg)]


@pytest.mark.parametrize("speed", [0.3, 2.0])
def test_motion_in_pieces_is_that_of_whole_lines(speed):
    in_pieces = Played(strokes(axes(), lambda able, *leg: able.pieces(*leg, speed)))
    whole = Played(strokes(axes(), lambda able, *leg: [able.straight(*leg, speed)]))
    (times, places), (longer, expected) = in_pieces.places(), whole.places()
    count = min(len(times), len(longer))
    np.testing.assert_allclose(places[:count], expected[:count], atol=speed * 0.01)  # a line waits to be read
    np.testing.assert_allclose(places[-1], expected[-1], atol=1e-9)


@pytest.mark.parametrize("rate", [0.05, 0.5])
def test_a_precession_in_pieces_keeps_its_circle_and_its_speed(rate):
    able = axes()
    lean = able.pieces(Position(), Position(0.0, LEAN), None)
    commands = [*lean, *able.arcs(LEAN, 1.0, rate, 0.0, dict.fromkeys("XYZ", 0.0))]
    times, places = Played(commands).places()
    phase = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))
    turning = (phase > 0.3) & (phase < math.tau - 0.3)
    np.testing.assert_allclose(np.hypot(*places[turning, :2].T), 2.5, atol=2e-3)
    np.testing.assert_allclose(np.gradient(phase[turning], times[turning]), math.tau * rate, rtol=0.02)


@pytest.mark.parametrize("silent_at", [0.1, 1.0, 3.3])
@pytest.mark.parametrize("strokes", [1, 20])
def test_when_the_host_falls_silent_it_moves_on_for_less_than_a_second(silent_at, strokes):
    able, speed = axes(), 0.5
    places = [Position(0.1 if number % 2 else 0.0) for number in range(strokes + 1)]
    if strokes == 1:
        places = [Position(), Position(4.0)]
    commands = [piece for leg in pairwise(places) for piece in able.pieces(*leg, speed)]
    machine = Played(commands, silent_at).machine
    moving = [at for at in np.arange(silent_at, silent_at + 5, 0.01) if machine.moving(at)]
    assert max(moving, default=0.0) - silent_at < AHEAD + PIECE + 0.05


HOST = """
import sys
from msgspec import structs
from scripted_grbl import stage_settings
from mirrorskin.hw.stages.grbl import GrblStage
from mirrorskin.hw.base.stage import Position

axes = {name: structs.replace(axis, zero=0.0) for name, axis in stage_settings().axes.items()}
# A controller on a busy machine may be late, which is no fault here.
stage = GrblStage(stage_settings(port=sys.argv[1], timeout=60.0, silence=60.0, **axes))
stage.move(Position(-4.5), 0.1)
stage.wait()
"""


def test_a_host_that_is_killed_leaves_a_stage_that_soon_rests():
    support, speed = Path(__file__).parents[2] / "support", 0.1
    machine = GrblMachine(SETTINGS)
    with GrblPort(machine) as port:
        words = [sys.executable, "-c", HOST, port.url]
        with subprocess.Popen(words, env={"PYTHONPATH": f"{support}:{':'.join(sys.path)}"}) as host:
            until = time.monotonic() + PATIENCE
            while machine.position()["Z"] < 0.1:
                assert host.poll() is None
                assert time.monotonic() < until
                time.sleep(0.005)
            host.kill()
            assert host.wait() == -signal.SIGKILL
            killed = machine.position()["Z"]
        while machine.moving():
            assert time.monotonic() < until
            time.sleep(0.005)
        # A controller that is late, on a busy machine, has more in store: as much as its planner holds.
        assert machine.position()["Z"] - killed < speed * PIECE * (BLOCKS + 3)
        assert machine.state == "Idle"
