"""The harness: order of turns, medians, device times, and no timing of wrong answers."""

import numpy as np
import pytest

from mirrorskin.cli.commands.bench import timing
from mirrorskin.cli.commands.bench.timing import Work, take_turns
from mirrorskin.kernels.profile import Profile


class Clock:
    """A clock that stands still unless a work or a pause moves it."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(timing.time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(timing.time, "sleep", self.move)

    def move(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def test_works_take_turns_after_a_warm_up():
    calls = []
    works = {"a": Work(lambda: calls.append("a")), "b": Work(lambda: calls.append("b"))}
    measured = take_turns(works, 3, Profile())
    assert calls == ["a", "b"] * 4
    assert {name: row.wall.rounds for name, row in measured.items()} == {"a": 3, "b": 3}


def test_the_spread_is_the_quartiles_and_the_first_call_is_separate(clock):
    seconds = iter([100, *np.random.default_rng(0).permutation(9)])
    row = take_turns({"a": Work(lambda: clock.move(next(seconds)))}, 9, Profile())["a"]
    # Nine turns, of 0 to 8 seconds, are not all taken: ten seconds of patience end them.
    assert row.first == 100
    assert 3 <= row.wall.rounds < 9
    few = iter([100, 0, 1, 2, 3, 4, *[0] * 4])
    row = take_turns({"a": Work(lambda: clock.move(next(few) / 10))}, 5, Profile())["a"]
    assert (row.wall.lower, row.wall.median, row.wall.upper) == pytest.approx((0.1, 0.2, 0.3))


def test_a_slow_work_leaves_its_turns_to_the_others(clock):
    works = {"slow": Work(lambda: clock.move(60)), "quick": Work(lambda: clock.move(0.1))}
    measured = take_turns(works, 15, Profile())
    assert measured["slow"].wall.rounds == 3
    assert measured["quick"].wall.rounds == 15


def test_nothing_is_timed_before_the_check():
    calls = []

    def check(results):
        assert results == {"a": 1, "b": 2}
        raise RuntimeError("wrong")

    works = {"a": Work(lambda: calls.append("a") or 1), "b": Work(lambda: calls.append("b") or 2)}
    with pytest.raises(RuntimeError, match="wrong"):
        take_turns(works, 3, Profile(), check)
    assert calls == ["a", "b"]


def test_device_times_are_reported_by_kind_and_by_kernel(clock):
    profile = Profile()
    profile.add("kernel", "before", 99.0)
    turns = iter([1, 2, 3, 4])

    def work():
        turn = next(turns)
        if turn == 1:
            profile.add("compile", "file", 0.5)
        profile.add("upload", "frames", 0.01 * turn)
        for name in ("scan", "heights", "heights"):
            profile.add("kernel", name, 0.1 * turn)
        clock.move(turn)

    row = take_turns({"a": Work(work, 8, 2)}, 3, profile)["a"]
    assert row.compile == 0.5
    assert row.kernels == pytest.approx({"scan": 0.3, "heights": 0.6})
    assert set(row.device) == {"upload", "kernel"}
    assert row.kernel == pytest.approx(0.9)
    assert row.device["upload"].median == pytest.approx(0.03)
    assert row.wall.median == 3
    assert (row.name, row.bytes, row.frames) == ("a", 8, 2)


def test_a_work_without_a_device_has_no_account_of_it(clock):
    row = take_turns({"a": Work(lambda: clock.move(1))}, 3, Profile())["a"]
    assert row.device == {}
    assert np.isnan(row.kernel)


def test_what_is_done_before_a_work_is_not_timed(clock):
    before = []
    work = Work(lambda: clock.move(1), before=lambda: before.append(clock.move(50)))
    assert take_turns({"a": work}, 3, Profile())["a"].wall.upper == 1
    assert len(before) == 4
