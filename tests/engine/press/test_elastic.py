from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contact_theory import Pressed, cone, paraboloid, rectangle_responses, sphere

from mirrorskin.engine import NotConverged
from mirrorskin.engine.force.halfspace import HalfSpace, press
from mirrorskin.engine.press.cells import touched
from mirrorskin.engine.press.elastic import correct_press, fit_press, threshold_at
from mirrorskin.engine.press.spline import CellSplines
from mirrorskin.io import Gel, InputError, Result, pixel_axes
from mirrorskin.twin import Body, visible_zenith

THRESHOLD = np.arctan2(17.5, 40) / 2
GEL = Gel(threshold=THRESHOLD, compliance=0.05)


def distances(shape, pixel_size):
    x, y = pixel_axes(shape, pixel_size)
    return np.hypot(x[np.newaxis], y[:, np.newaxis])


def ball_press(radius, shape, pixel_size, deepest, compliance):
    """Onsets of a ball by Sneddon's solution: heights (-travel), sigma, status and truth."""
    r = distances(shape, pixel_size)
    distance = np.linspace(0.01, r.max(), 300)
    travels, slopes = [0.0], [np.zeros(300)]
    for touch in np.linspace(0.05, 0.9 * radius, 60):
        pressed = sphere(radius, touch, 1.0)
        travels.append(pressed.depth + compliance * pressed.force)
        outside = distance > touch
        steep = np.empty(300)
        steep[~outside] = distance[~outside] / np.sqrt(radius**2 - distance[~outside] ** 2)
        at = distance[outside]
        steep[outside] = (pressed.surface(at) - pressed.surface(at + 1e-5)) / 1e-5
        slopes.append(steep)
    onset = np.array([first(np.array(column), np.array(travels)) for column in np.transpose(slopes)])
    travel = np.interp(r, distance, onset)
    lit = travel <= deepest
    truth = np.sqrt(np.maximum(radius**2 - r**2, 0)) - radius
    return np.where(lit, -travel, np.nan), np.where(lit, 0.005, np.nan), np.where(lit, 1, 2), truth


def first(slopes, travels):
    """Travel at which slopes pass the threshold."""
    passed = np.flatnonzero(slopes >= np.tan(THRESHOLD))
    if not passed.size:
        return np.inf
    k = passed[0]
    fraction = (np.tan(THRESHOLD) - slopes[k - 1]) / (slopes[k] - slopes[k - 1])
    return travels[k - 1] + fraction * (travels[k] - travels[k - 1])


def pressed_like(theory: Pressed, profile, shape=(72, 80), size=(0.06, 0.05)):
    r = distances(shape, size)
    return press(HalfSpace(shape, size), theory.depth - profile(r)), r


@pytest.mark.parametrize(
    ("theory", "profile"),
    [
        (paraboloid(3.0, 1.2, 1.0), lambda r: r**2 / 6),
        (sphere(3.0, 1.2, 1.0), lambda r: 3 - np.sqrt(np.maximum(9 - r**2, 0))),
        (cone(0.4, 1.2, 1.0), lambda r: 0.4 * r),
    ],
    ids=["paraboloid", "ball", "cone"],
)
def test_a_press_is_as_the_closed_forms_have_it(theory, profile):
    force, r = pressed_like(theory, profile)
    touch = np.sqrt(np.count_nonzero(force.contact) * 0.06 * 0.05 / np.pi)
    outside = r > theory.radius + 0.06
    assert touch == pytest.approx(theory.radius, rel=0.02)
    assert force.load == pytest.approx(theory.force, rel=0.002)
    height = HalfSpace(r.shape, (0.06, 0.05)).displacement(force.strain)
    np.testing.assert_allclose(height[outside], theory.surface(r[outside]), atol=0.002)


def test_the_force_of_a_flat_punch_is_that_of_boussinesq():
    r = distances((81, 81), (0.05, 0.05))
    space = HalfSpace((81, 81), (0.05, 0.05))
    force = press(space, np.where(r <= 1.0, 0.2, np.nan))
    assert force.load == pytest.approx(8 / 3 * 0.2, rel=0.02)
    far = (r > 1.2) & (r < 1.9)
    np.testing.assert_allclose(
        space.displacement(force.strain)[far], 0.4 / np.pi * np.arcsin(1 / r[far]), rtol=0.02
    )


def test_pressure_moves_the_surface_as_sums_over_pixels_do():
    shape, size = (9, 11), (0.3, 0.2)
    x, y = pixel_axes(shape, size)
    smooth = np.exp(-(x[np.newaxis] ** 2) - 1.5 * y[:, np.newaxis] ** 2)
    by_sums = (rectangle_responses(shape, size, 1.0) @ smooth.ravel()).reshape(shape)
    np.testing.assert_allclose(HalfSpace(shape, size).displacement(smooth), by_sums, rtol=0.01)


def test_a_weak_stage_lets_the_surface_in_less():
    r = distances((48, 48), (0.08, 0.08))
    theory = sphere(3.0, 1.0, 1.0)
    ball = np.sqrt(9 - r**2) - 3
    force = press(HalfSpace((48, 48), (0.08, 0.08)), ball + theory.depth + 0.05 * theory.force, 0.05)
    assert force.load == pytest.approx(theory.force, rel=0.003)


