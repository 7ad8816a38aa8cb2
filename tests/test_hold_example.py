"""The closed loop of examples/hold.py on simulated time: it holds, and without its controller it does not."""

import runpy
from pathlib import Path

import pytest

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

EXAMPLE = Path(__file__).parents[1] / "examples" / "hold.py"


@pytest.fixture(scope="module")
def example():
    pytest.importorskip("matplotlib").use("agg")
    return runpy.run_path(str(EXAMPLE))


def check(record):
    """Assert that the object is held: by about 0.5 N, and without sliding."""
    assert min(record.force) > 0.48
    assert max(record.force) < 0.62
    assert max(record.slid) < 0.01


def test_the_object_is_held_with_about_half_a_newton(example):
    record = example["hold"]()
    check(record)
    assert record.onsets
    assert record.target[-1] > record.pull[-1] / example["FRICTION"] > record.target[0]
    low, high = example["LIMITS"]
    assert all(low <= travel <= high for travel in record.travel)
    assert max(map(abs, map(float.__sub__, record.force, record.measured))) < 0.02


def test_without_the_controller_it_is_not(example):
    record = example["hold"](controlled=False)
    with pytest.raises(AssertionError):
        check(record)
    assert min(record.force) < 0.42
    assert max(record.slid) > 0.3


def test_the_stage_stops_where_the_camera_is_lost(example, monkeypatch):
    clock, rigs, make_rig = SimulatedClock(), [], example["make_rig"]

    def make_failing(clock):
        rigs.append(make_rig(clock))
        clock.later(4.0, lambda: rigs[0].camera.lose())
        return rigs[0]

    monkeypatch.setitem(example["hold"].__globals__, "make_rig", make_failing)
    with pytest.raises(HardwareError, match="was lost"):
        example["hold"](clock=clock)
    assert rigs[0].start < clock.now()  # it holds already
    rest = rigs[0].machine.position(clock.now())
    clock.sleep(1.0)
    assert rigs[0].machine.position(clock.now()) == rest
    assert clock.threads == []


def test_an_object_that_goes_away_is_followed_to_the_limit_of_the_travel_only(example, monkeypatch):
    low, high = example["LIMITS"]
    monkeypatch.setitem(example["hold"].__globals__, "RECEDES", 10.0)
    travel = example["hold"]().travel
    assert max(travel) == high
    assert min(travel) >= low
