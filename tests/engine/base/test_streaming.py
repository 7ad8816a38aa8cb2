"""The common loop: each frame once, in order, for any free memory, and no damage if reading fails."""

import numpy as np
import pytest

from mirrorskin.engine import Operation, Run
from mirrorskin.engine.base.operation import Plan
from mirrorskin.io import Block, Header, InputError


class Source:
    """So many frames, each of its own number; it may fail at one of them."""

    name, header, motion, rewindable, dtype = "some", Header("vertical"), "vertical", True, np.dtype("uint16")

    def __init__(self, count, fails=None):
        self.shape = (count, 3, 5)
        self.fails, self.next = fails, 7

    def rewind(self):
        self.next = 0

    def read(self, out=None):
        start, stop = self.next, min(self.next + len(out), self.shape[0])
        if self.fails is not None and start <= self.fails < stop:
            raise InputError(f"frame {self.fails} is damaged")
        if start == stop:
            return None
        out[: stop - start] = np.arange(start, stop)[:, None, None]
        self.next = stop
        return Block(out[: stop - start], start, travel=0.1 * np.arange(start, stop))


class Keeper(Operation):
    """Keeps the numbers of the frames that it receives."""

    for_device = True
    least_frames = 0

    def __init__(self, device, rows, fails=None):
        super().__init__(device=device, memory_limit=2 * rows * 3 * 5 * 2)
        self.seen, self.fails = [], fails

    def push(self, frames, *, travel):
        numbers = frames[:, 0, 0].tolist()
        if self.fails in numbers:
            raise InputError("no")
        assert np.allclose(travel, 0.1 * np.array(numbers))
        self.seen += numbers

    def result(self):
        return {"numbers": np.zeros(self.shape)}


def feed(source, keeper, frame_range, progress=None):
    """Return the numbers of the frames that an operation receives."""
    run = Run(Plan(keeper, frames=frame_range, checked=False), source)
    try:
        run.complete(progress)
    finally:
        keeper.seen = run.operation.seen


@pytest.mark.parametrize("rows", [1, 3, 100])
@pytest.mark.parametrize("frame_range", [range(10), range(2, 7), range(9, 10), range(0)])
def test_each_frame_is_pushed_once_and_in_order(device, rows, frame_range):
    counts = []
    keeper = Keeper(device, rows)
    feed(Source(10), keeper, frame_range, counts.append)
    assert keeper.seen == list(frame_range)
    assert counts == sorted(counts)
    assert counts[-1:] == ([frame_range.stop] if frame_range else [])


@pytest.mark.parametrize("longest", [3, 100])
def test_frames_that_a_source_lends_are_pushed_where_they_lie(device, longest):
    """The last of them has to be read."""

    class Lender(Source):
        def read_in_place(self, limit):
            start, stop = self.next, min(self.next + min(limit, longest), self.shape[0] - 1)
            self.next = stop
            frames = np.broadcast_to(np.arange(start, stop, dtype="u2")[:, None, None], (stop - start, 3, 5))
            return (
                Block(frames, start, travel=0.1 * np.arange(start, stop), stays_valid=True)
                if len(frames)
                else None
            )

    keeper, counts = Keeper(device, 1), []
    feed(Lender(10), keeper, range(2, 10), counts.append)
    assert keeper.seen == list(range(2, 10))
    if device.info.shares_memory:
        assert counts == ([1, 2, 5, 8, 9, 10] if longest == 3 else [1, 2, 9, 10])


def test_a_source_that_ends_early_is_not_an_error(device):
    keeper = Keeper(device, 4)
    feed(Source(6), keeper, range(9))
    assert keeper.seen == list(range(6))


@pytest.mark.parametrize("fails", [0, 5, 9])
def test_a_failure_of_reading_is_reported_and_earlier_frames_were_pushed(device, fails):
    keeper = Keeper(device, 2)
    with pytest.raises(InputError, match=f"frame {fails} is damaged"):
        feed(Source(10, fails), keeper, range(10))
    assert keeper.seen == list(range(len(keeper.seen)))
    assert len(keeper.seen) <= fails


def test_what_fails_in_the_keeper_ends_the_reading(device):
    source = Source(100)
    with pytest.raises(InputError, match="no"):
        feed(source, Keeper(device, 2, fails=3), range(100))
    assert source.next < 10