def test_the_threshold_falls_towards_the_wall_as_the_wall_is_seen():
    gel = Gel(threshold=THRESHOLD, compliance=0.0, curvature=1 / 17.5)
    x, y, azimuth = np.meshgrid([-6.0, 0.0, 5.0], [-2.0, 7.0], [0.0, 1.0, 4.0])
    lower, _ = visible_zenith(Body(), x, y, azimuth)
    np.testing.assert_allclose(threshold_at(gel, x, y, azimuth), lower, atol=1e-12)
    assert np.isnan(threshold_at(gel, 18.0, 0.0, 0.0))
    moved = replace(gel, axis=(1.0, -2.0))
    np.testing.assert_allclose(threshold_at(moved, x + 1, y - 2, azimuth), lower, atol=1e-12)


def test_a_ball_is_corrected_with_pixels_of_two_sizes_and_defects():
    shape, size = (49, 80), (0.1, 0.16)
    height, sigma, status, truth = ball_press(3.0, shape, size, 1.2, 0.05)
    status[20:23, 30:33], status[10, 50] = 0, 0
    corrected, spread, *_ = fit_press(height, sigma, status, size, GEL, deepest=1.2)
    finite = np.isfinite(corrected)
    assert not finite[status != 1].any()
    assert np.count_nonzero(finite) > 0.5 * np.count_nonzero(status == 1)
    before, after = (maps[finite] - truth[finite] for maps in (height, corrected))
    assert before.mean() < -0.15
    assert abs(after.mean()) < 0.02
    assert np.sqrt(np.mean(after**2)) < 0.04
    assert np.sqrt(np.mean((after / spread[finite]) ** 2)) < 2.5


def test_a_ball_at_the_edge_of_the_picture_is_corrected():
    height, sigma, status, truth = ball_press(5.0, (60, 60), (0.1, 0.1), 1.0, 0.05)
    part = np.s_[:, 12:]
    gel = replace(GEL, axis=(-0.6, 0.0))
    corrected, *_ = fit_press(height[part], sigma[part], status[part], 0.1, gel, deepest=1.0)
    finite = np.isfinite(corrected)
    assert np.count_nonzero(finite) > 0.5 * np.count_nonzero(status[part] == 1)
    before, after = ((maps - truth[part])[finite] for maps in (height[part], corrected))
    assert abs(after.mean()) < abs(before.mean()) / 5


def test_too_little_light_shows_no_surface():
    dark = np.full((20, 20), np.nan)
    with pytest.raises(NotConverged, match="nothing turned light"):
        fit_press(dark, dark, np.full((20, 20), 2), 0.1, GEL)
    few = dark.copy()
    few[4, 5:8] = -0.1
    with pytest.raises(NotConverged, match="too little"):
        fit_press(few, 0.01, np.where(np.isfinite(few), 1, 2), 0.1, GEL)
    with pytest.raises(NotConverged, match="too little"):
        fit_press(np.array([[-0.2]]), 0.01, np.array([[1]]), 0.1, GEL)


def test_maps_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="one map"):
        fit_press(np.zeros(4), 0.0, np.zeros(4), 0.1, GEL)
    with pytest.raises(InputError, match="do not fit"):
        fit_press(np.zeros((4, 4)), np.zeros((4, 3)), np.ones((4, 4)), 0.1, GEL)


class Pixels:
    name = "press.h5"

    def __init__(self, pixel_size):
        self.header = type("Header", (), {"pixel_size": pixel_size})()


def test_a_press_that_cannot_be_corrected_stays_and_states_the_reason():
    height = np.full((6, 7), -0.5, np.float32)
    result = Result(height=height, height_sigma=0.1 * np.abs(height), status=np.full((6, 7), 2, np.uint8))
    for gel, pixel_size, threshold, why in (
        (None, (0.1, 0.1), 0.5, "none: the calibration has no gel"),
        (GEL, None, 0.5, "none: the recording has no pixel size"),
        (GEL, (0.1, 0.1), 0.4, "none: the gel was learned with a threshold of 0.5, not of 0.4"),
        (GEL, (0.1, 0.1), 0.5, "none: nothing turned light"),
    ):
        same, reason, _ = correct_press(result, Pixels(pixel_size), 1.0, threshold, gel)
        assert same is result
        assert reason == why


def test_flat_tops_belong_to_the_surface_and_what_was_not_reached_does_not():
    r = distances((40, 40), (0.1, 0.1))
    lit = (r > 0.5) & (r < 1.4)
    height = np.where(lit, -r, np.nan)
    surface = touched(height, ~lit, np.zeros_like(lit))
    np.testing.assert_array_equal(surface, r < 1.4)
    pit = touched(-height, ~lit, np.zeros_like(lit))
    np.testing.assert_array_equal(pit, lit | (r >= 1.4))
    hidden = touched(-height, np.zeros_like(lit), r <= 0.5)
    assert hidden[r <= 0.5].all()


def test_splines_have_the_slopes_and_the_bending_of_a_cubic():
    rows, columns = np.arange(20.0)[:, np.newaxis] * 0.1, np.arange(24.0) * 0.08
    surface = rows**3 + rows * columns**2
    splines = CellSplines((20, 24), (0.1, 0.08))
    factors = np.linalg.lstsq(splines.basis.toarray(), surface.ravel(), rcond=None)[0]
    np.testing.assert_allclose(splines.surface(factors), surface, atol=1e-9)
    down, across = (part @ factors for part in splines.slopes)
    np.testing.assert_allclose(down.reshape(20, 24), 3 * rows**2 + columns**2, atol=1e-7)
    np.testing.assert_allclose(across.reshape(20, 24), 2 * rows * columns, atol=1e-7)
    # The third derivatives are 6 down the rows and, three times, 2 mixed.
    assert factors @ splines.roughness() @ factors == pytest.approx(36 + 3 * 4, rel=1e-6)
