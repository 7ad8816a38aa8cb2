from __future__ import annotations

import math

import pytest

from mirrorskin.hw.base.stage import Limits, Position
from mirrorskin.io import InputError

LIMITS = Limits(travel=(-2.0, 10.0), tilt=math.radians(3), press=4.0)
SIDEWAYS = Limits((-2.0, 10.0), 0.0, 4.0, x=(-1.0, 2.0), twist=(math.radians(-10), math.radians(20)))


def test_a_lean_has_a_half_angle_and_a_phase():
    place = Position(pitch=0.03 * math.cos(2), roll=0.03 * math.sin(2))
    assert place.tilt == pytest.approx(0.03)
    assert place.phase == pytest.approx(2)
    assert Position().phase == 0


@pytest.mark.parametrize(
    "place",
    [
        Position(-2),
        Position(4),
        Position(0, math.radians(3)),
        Position(0, math.radians(-3)),
        Position(1, math.radians(3) * math.cos(1), math.radians(3) * math.sin(1)),
    ],
)
def test_what_is_on_a_limit_is_within(place):
    LIMITS.check(place, "it")


@pytest.mark.parametrize(
    ("place", "limit"),
    [
        (Position(-2.001), "range is -2 to 10 mm"),
        (Position(11), "range is -2 to 10 mm"),
        (Position(4.001), "exceeds the maximum of 4 mm"),
        (Position(math.nan), "finite"),
        (Position(math.inf), "finite"),
        (Position(0, math.radians(3.01)), "maximum of 3;"),
        (Position(0, math.radians(2.5), math.radians(2.5)), "maximum of 3;"),
        (Position(0, math.nan), "finite"),
    ],
)
def test_what_is_beyond_a_limit_is_refused_by_its_name(place, limit):
    with pytest.raises(InputError, match=f"^rig: .*{limit}"):
        LIMITS.check(place, "rig")


@pytest.mark.parametrize(
    ("place", "excess"),
    [
        (Position(-2), 0),
        (Position(4, math.radians(3)), 0),
        (Position(-2.5), 0.5),
        (Position(4.25), 0.25),
        (Position(11), 7),
        (Position(5, math.radians(3.5)), 1),
        (Position(4.25, 0, math.radians(-3.5)), 0.5),
    ],
)
def test_how_far_a_place_is_beyond_the_limits_is_known(place, excess):
    assert LIMITS.excess(place) == pytest.approx(excess)


@pytest.mark.parametrize(
    ("place", "limit"),
    [
        (Position(x=2.01), "2.01 mm of x is beyond the axis, whose range is -1 to 2 mm"),
        (Position(x=math.nan), "beyond the axis"),
        (Position(twist=math.radians(-10.5)), "-10.5 degrees of twist is beyond"),
        (Position(y=0.1), r"no axis of y, which should move to 0.1 mm; add \[stage.y\]"),
    ],
)
def test_a_move_sideways_beyond_its_limit_is_refused(place, limit):
    with pytest.raises(InputError, match=f"^rig: .*{limit}"):
        SIDEWAYS.check(place, "rig")


def test_moves_sideways_count_in_how_far_a_place_is_beyond_the_limits():
    assert SIDEWAYS.excess(Position(x=-1.0, twist=math.radians(20))) == pytest.approx(0)
    assert SIDEWAYS.excess(Position(x=-1.5)) == pytest.approx(0.5)
    assert SIDEWAYS.excess(Position(twist=math.radians(22))) == pytest.approx(2)


def test_the_nearest_place_within_the_limits_is_upright():
    assert SIDEWAYS.nearest(Position(5.0, 0.01, 0.0, 3.0, 0.1, -1.0)) == Position(
        4.0, x=2.0, twist=math.radians(-10)
    )
