"""Cross-sections, and steps, lengths and slopes along them, in closed form."""

import contextlib

import numpy as np
import pytest
from height_maps import cap, places, result_of

from mirrorskin import engine, io
from mirrorskin.engine.metrology import Section, groove, section, step_height

SIZE = (0.1, 0.25)
SHAPE = (21, 33)
LONG, FINE = (41, 121), (0.05, 0.05)
NAN = np.nan


def slope(shape=SHAPE, size=SIZE):
    """A plane: between pixels it is what it is at pixels, interpolated."""
    x, y = places(shape, size)
    return 0.3 * x - 0.7 * y + 1


def test_a_plane_is_a_line_between_any_two_points():
    start, end = (-1.43, -2.2), (1.52, 1.9)
    profile = section(result_of(slope(), SIZE), start, end)
    assert (profile.x[0], profile.y[0]) == pytest.approx(start)
    assert (profile.x[-1], profile.y[-1]) == pytest.approx(end)
    assert profile.distance[-1] == pytest.approx(np.hypot(2.95, 4.1))
    assert np.diff(profile.distance) == pytest.approx(profile.distance[1])
    assert profile.height == pytest.approx(0.3 * profile.x - 0.7 * profile.y + 1, abs=1e-6)
    assert profile.unit == "mm"
    outside = section(result_of(slope(), SIZE), (0.0, 0.0), (3.0, 0.0))
    np.testing.assert_array_equal(np.isnan(outside.height), outside.x > 1.6 + 1e-9)


def test_without_ends_it_is_the_row_of_the_highest_point():
    height = cap(SHAPE, SIZE, 5.0, 2.0, (0.31, -0.5, 0.0))
    profile = section(result_of(height, SIZE, sigma=0.002))
    row = 12  # y = (10 - 12) * 0.25 = -0.5
    np.testing.assert_array_equal(profile.height, np.float32(height[row]))
    assert profile.x == pytest.approx((np.arange(33) - 16) * 0.1)
    assert profile.y == pytest.approx(-0.5)
    assert profile.distance == pytest.approx(np.arange(33) * 0.1)
    np.testing.assert_array_equal(np.isfinite(profile.sigma), np.isfinite(profile.height))
    assert np.nanmax(profile.sigma) == pytest.approx(0.002)


def test_a_spike_is_not_the_highest_point():
    height = cap(SHAPE, SIZE, 5.0, 2.0)
    height[3, 5] = 9.0
    assert section(result_of(height, SIZE)).y[0] == 0


def test_what_was_filled_may_be_the_highest_point_and_is_reported():
    height = cap(SHAPE, SIZE, 5.0, 2.0)
    filled = np.asarray(height > -0.05)
    result = result_of(height, SIZE, sigma=0.001, filled=filled.astype(np.uint8))
    profile = section(result)
    assert profile.y[0] == 0
    np.testing.assert_array_equal(profile.filled, filled[10])
    assert np.isnan(profile.sigma[profile.filled]).all()
    assert np.isfinite(profile.height[profile.filled]).all()


def test_next_to_a_hole_nothing_is_reported():
    height = slope()
    height[10, 16] = NAN
    level = section(result_of(height, SIZE), (-1.0, 0.125), (1.0, 0.125))  # between rows 9 and 10
    assert np.flatnonzero(np.isnan(level.height)).tolist() == [10]
    assert section(result_of(height, SIZE), (-1.0, 0.25), (1.0, 0.25)).height[10] == pytest.approx(
        height[9, 16]
    )


def test_a_section_has_no_height_between_two_components():
    height = np.zeros(SHAPE)
    height[:, 20:] = 5.0
    component = (height > 0).astype(np.int32)
    result = result_of(height, SIZE, component=component, offset_unknown=np.ones(2, np.uint8))
    profile = section(result, (-1.05, 0.0), (1.05, 0.0))  # midway between pixels
    assert set(profile.height[np.isfinite(profile.height)]) == {0.0, 5.0}
    assert np.isnan(profile.height).sum() == 1


def test_without_a_pixel_size_it_is_in_pixels():
    result = result_of(cap(SHAPE, (1, 1), 50.0, 9.0), x=None, y=None)
    profile = section(result)
    assert profile.unit == "px"
    np.testing.assert_array_equal(profile.distance, np.arange(33))
    with pytest.raises(io.InputError, match=r"no pixel size to place a section by: .* --pixel-size"):
        section(result, (0.0, 0.0), (1.0, 0.0))


@pytest.mark.parametrize("shape", [(1, 1), (7, 1)])
@pytest.mark.parametrize("sized", [True, False])
def test_tiny_pictures_have_sections(shape, sized):
    result = result_of(np.ones(shape), **({} if sized or shape == (1, 1) else {"x": None, "y": None}))
    profile = section(result)
    assert len(profile.height) == shape[1]
    assert (profile.height == 1).all()


