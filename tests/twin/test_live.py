"""Live frames arrive on schedule."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.io import InputError
from mirrorskin.twin import Axial, Live, Twin, Vertical
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

COUNT, RATE = 40, 20.0
TRAVEL = 0.05 * np.arange(COUNT)


def make_live(rate: float | None = RATE) -> tuple[Live, SimulatedClock]:
    twin = Twin(object="sphere", shape=(13, 17), pixel_size=0.4, movement=Vertical(TRAVEL))
    clock = SimulatedClock()
    return Live(twin, rate, clock), clock


def all_frames() -> np.ndarray:
    twin = Twin(object="sphere", shape=(13, 17), pixel_size=0.4, movement=Vertical(TRAVEL))
    block = twin.read(np.empty(twin.shape, twin.dtype))
    assert block is not None
    return block.frames


def test_frames_come_at_the_set_rate_and_are_the_twins() -> None:
    live, clock = make_live()
    frames, times = [], []
    with live:
        while (block := live.read()) is not None:
            assert (block.dropped, len(block.frames)) == (0, 1)
            frames.append(block.frames[0].copy())
            times.append(clock.now())
    np.testing.assert_allclose(np.diff(times), 1 / RATE)
    np.testing.assert_array_equal(frames, all_frames())


def test_a_late_reader_loses_the_oldest_frames_and_is_reported() -> None:
    live, clock = make_live()
    live.read()
    clock.sleep(20 / RATE)
    block = live.read(np.empty((20, *live.shape[1:]), live.dtype))
    assert block is not None
    assert (block.dropped, block.index, len(block.frames)) == (12, 13, 8)
    np.testing.assert_array_equal(block.frames, all_frames()[13:21])


def test_after_the_last_frame_there_is_none_however_late_it_is() -> None:
    live, clock = make_live()
    live.read()
    clock.sleep(1000.0)
    block = live.read(np.empty((COUNT, *live.shape[1:]), live.dtype))
    assert block is not None
    assert (block.index, len(block.frames)) == (COUNT - 8, 8)
    assert live.read() is None


def test_time_does_not_run_back() -> None:
    live, _ = make_live()
    assert not live.rewindable
    with pytest.raises(RuntimeError, match="live"):
        live.rewind()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_rate_is_refused(rate: float) -> None:
    with pytest.raises(InputError, match="frames per second"):
        make_live(rate)


def test_frames_of_other_movements_are_skipped_too() -> None:
    def make() -> Twin:
        movement = Axial(np.arange(COUNT) * 2 * np.pi / 10, 0.1, 1.0)
        return Twin(object="sphere", shape=(13, 17), pixel_size=0.4, movement=movement)

    twin, clock = make(), SimulatedClock()
    live = Live(twin, RATE, clock)
    assert (live.name, live.motion, live.shape, live.dtype) == (twin.name, "axial", twin.shape, twin.dtype)
    assert live.header is twin.header
    whole = make().read(np.empty(twin.shape, twin.dtype))
    assert whole is not None
    indexes = []
    for late in (0.0, 14.2, 0.1, 3.3, 500.0):
        clock.sleep(late / RATE)
        block = live.read(np.empty((9, *live.shape[1:]), live.dtype))
        assert block is not None
        here = np.arange(block.index, block.index + len(block.frames))
        np.testing.assert_array_equal(block.frames, whole.frames[here])
        np.testing.assert_array_equal(block.phase, twin.movement.positions[here])
        indexes.append((block.index, len(block.frames), block.dropped))
    assert indexes == [(0, 1, 0), (7, 8, 6), (15, 1, 0), (16, 3, 0), (32, 8, 13)]
    assert live.read() is None
