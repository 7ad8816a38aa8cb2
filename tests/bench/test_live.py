"""The live cases run, and their source delivers frames on schedule."""

import numpy as np
import pytest
from live_frames import paced, phases, turn_frames, turn_header

from mirrorskin.bench.suite.live import Ran, judge_press, judge_rotation
from mirrorskin.engine.live import RAISED, Latency, Status, Update
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SHAPE = (20, 5, 7)


def ran(**status):
    counts = {"frames": 600, "used": 600, "updates": 600, **status}
    picture = np.zeros((2, 2), np.uint8)
    update = Update(600, 1.0, "axial", 0.0, picture)
    return Ran(Status(**counts, latency={RAISED: Latency(0.014, 0.029)}), 10.0, update, 0.5)


def test_targets_are_judged_by_what_was_counted():
    assert all(target.met for target in judge_rotation(ran(), 1e-3))
    assert [target.met for target in judge_rotation(ran(updates=590), 1e-1)] == [False, True, True, False]
    assert [target.met for target in judge_press(ran(), 60.0)] == [True, True]
    assert [target.met for target in judge_press(ran(dropped=1), 60.0)] == [True, False]
    assert [target.met for target in judge_press(ran(used=500, skipped=1), 60.0)] == [False, False]


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