def test_what_cannot_be_cut_is_refused():
    with pytest.raises(io.InputError, match="has no heights"):
        section(io.Result(azimuth=np.zeros((2, 2), np.float32)))
    with pytest.raises(io.InputError, match="2 turns"):
        section(io.Result(height=np.zeros((2, 3, 3), np.float32)))
    with pytest.raises(io.InputError, match="no height to look for"):
        section(result_of(np.full((3, 3), NAN)))
    with pytest.raises(io.InputError, match="both ends, or neither"):
        section(result_of(slope(), SIZE), (0.0, 0.0))
    with pytest.raises(io.InputError, match="one point"):
        section(result_of(slope(), SIZE), (0.0, 0.0), (0.0, 0.0))
    for far in (1e300, 1e3):
        with pytest.raises(io.InputError, match="far outside of the picture"):
            section(result_of(slope(), SIZE), (0.0, 0.0), (far, 0.0))


def stair(rise=0.2, lean=0.0, ramp=0.0, at=0.31):
    """A step up along x, on a plane that leans; its ramp begins and ends so far from its middle."""
    x, _ = places(LONG, FINE)
    up = np.clip((x - at + ramp) / max(2 * ramp, 1e-9), 0, 1)
    return (x * np.sin(lean) + rise * up) / np.cos(lean)


def across(height, **more):
    return section(result_of(height, FINE, **more), (-2.5, 0.0), (2.5, 0.0))


@pytest.mark.parametrize("rise", [0.2, -0.013])
@pytest.mark.parametrize("ramp", [0.0, 0.3])
@pytest.mark.parametrize("lean", [0.0, 0.2])
def test_a_step_has_its_height_at_right_angles_to_its_levels(rise, ramp, lean):
    step = step_height(across(stair(rise, lean, ramp)))
    assert step.height.value == pytest.approx(rise, rel=1e-3)
    assert step.slope.value == pytest.approx(np.degrees(lean), abs=1e-3)
    assert abs(step.place.value - 2.81) < 0.03 + ramp / 2


@pytest.mark.parametrize("alike", [False, True])
def test_the_uncertainty_of_a_step_covers_what_went_wrong(alike):
    rng = np.random.default_rng(8)
    pulls = []
    for _ in range(60):
        error = rng.standard_normal(LONG[1] + 8)
        error = np.convolve(error, np.ones(9) / 3, "valid") if alike else error[:-8]
        height = step_height(across(stair() + 0.002 * error)).height
        pulls.append((height.value - 0.2) / height.sigma)
    assert np.mean(np.abs(pulls) < 2) > 0.88
    assert np.sqrt(np.mean(np.square(pulls))) > 0.5


def test_filled_heights_and_holes_are_no_part_of_a_step():
    height = stair()
    filled = np.zeros(LONG, np.uint8)
    height[:, 30:50] = NAN
    height[:, 80:90], filled[:, 80:90] = 5.0, 1
    assert step_height(across(height, filled=filled)).height.value == pytest.approx(0.2)


def test_what_is_not_a_step_is_refused():
    with pytest.raises(io.InputError, match="a smooth curve fits it better"):
        step_height(across(cap(LONG, FINE, 5.0, 3.0)))
    with pytest.raises(io.InputError, match="at least 8 measured samples"):
        step_height(across(np.where(places(LONG, FINE)[0] < -2.19, 1.0, NAN)))
    with pytest.raises(io.InputError, match="no pixel size"):
        step_height(section(result_of(stair(), x=None, y=None)))


def measured(height, ends, **more):
    return engine.measure(result_of(height, FINE, **more), section=ends)


def test_lengths_and_slope_are_those_between_the_ends():
    x, _ = places(LONG, FINE)
    values = measured(0.75 * x, ((-1.0, 0.5), (1.0, 0.5)), sigma=0.01).quantities
    assert values["section length"].value == pytest.approx(2)
    assert values["height difference"].value == pytest.approx(1.5)
    assert values["distance in space"].value == pytest.approx(2.5)
    assert values["slope"].value == pytest.approx(np.degrees(np.arctan(0.75)))
    assert values["height difference"].sigma == pytest.approx(0.01 * np.sqrt(2), rel=1e-4)
    rise, run = 0.01 * np.sqrt(2), FINE[0] / np.sqrt(6)  # the ends are known within half a pixel
    assert values["distance in space"].sigma == pytest.approx(np.hypot(0.6 * rise, 0.8 * run), rel=1e-4)
    assert values["slope"].sigma == pytest.approx(np.degrees(np.hypot(0.8 * rise, 0.6 * run) / 2.5), rel=1e-4)
    assert "step height" not in values


