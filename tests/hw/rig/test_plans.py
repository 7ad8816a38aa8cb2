import math

import numpy as np
import pytest
from msgspec import structs
from rig_fakes import settings

from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.rig.plans import AxialPlan, HorizontalPlan, RockPlan, TwistPlan, VerticalPlan, check_plan
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.io import InputError

# -5 to 3 mm, press 2 mm, 0.1 rad; x and y to 1 mm, twist to 0.5 rad; 20 mm/s, 20 rad/s
STAGE = settings().stage
NAN, INF = math.nan, math.inf

ways = pytest.mark.parametrize(
    ("length", "speed", "acceleration"),
    [(1.0, 0.5, 10.0), (1.0, 100.0, 3.0), (2e-3, 0.1, 5.0), (6.0, 2.0, 1e5)],
)


@ways
def test_the_distance_is_the_integral_of_the_speed(length, speed, acceleration):
    path = Trapezoid(length, speed, acceleration)
    time = np.linspace(0, path.duration, 200_001)
    pace = np.minimum(np.minimum(acceleration * time, acceleration * (time[-1] - time)), speed)
    gone = np.concatenate([[0], np.cumsum((pace[1:] + pace[:-1]) / 2 * np.diff(time))])
    assert gone[-1] == pytest.approx(length, rel=1e-6)
    np.testing.assert_allclose(path.place(time), gone, atol=1e-6 * length)


