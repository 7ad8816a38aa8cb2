"""The live cases run, and their source gives frames when they are due."""

import numpy as np
import pytest
from live_frames import Clock, paced, phases, turn_frames, turn_header

from mirrorskin.bench import live, run_suite
from mirrorskin.bench.live.runs import _judge_losses, _judge_rate, _judge_rotation, _Ran
from mirrorskin.engine.live import SHOWN, Latency, Status, Update
from mirrorskin.kernels.device import open_device

SHAPE = (20, 5, 7)


@pytest.mark.parametrize("name", list(live.CASES))
def test_a_case_runs_and_tells_what_it_found(name):
    (case,) = run_suite(open_device(), [name], quick=True)
    assert case.targets == ()
    frames, stages, load, *rest = case.notes
    assert "30 frames" in frames
    assert "frame to map" in stages
    assert "load" in load
    assert len(rest) == (2 if "axial" in name else 0)


def ran(**status):
    counts = {"frames": 600, "used": 600, "updates": 600, **status}
    picture = np.zeros((2, 2), np.uint8)
    update = Update(600, 1.0, "axial", 0.0, picture)
    return _Ran(Status(**counts, latency={SHOWN: Latency(0.014, 0.029)}), 10.0, update, 0.5)


def test_targets_are_judged_by_what_was_counted():
    assert all(target.met for target in _judge_rotation(ran(), 1e-3))
    assert [target.met for target in _judge_rotation(ran(updates=590), 1e-1)] == [False, True, True, False]
    assert _judge_losses(ran()).met
    assert not _judge_losses(ran(dropped=1)).met
    assert not _judge_losses(ran(skipped=1)).met
    assert _judge_rate(ran(), 60.0).met
    assert not _judge_rate(ran(used=500), 60.0).met


def test_frames_come_when_they_are_due_and_those_that_wait_come_together():
    clock, frames, phase = Clock(), turn_frames(SHAPE), phases(SHAPE[0])
    source = paced(frames, turn_header(), phase, 10.0, clock)
    room = np.empty((8, *SHAPE[1:]), np.uint8)
    block = source.read(room)
    assert (block.index, len(block.frames), block.lent) == (0, 1, True)
    clock.now += 0.45
    block = source.read(room)
    assert (block.index, len(block.frames), block.dropped) == (1, 4, 0)
    np.testing.assert_array_equal(block.frames, frames[1:5])
    np.testing.assert_array_equal(block.phase, phase[1:5])
    np.testing.assert_allclose(block.time, [0.1, 0.2, 0.3, 0.4])
    assert source.now() == pytest.approx(0.45)
    np.testing.assert_array_equal(source.positions()["phase"], phase[:5])


def test_what_a_late_reader_loses_is_told():
    clock, frames = Clock(), turn_frames(SHAPE)
    source = paced(frames, turn_header(), phases(SHAPE[0]), 10.0, clock, slots=4)
    room, given = np.empty((8, *SHAPE[1:]), np.uint8), []
    lost = 0
    source.read(room)
    clock.now += 1.0
    while (block := source.read(room)) is not None:
        lost += block.dropped
        given += range(block.index, block.index + len(block.frames))
        np.testing.assert_array_equal(block.frames, frames[given[-len(block.frames) :]])
    assert lost == 6
    assert given == list(range(7, SHAPE[0]))


def test_it_cannot_be_rewound():
    with pytest.raises(RuntimeError):
        paced(turn_frames(SHAPE), turn_header(), phases(SHAPE[0])).rewind()