def test_a_step_is_reported_or_that_there_is_none():
    ends = (-2.5, 0.0), (2.5, 0.0)
    assert measured(stair(), ends).quantities["step height"].value == pytest.approx(0.2)
    flat = 0.001 * np.random.default_rng(9).standard_normal(LONG)
    measured_ = measured(flat, ends)
    assert "step height" not in measured_.quantities
    assert any(note.startswith("no step along the section") for note in measured_.notes)


def test_a_section_without_heights_is_refused():
    height = np.where(places(LONG, FINE)[0] < 0, 1.0, NAN)
    with pytest.raises(io.InputError, match="fewer than two measured heights"):
        measured(height, ((1.0, 0.0), (2.0, 0.0)))


def waves_of(length, rng, shape, size):
    """Return errors that are correlated over a length, as those of heights and slopes are."""
    if not length:
        return rng.standard_normal(shape)
    rows, columns = (np.fft.fftfreq(2 * count) for count in shape)
    power = (2 * np.sin(np.pi * rows[:, None])) ** 2 + (2 * np.sin(np.pi * columns)) ** 2
    power = 1 / (power + (size[0] / length) ** 2)
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal(power.shape)) * np.sqrt(power)).real
    return field[: shape[0], : shape[1]] / np.sqrt(power.mean())


@pytest.mark.parametrize("length", [0.0, 0.08])
@pytest.mark.parametrize("width", [0.0, 0.2, 1.5])
def test_steps_and_grooves_of_averaged_profiles_are_as_sure_as_they_say(length, width):
    shape, size = (90, 160), (0.02, 0.02)
    x, _ = places(shape, size)
    forms = {"groove": 0.01 * x - 0.02 * (np.abs(x) < 0.3), "step": 0.01 * x + 0.02 * (x > 0.1)}
    pulls: dict[str, list[float]] = {}
    for seed in range(24):
        error = 0.001 * waves_of(length, np.random.default_rng(seed), shape, size)
        for name, height in forms.items():
            result = result_of(height + error, size, sigma=0.001, fitted=io.Fitted(height_correlation=length))
            line = section(result, (-1.2, 0.1), (1.2, 0.1), width=width)
            if name == "groove":
                slot = groove(line)
                assert slot.width.value == pytest.approx(0.6, abs=0.03)
                assert slot.place.value == pytest.approx(1.2, abs=0.03)
                rise, slope = slot.depth, slot.slope
            else:
                stair = step_height(line)
                rise, slope = stair.height, stair.slope
            pulls.setdefault(name, []).append((rise.value - 0.02 * np.cos(np.arctan(0.01))) / rise.sigma)
            pulls.setdefault("slope", []).append((slope.value - np.degrees(np.arctan(0.01))) / slope.sigma)
    chi2 = {name: float(np.mean(np.square(values))) for name, values in pulls.items()}
    assert all(0.25 < value < 2 for value in chi2.values()), chi2


def test_a_groove_is_that_of_the_standard():
    # A round bottom and rounded walls: only the middle third, and the sides from a third of the width, count.
    t = 0.01 * np.arange(400)
    away = np.abs(t - 2.0)
    walls = np.clip((0.5 - away) / 0.1 + 0.5, 0, 1)
    slot = groove(Section(t, t, 0 * t, 0.3 - 0.1 * walls + 0.02 * t, 0 * t, t < 0))
    assert slot.depth.value == pytest.approx(0.1 * np.cos(np.arctan(0.02)), rel=1e-6)
    assert slot.width.value == pytest.approx(1.0, abs=0.02)
    ridge = groove(Section(t, t, 0 * t, 0.1 * walls, 0 * t, t < 0))
    assert ridge.depth.value == pytest.approx(-0.1)


def test_what_is_uneven_has_no_groove():
    rng, found = np.random.default_rng(3), 0
    t = 0.02 * np.arange(200)
    for _ in range(40):
        white = np.convolve(rng.standard_normal(400), np.exp(-(np.linspace(-2, 2, 31) ** 2)), "same")[:200]
        with contextlib.suppress(io.InputError):
            groove(Section(t, t, 0 * t, white, 0 * t + 0.01, t < 0))
            found += 1
    assert found == 0
    with pytest.raises(io.InputError, match="a step fits it better"):
        groove(Section(t, t, 0 * t, 0.1 * (t > 2.0), 0 * t, t < 0))


def test_an_averaged_section_is_the_mean_of_parallel_ones():
    x, y = places((61, 81), (0.1, 0.2))
    height = 0.3 * x + 0.1 * y**2
    result = result_of(height, (0.1, 0.2))
    line = section(result, (-2.0, 1.0), (2.0, 1.0), width=2.0)
    offsets = np.linspace(-0.9, 0.9, 10)
    for place, mean in zip(line.x, line.height, strict=True):
        lines = [section(result, (place, 1 + o), (place + 0.1, 1 + o)).height[0] for o in offsets]
        assert mean == pytest.approx(np.mean(lines), abs=1e-6)
