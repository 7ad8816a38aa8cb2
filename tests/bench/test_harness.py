"""The harness: turns, medians, and no timing of what does not agree."""

import numpy as np
import pytest

from mirrorskin.bench import onset, run_onset, take_turns


def test_works_take_turns_after_a_warm_up():
    calls = []
    timings = take_turns({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=3)
    assert calls == ["a", "b"] * 4
    for timing in timings.values():
        assert timing.rounds == 3
        assert 0 <= timing.lower <= timing.median <= timing.upper


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_the_onset_case_runs_on_every_device(device, dtype):
    rows = run_onset(device, (5, 33, 47), np.dtype(dtype), rounds=1)
    assert rows[0].name == "read limit"
    moved = 5 * 33 * 47 * np.dtype(dtype).itemsize
    assert {row.bytes for row in rows} == {moved, 2 * moved}


def test_nothing_is_timed_when_the_maps_differ(device, monkeypatch):
    monkeypatch.setattr(onset, "_numpy_onset", lambda frames: np.zeros(frames.shape[1:], np.int32))
    with pytest.raises(RuntimeError, match="do not agree"):
        run_onset(device, (5, 9, 7), np.dtype(np.uint8), rounds=1)


def test_the_spread_is_the_quartiles(monkeypatch):
    ticks = iter(np.repeat(np.cumsum([0, *range(9)]), 2)[1:])
    monkeypatch.setattr("time.perf_counter", lambda: float(next(ticks)))
    timing = take_turns({"a": lambda: None}, rounds=9)["a"]
    assert (timing.lower, timing.median, timing.upper) == (2, 4, 6)
