"""Steps, lengths and slopes along sections, in closed form."""

import numpy as np
import pytest
from height_maps import cap, places, result_of

from mirrorskin import engine, io
from mirrorskin.engine.metrology.sections import section, step_height

SHAPE, SIZE = (41, 121), (0.05, 0.05)
NAN = np.nan


def stair(rise=0.2, lean=0.0, ramp=0.0, at=0.31):
    """A step up along x, on a plane that leans; its ramp begins and ends so far from its middle."""
    x, _ = places(SHAPE, SIZE)
    up = np.clip((x - at + ramp) / max(2 * ramp, 1e-9), 0, 1)
    return (x * np.sin(lean) + rise * up) / np.cos(lean)


def across(height, **more):
    return section(result_of(height, SIZE, **more), (-2.5, 0.0), (2.5, 0.0))


@pytest.mark.parametrize("rise", [0.2, -0.013])
@pytest.mark.parametrize("ramp", [0.0, 0.3])
@pytest.mark.parametrize("lean", [0.0, 0.2])
def test_a_step_has_its_height_at_right_angles_to_its_levels(rise, ramp, lean):
    found = step_height(across(stair(rise, lean, ramp)))
    assert found.height.value == pytest.approx(rise, rel=1e-3)
    assert found.slope.value == pytest.approx(np.degrees(lean), abs=1e-3)
    assert abs(found.place.value - 2.81) < 0.03 + ramp / 2


def test_a_step_down_is_negative_and_one_the_other_way_is_up():
    height = stair(-0.1)
    assert step_height(across(height)).height.value == pytest.approx(-0.1)
    back = section(result_of(height, SIZE), (2.5, 0.0), (-2.5, 0.0))
    assert step_height(back).height.value == pytest.approx(0.1)


@pytest.mark.parametrize("alike", [False, True])
def test_the_uncertainty_of_a_step_covers_what_went_wrong(alike):
    rng = np.random.default_rng(8)
    pulls = []
    for _ in range(100):
        error = rng.standard_normal(SHAPE[1] + 8)
        error = np.convolve(error, np.ones(9) / 3, "valid") if alike else error[:-8]
        found = step_height(across(stair() + 0.002 * error)).height
        pulls.append((found.value - 0.2) / found.sigma)
    assert np.mean(np.abs(pulls) < 2) > 0.88
    assert np.sqrt(np.mean(np.square(pulls))) > 0.5


def test_filled_heights_and_holes_are_no_part_of_a_step():
    height = stair()
    filled = np.zeros(SHAPE, np.uint8)
    height[:, 30:50] = NAN
    height[:, 80:90], filled[:, 80:90] = 5.0, 1
    assert step_height(across(height, filled=filled)).height.value == pytest.approx(0.2)


def test_what_is_no_step_is_refused():
    with pytest.raises(io.InputError, match="a smooth curve fits it better"):
        step_height(across(cap(SHAPE, SIZE, 5.0, 3.0)))
    with pytest.raises(io.InputError, match="at least 8 measured samples"):
        step_height(across(np.where(places(SHAPE, SIZE)[0] < -2.19, 1.0, NAN)))
    with pytest.raises(io.InputError, match="no pixel size"):
        step_height(section(result_of(stair(), x=None, y=None)))


def measured(height, ends, **more):
    return engine.measure(result_of(height, SIZE, **more), section=ends)


def test_lengths_and_slope_are_those_between_the_ends():
    x, _ = places(SHAPE, SIZE)
    told = measured(0.75 * x, ((-1.0, 0.5), (1.0, 0.5)), sigma=0.01).quantities
    assert told["section length"].value == pytest.approx(2)
    assert told["height difference"].value == pytest.approx(1.5)
    assert told["distance in space"].value == pytest.approx(2.5)
    assert told["slope"].value == pytest.approx(np.degrees(np.arctan(0.75)))
    assert told["height difference"].sigma == pytest.approx(0.01 * np.sqrt(2), rel=1e-4)
    assert told["distance in space"].sigma == pytest.approx(0.6 * 0.01 * np.sqrt(2), rel=1e-4)
    assert told["slope"].sigma == pytest.approx(np.degrees(0.01 * np.sqrt(2) * 2 / 2.5**2), rel=1e-4)
    assert "step height" not in told


def test_a_step_is_told_where_there_is_one_and_else_that_there_is_none():
    ends = (-2.5, 0.0), (2.5, 0.0)
    assert measured(stair(), ends).quantities["step height"].value == pytest.approx(0.2)
    flat = 0.001 * np.random.default_rng(9).standard_normal(SHAPE)
    found = measured(flat, ends)
    assert "step height" not in found.quantities
    assert any(note.startswith("no step along the section") for note in found.notes)


def test_where_an_end_has_no_height_the_last_one_that_has_counts_and_that_is_told():
    x, _ = places(SHAPE, SIZE)
    height = np.where(x < 1.02, 0.75 * x, NAN)
    found = measured(height, ((-1.0, 0.0), (2.0, 0.0)))
    assert found.quantities["section length"].value == pytest.approx(3)
    assert found.quantities["height difference"].value == pytest.approx(1.5)
    assert found.quantities["distance in space"].value == pytest.approx(2.5)
    assert any(note.startswith("section: an end has no measured height") for note in found.notes)
    assert not any(note.startswith("section:") for note in measured(height, ((-1.0, 0.0), (1.0, 0.0))).notes)


def test_a_section_without_heights_is_refused():
    height = np.where(places(SHAPE, SIZE)[0] < 0, 1.0, NAN)
    with pytest.raises(io.InputError, match="fewer than two measured heights"):
        measured(height, ((1.0, 0.0), (2.0, 0.0)))
