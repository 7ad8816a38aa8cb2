"""The live cases run, and their source delivers frames on schedule."""

import numpy as np
import pytest
from live_frames import paced, phases, turn_frames, turn_header

from mirrorskin.bench.suite.live import judge_cost, judge_latency, judge_press, judge_rotation
from mirrorskin.cli.commands.bench.live_runs import Ran
from mirrorskin.cli.commands.bench.records import LiveRow
from mirrorskin.engine.live import RAISED, Latency, Status, Update
from mirrorskin.io import Result
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SHAPE = (20, 5, 7)


def row(name, **changes):
    values = {"frames": 600, "lost": 0, "updates": 600, "seconds": 10.0, "processor": 1e-3, **changes}
    latency = {"50": 0.001, "95": 0.002, "99": 0.003}
    return LiveRow(name=name, size="2x2", rate=60.0, latency=latency, as_offline=True, **values)


def ran(height_error):
    height = np.tile([0.0, 1.0], (12, 6))
    height[0, 0] = np.nan
    update = Update(
        600, 1.0, "axial", 0.0, np.zeros((12, 12), np.uint8), Result(height=height + height_error)
    )
    status = Status(latency={RAISED: Latency(0.014, 0.029)})
    return Ran(10.0, 0.6, 0, [], Result(height=height), status, update)


def met(targets):
    return [target.met for target in targets]


def test_targets_are_judged_by_what_was_counted():
    assert met(judge_rotation(row("turn"), ran(1e-3))) == [True] * 5
    assert met(judge_rotation(row("turn", updates=590, processor=5e-3), ran(1e-1))) == [
        *(False, True, True),
        *(False, False),
    ]
    assert met(judge_press(60.0, row("press"), None)) == [True] * 2
    assert met(judge_press(60.0, row("press", lost=1), None)) == [True, False]
    assert met(judge_press(60.0, row("press", lost=100), None)) == [False, False]
    assert met(judge_cost(row("pose"), None)) == [False]
    assert met(judge_latency(row("pose+slip", lost=1), None)) == [True, False]


def test_frames_come_when_they_are_due_and_those_that_wait_come_together():
    clock, frames, phase = SimulatedClock(), turn_frames(SHAPE), phases(SHAPE[0])
    source = paced(frames, turn_header(), phase, 10.0, clock)
    staging = np.empty((8, *SHAPE[1:]), np.uint8)
    block = source.read(staging)
    assert (block.index, len(block.frames), block.stays_valid) == (0, 1, True)
    clock.sleep(0.45)
    block = source.read(staging)
    assert (block.index, len(block.frames), block.dropped) == (1, 4, 0)
    np.testing.assert_array_equal(block.frames, frames[1:5])
    np.testing.assert_array_equal(block.phase, phase[1:5])
    np.testing.assert_allclose(block.time, [0.1, 0.2, 0.3, 0.4])
    assert source.now() == pytest.approx(0.45)
    np.testing.assert_array_equal(source.positions()["phase"], phase[:5])


def test_what_a_late_reader_loses_is_reported():
    clock, frames = SimulatedClock(), turn_frames(SHAPE)
    source = paced(frames, turn_header(), phases(SHAPE[0]), 10.0, clock, slots=4)
    staging, numbers = np.empty((8, *SHAPE[1:]), np.uint8), []
    lost = 0
    source.read(staging)
    clock.sleep(1.0)
    while (block := source.read(staging)) is not None:
        lost += block.dropped
        numbers += range(block.index, block.index + len(block.frames))
        np.testing.assert_array_equal(block.frames, frames[numbers[-len(block.frames) :]])
    assert lost == 6
    assert numbers == list(range(7, SHAPE[0]))


def test_it_cannot_be_rewound():
    with pytest.raises(RuntimeError):
        paced(turn_frames(SHAPE), turn_header(), phases(SHAPE[0])).rewind()