def test_a_press_in_steps_takes_every_place_to_its_end():
    plan = VerticalPlan(0.1, 0.7, step=0.1)
    np.testing.assert_allclose(plan.values, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    assert [place.travel for place in plan.places] == list(plan.values)
    assert plan.first == Position(0.1)


@ways
def test_legs_follow_one_another(length, speed, acceleration):
    single, three = Trapezoid(length, speed, acceleration), Trapezoid(3 * length, speed, acceleration, 3)
    assert three.duration == pytest.approx(3 * single.duration)
    time = np.linspace(0, single.duration, 101)
    for number in range(3):
        later = number * single.duration + time[1:-1]
        np.testing.assert_allclose(
            three.place(later), number * length + single.place(time[1:-1]), atol=1e-9 * length
        )
        np.testing.assert_allclose(three.time(three.place(later)), later, atol=1e-6 * single.duration)


def test_strokes_go_down_and_up_between_two_depths():
    plan = VerticalPlan(0.5, 1.2, step=0.3, strokes=3)
    np.testing.assert_allclose(plan.values, [0.5, 0.8, 1.1, 0.8, 0.5, 0.8, 1.1])
    np.testing.assert_allclose([place.travel for place in plan.places], plan.values)
    swept = VerticalPlan(0.5, 1.2, speed=0.5, strokes=3)
    assert [place.travel for place in swept.ends] == pytest.approx([1.2, 0.5, 1.2])
    assert swept.path.length == pytest.approx(2.1)


@pytest.mark.parametrize("strokes", [0, 10_001])
def test_impossible_strokes_are_refused(strokes):
    with pytest.raises(InputError, match="strokes are not possible"):
        VerticalPlan(0.0, 1.0, step=0.5, strokes=strokes)


def test_a_turn_in_steps_does_not_take_its_beginning_twice():
    np.testing.assert_allclose(
        np.degrees(AxialPlan(1.0, 0.04, phase_step=math.radians(45)).values), np.arange(0, 360, 45)
    )
    assert len(AxialPlan(1.0, 0.04, turns=3, phase_step=math.tau / 7).values) == 21


def test_a_rotation_leans_by_its_tilt_towards_each_phase():
    plan = AxialPlan(1.0, 0.04, phase_step=math.radians(30))
    for place, phase in zip(plan.places, plan.values, strict=True):
        assert place.travel == 1.0
        assert place.tilt == pytest.approx(0.04)
        assert math.cos(place.phase - phase) == pytest.approx(1)


def test_a_slide_is_straight_and_its_displacement_is_stored():
    plan = HorizontalPlan(1.5, 0.5, math.radians(30), step=0.25)
    along = [math.cos(math.radians(30)), math.sin(math.radians(30))]
    np.testing.assert_allclose(plan.values, np.outer([0, 0.25, 0.5], along), atol=1e-12)
    assert [(place.x, place.y) for place in plan.places] == [tuple(row) for row in plan.values]
    assert {place.travel for place in plan.places} == {1.5}
    assert plan.first == Position(1.5)


def test_a_slide_along_an_axis_needs_no_other():
    stage = structs.replace(STAGE, x=None, twist=None)
    check_plan(HorizontalPlan(1.0, 0.5, math.pi / 2, step=0.5), stage, "stage")
    with pytest.raises(InputError, match=r"no axis of x.* add \[stage.x\]"):
        check_plan(HorizontalPlan(1.0, 0.5, math.pi / 4, step=0.5), stage, "stage")


def test_a_rocking_body_leans_from_one_side_to_the_other_about_one_axis():
    plan = RockPlan(1.0, 0.06, math.radians(30), step=0.02)
    np.testing.assert_allclose(plan.values, 0.02 * np.arange(-3, 4), atol=1e-12)
    for place, tilt in zip(plan.places, plan.values, strict=True):
        assert (place.travel, place.tilt) == (1.0, pytest.approx(abs(tilt)))
        along, across = math.cos(place.phase - plan.phase), math.sin(place.phase - plan.phase)
        assert (place.tilt * along, place.tilt * across) == (pytest.approx(tilt), pytest.approx(0))
        assert plan.recorded(np.array([plan.distance_of(place, 0.0)])) == pytest.approx(tilt)
    assert plan.constants == {"phase": math.radians(30)}


@pytest.mark.parametrize("sense", [1, -1])
def test_a_twist_turns_by_its_sign(sense):
    plan = TwistPlan(1.0, sense * 0.4, step=0.1)
    np.testing.assert_allclose(plan.values, sense * np.array([0, 0.1, 0.2, 0.3, 0.4]))
    assert [place.twist for place in plan.places] == list(plan.values)
    assert plan.distance_of(Position(1.0, twist=sense * 0.3), 0.0) == pytest.approx(0.3)
    assert plan.distance_of(Position(1.0, twist=-sense * 1e-4), 0.0) == 0


@pytest.mark.parametrize(
    ("plan", "limit"),
    [
        (HorizontalPlan(2.5, 0.5, step=0.1), "2 mm"),
        (RockPlan(1.0, 0.11, step=0.11), "exceeds the maximum"),
        (RockPlan(1.0, 0.05, speed=21.0), "too fast for the axis of pitch"),
        (HorizontalPlan(1.0, 1.2, step=0.1), "1.2 mm of x is beyond"),
        (HorizontalPlan(1.0, 1.2, -math.pi / 2, speed=0.1), "-1.2 mm of y is beyond"),
        (TwistPlan(1.0, -0.6, step=0.1), "degrees of twist is beyond"),
        (HorizontalPlan(1.0, 0.5, speed=21.0), "too fast"),
        (TwistPlan(1.0, 0.4, speed=21.0), "too fast for the axis of twist; the maximum is 10.47 rad/s"),
        (VerticalPlan(-6.0, 1.0, speed=1), "-5"),
        (VerticalPlan(0.0, 2.5, speed=1), "2 mm"),
        (VerticalPlan(0.0, 3.5, step=1), "3 mm"),
        (AxialPlan(2.5, 0.02, rate=1), "2 mm"),
        (AxialPlan(1.0, math.radians(6), rate=1), "6 degrees"),
        (AxialPlan(1.0, math.radians(6), phase_step=1), "6 degrees"),
    ],
)
def test_a_plan_beyond_the_limits_is_refused(plan, limit):
    with pytest.raises(InputError, match=limit):
        check_plan(plan, STAGE, "stage")


@pytest.mark.parametrize(
    "values",
    [
        (0, 0, 1, None),
        (1, 0, 1, None),
        (NAN, 1, 1, None),
        (0, INF, 1, None),
        (0, 1, None, None),
        (0, 1, 1, 1),
        (0, 1, 0, None),
        (0, 1, -1, None),
        (0, 1, None, 0),
        (0, 1, None, NAN),
        (0, 1, 2, None),
        (0, 1, 1e-9, None),
    ],
)
def test_an_impossible_press_is_refused(values):
    with pytest.raises(InputError):
        VerticalPlan(*values)


@pytest.mark.parametrize(
    "values",
    [
        (NAN, 0.04, 1, 1, None),
        (1, 0, 1, 1, None),
        (1, -0.04, 1, 1, None),
        (1, 0.04, 0, 1, None),
        (1, 0.04, INF, None, 1),
        (1, 0.04, NAN, None, 1),
        (1, 0.04, -1, None, 1),
        (1, 0.04, 1, None, None),
        (1, 0.04, 1, 1, 1),
        (1, 0.04, 1, None, -1),
        (1, 0.04, 1, 2.5, None),
        (1, 0.04, 1, 1e-9, None),
    ],
)
def test_an_impossible_rotation_is_refused(values):
    with pytest.raises(InputError):
        AxialPlan(*values)


@pytest.mark.parametrize(
    ("make", "wrong"),
    [
        (HorizontalPlan, {"distance": 0}),
        (HorizontalPlan, {"distance": 1, "direction": NAN}),
        (HorizontalPlan, {"distance": 1, "press": INF}),
        (HorizontalPlan, {"distance": 1, "wait": -1}),
        (HorizontalPlan, {"distance": 1, "step": 2}),
        (HorizontalPlan, {"distance": 1, "speed": 1}),
        (RockPlan, {"tilt": 0}),
        (RockPlan, {"tilt": 0.1, "phase": NAN}),
        (RockPlan, {"tilt": 0.1, "step": 0.3}),
        (TwistPlan, {"angle": 0}),
        (TwistPlan, {"angle": NAN}),
        (TwistPlan, {"angle": 1, "wait": INF}),
        (TwistPlan, {"angle": 1, "step": -0.1}),
    ],
)
def test_an_impossible_slide_or_twist_is_refused(make, wrong):
    with pytest.raises(InputError):
        make(**{"press": 1.0, "step": 0.5, **wrong})


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (VerticalPlan(0.0, 1.0, speed=20.1), "too fast for the axis of travel"),
        (VerticalPlan(0.0, 1.0, speed=0.016), "too slow for the controller"),
        (AxialPlan(1.0, 0.04, rate=80.0), "too fast for pitch and roll"),
        (AxialPlan(1.0, 0.04, turns=1e4, rate=1e-4), "too slow for the controller"),
        (AxialPlan(1.0, 0.11, rate=1.0), "exceeds the maximum"),
        (VerticalPlan(0.0, 2.5, speed=1.0), "exceeds the maximum"),
        (VerticalPlan(0.0, 2.5, step=1.0), "exceeds the maximum"),
    ],
)
def test_what_the_stage_cannot_do_is_refused(plan, message):
    with pytest.raises(InputError, match=message):
        check_plan(plan, STAGE, "stage")


def test_arcs_that_grbl_does_not_have_are_refused_and_steps_are_not():
    stage = structs.replace(STAGE, pitch=structs.replace(STAGE.pitch, letter="A"), x=None)
    with pytest.raises(InputError, match="not support arcs in the axes A and Y"):
        check_plan(AxialPlan(1.0, 0.04, rate=1.0), stage, "stage")
    check_plan(AxialPlan(1.0, 0.04, phase_step=1.0), stage, "stage")


@pytest.mark.parametrize("turns", [1.0, 3.0])
def test_a_turn_in_steps_has_as_many_frames_as_it_has_places(turns):
    plan = AxialPlan(1.0, 0.04, turns=turns, phase_step=math.tau / 8)
    assert plan.frames_a_turn(math.nan) == pytest.approx(len(plan.values) / turns)
    assert plan.frames_a_turn(math.nan, each=3) == pytest.approx(3 * len(plan.values) / turns)


@pytest.mark.parametrize("rate", [0.0, math.nan, math.inf])
def test_how_many_frames_a_turn_has_needs_the_cameras_rate(rate):
    with pytest.raises(InputError, match="give the camera's rate"):
        AxialPlan(1.0, 0.04, rate=0.5).frames_a_turn(rate)
