"""The live loop's policy, on simulated time."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from live_frames import paced, turn_header

from mirrorskin.engine.live import PUSHED, RAISED, SHOWN, UPDATED, WAITED, Loop
from mirrorskin.engine.live.status import Monitor
from mirrorskin.io import InputError, Result
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

COUNT, RATE = 40, 100.0
FRAMES = np.arange(COUNT, dtype=np.uint8)[:, np.newaxis, np.newaxis] * np.ones((2, 3), np.uint8)
PLACES = 0.1 * np.arange(COUNT)


@dataclass
class Slow:
    """A live run for which each push and update takes a time of its own."""

    clock: SimulatedClock
    push_time: float = 0.0
    update_time: float = 0.0
    every: int = 1
    updates_per_second: float = math.inf
    pushed: list[int] = field(default_factory=list)
    updates: list[int] = field(default_factory=list)
    spared: list[float] = field(default_factory=list)

    position = "phase"
    staging_buffer = np.empty((64, 2, 3), np.uint8)

    @property
    def operation(self):
        return self

    def push_block(self, block, part=slice(None)):
        frames = block.frames[part]
        assert np.array_equal(block.phase[part], PLACES[frames[:, 0, 0]])
        self.pushed += frames[:, 0, 0].tolist()
        self.clock.sleep(self.push_time)

    def maps(self, seconds):
        self.clock.sleep(self.update_time)
        self.updates.append(len(self.pushed))
        return Result(height=np.zeros((2, 3), np.float32))

    def idle_work(self, seconds):
        self.spared.append(seconds)


def make(slots=64, **how):
    clock = SimulatedClock()
    return paced(FRAMES, turn_header(), PLACES, RATE, clock, slots), Slow(clock, **how)


def test_a_quick_operation_gets_each_frame_at_once_and_updates_each_time():
    source, slow = make(push_time=0.001, update_time=0.002)
    status = Loop(source, slow).run()
    assert slow.pushed == list(range(COUNT))
    assert slow.updates == list(range(1, COUNT + 1))
    counts = status.frames, status.used, status.skipped, status.dropped, status.updates
    assert counts == (COUNT, COUNT, 0, 0, COUNT)
    assert status.rate == pytest.approx(RATE)
    assert status.latency[WAITED].median == pytest.approx(0, abs=1e-9)
    assert status.latency[PUSHED].p99 == pytest.approx(0.001)
    assert status.latency[UPDATED].p99 == pytest.approx(0.002)
    assert status.latency[SHOWN].median == pytest.approx(0.003)
    assert status.latency[RAISED].median == pytest.approx(0.003)


def test_a_slow_one_gets_all_that_waited_together():
    source, slow = make(update_time=0.035)
    status = Loop(source, slow).run()
    assert slow.pushed == list(range(COUNT))
    assert np.all(np.diff(slow.updates)[:-1] >= 3)
    assert status.skipped == 0


def test_frames_that_are_too_old_are_skipped_counted_and_marked():
    source, slow = make(update_time=0.095)
    marks = np.full(COUNT, -1)

    def mark(index, used):
        assert np.all(marks[index : index + len(used)] == -1)
        marks[index : index + len(used)] = used

    status = Loop(source, slow, latency=0.05, mark=mark).run()
    assert np.flatnonzero(marks).tolist() == slow.pushed
    assert np.count_nonzero(marks == 0) == status.skipped == COUNT - status.used > 5
    assert slow.pushed[-1] == COUNT - 1


def test_of_frames_that_are_all_too_old_the_newest_is_used():
    source, slow = make(update_time=0.5)
    source_now = source.now
    source.now = lambda: source_now() + 1.0
    status = Loop(source, slow, latency=0.05).run()
    assert status.used == status.updates == len(slow.pushed) > 0
    assert status.skipped == COUNT - status.used


def test_frames_lost_by_the_ring_are_reported_as_dropped():
    source, slow = make(slots=4, update_time=0.1)
    status = Loop(source, slow).run()
    assert status.dropped > 0
    assert status.frames + status.dropped == COUNT
    assert len(slow.pushed) == status.used


def test_updates_are_no_more_often_than_asked_and_the_last_frame_is_in_one():
    source, slow = make()
    status = Loop(source, slow, updates=10.0).run()
    assert status.updates == pytest.approx(COUNT / RATE * 10, abs=2)
    assert slow.updates[-1] == COUNT


def test_an_operation_that_asks_for_every_third_frame_gets_these():
    source, slow = make(update_time=0.033, every=3)
    status = Loop(source, slow).run()
    assert slow.pushed == list(range(0, COUNT, 3))
    assert status.used + status.skipped == COUNT


def test_time_to_spare_is_what_is_left_until_the_next_frame():
    source, slow = make(push_time=0.002, update_time=0.003)
    Loop(source, slow).run()
    assert slow.spared[0] == 0
    np.testing.assert_allclose(slow.spared[1:], 1 / RATE - 0.005 - 0.001, atol=1e-9)


def test_it_stops_when_asked():
    source, slow = make()
    status = Loop(source, slow, stop=lambda: len(slow.pushed) >= 7).run()
    assert status.frames == 7
    assert slow.updates[-1] == 7


def test_each_update_has_the_newest_frame_and_the_status_so_far():
    source, slow = make()
    updates = []
    Loop(source, slow, on_update=lambda *both: updates.append(both)).run()
    for number, (update, status) in enumerate(updates):
        assert (update.frames, status.used) == (number + 1, number + 1)
        assert (update.motion, update.position) == ("axial", PLACES[number])
        np.testing.assert_array_equal(update.picture, FRAMES[number])
    assert len(updates) == COUNT
    assert np.all(np.diff([update.time for update, _ in updates]) > 0)


def test_the_time_and_the_latency_of_an_update_are_those_of_the_exposure():
    source, slow = make(update_time=0.002)
    read, updates = source.read, []
    source.read = lambda out: None if (block := read(out)) is None else replace(block, lateness=0.04)
    Loop(source, slow, on_update=lambda update, status: updates.append(update)).run()
    np.testing.assert_allclose([update.time for update in updates], np.arange(COUNT) / RATE - 0.04)
    np.testing.assert_allclose([update.latency for update in updates], 0.042)
    assert updates[-1].latency_p99 == pytest.approx(0.042)
    assert len(updates) == COUNT


@pytest.mark.parametrize("wrong", [{"latency": -0.1}, {"updates": -1.0}, {"latency": math.nan}])
def test_an_impossible_latency_or_rate_is_refused(wrong):
    source, slow = make()
    with pytest.raises(InputError, match=r"above 0|at least 0"):
        Loop(source, slow, **wrong).run()


def test_latencies_are_of_the_last_few_thousand_times():
    monitor = Monitor()
    assert math.isnan(monitor.status().latency[PUSHED].median)
    monitor.time(PUSHED, *[5.0] * 10_000, math.nan)
    monitor.time(PUSHED, *(np.arange(1, 4097) / 4096).tolist())
    latency = monitor.status(fresh=True).latency[PUSHED]
    assert latency.median == pytest.approx(0.5, abs=1e-3)
    assert latency.p99 == pytest.approx(0.99, abs=1e-3)
