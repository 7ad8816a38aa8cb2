from __future__ import annotations

import math

import numpy as np
import pytest
from contact_theory import sphere

from mirrorskin import io
from mirrorskin.engine.calibration.gel import BallOnset, ball_onset, fit_gel, sphere_slope, sphere_travel
from mirrorskin.engine.press.elastic import fit_press
from mirrorskin.engine.press.press import Press
from mirrorskin.io import InputError, Result
from mirrorskin.twin import Camera, Sphere, Twin, Vertical, visible_zenith
from mirrorskin.twin.body import Body

COMPLIANCE = 0.05
STEP = 0.04


def pressed(diameter, seed, pixels=56, optics="cylinder"):
    """A ball pressed by the twin, and its heights by eq. 3."""
    twin = Twin(
        object=Sphere(diameter),
        shape=(pixels, pixels),
        pixel_size=7.0 / pixels,
        movement=Vertical(np.arange(0, 1.2 + STEP / 2, STEP), compliance=COMPLIANCE),
        contact="elastic",
        optics=optics,
        camera=Camera(noise=1.5, seed=seed, gain_deviation=0.05),
    )
    return twin, Press(fill=False).run(twin)


@pytest.fixture(scope="module")
def learned():
    twin, result = pressed(4.0, seed=1)
    return fit_gel([ball_onset(result, twin, 2.0)])


def made_up(radius, threshold, compliance, zero, x, y, noise=0.0):
    """Onsets on rings around a ball by Sneddon's solution, with the mirror on the very surface."""
    touches = np.linspace(0.05, 0.8 * radius, 80)
    rows = [sphere(radius, touch, 1.0) for touch in touches]
    travels = np.array([row.depth + compliance * row.force for row in rows]) + zero
    inner = radius * math.sin(threshold)
    rings, onset = np.linspace(1.15 * inner, 0.95 * radius, 25), []
    for r in rings:
        outside = touches < r - 1e-3
        slopes = [
            float(row.surface(np.array(r)) - row.surface(np.array(r + 1e-5))) / 1e-5
            for row, out in zip(rows, outside, strict=True)
            if out
        ]
        onset.append(np.interp(math.tan(threshold), slopes, travels[outside], right=np.nan))
    keep = np.isfinite(onset)
    azimuth = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    across = x + np.outer(rings[keep], np.cos(azimuth)).ravel()
    up = y + np.outer(rings[keep], np.sin(azimuth)).ravel()
    travel = np.repeat(np.array(onset)[keep], 6)
    travel = travel + noise * np.random.default_rng(5).standard_normal(travel.size)
    return BallOnset(travel, np.full(travel.size, 0.005), across, up, radius, inner, 0.005)


def test_a_ball_indents_as_in_sneddon_s_solution():
    touch = np.array([0.2, 0.9, 1.5])
    theory = [sphere(2.0, a, 1.0) for a in touch]
    depths = [contact.depth + COMPLIANCE * contact.force for contact in theory]
    np.testing.assert_allclose(sphere_travel(touch, 2.0, COMPLIANCE), depths, rtol=1e-9)
    for a, contact in zip(touch, theory, strict=True):
        r = np.array([a + 0.1, a + 0.5, a + 2.0])
        slopes = (contact.surface(r) - contact.surface(r + 1e-5)) / 1e-5
        np.testing.assert_allclose(sphere_slope(r, a, 2.0), slopes, rtol=0.01)
        inside = np.array([0.3, 0.7]) * a
        np.testing.assert_allclose(sphere_slope(inside, a, 2.0), inside / np.sqrt(4 - inside**2), rtol=0.01)


def test_a_mirror_below_the_surface_is_smoother_than_it():
    r = np.linspace(0.05, 2.5, 50)
    on, below = (sphere_slope(r, 1.0, 2.0, sheet) for sheet in (0.0, 0.1))
    assert below.max() < on.max()
    np.testing.assert_allclose(below[r > 2], on[r > 2], rtol=0.02)


def test_two_balls_by_theory_determine_all_numbers():
    presses = [
        made_up(2.0, 0.21, COMPLIANCE, 0.1, 0.3, -0.2, noise=0.003),
        made_up(4.0, 0.21, COMPLIANCE, -0.05, 0.0, 0.4, noise=0.003),
    ]
    fit = fit_gel(presses, sheet=0.0)
    gel, sigma = fit.gel, fit.gel.sigma
    assert gel.threshold == pytest.approx(0.21, abs=min(0.01, 4 * sigma["threshold"]))
    assert gel.compliance == pytest.approx(COMPLIANCE, abs=0.01)
    assert gel.curvature < 0.02
    for place, (x, y, zero) in zip(fit.places, ((0.3, -0.2, 0.1), (0.0, 0.4, -0.05)), strict=True):
        assert (place.x, place.y) == pytest.approx((x, y), abs=0.005)
        assert place.travel_zero == pytest.approx(zero, abs=0.015)
    assert gel.travel_zero == fit.places[0].travel_zero


def test_the_twins_ball_shows_when_light_comes(learned):
    gel = learned.gel
    nominal = float(visible_zenith(Body(), 0.0, 0.0, 0.0)[0])
    assert gel.threshold == pytest.approx(nominal, abs=math.radians(1.5))
    assert gel.error < 0.01
    place = learned.places[0]
    assert math.hypot(place.x, place.y) < 0.01
    assert abs(place.travel_zero) < 0.03


@pytest.mark.parametrize("diameter", [6.0, 10.0])
def test_a_gel_learned_on_a_small_ball_puts_larger_ones_right(learned, diameter):
    twin, result = pressed(diameter, seed=int(diameter))
    size = twin.header.pixel_size
    corrected, *_ = fit_press(
        result.height, result.height_sigma, result.status, size, learned.gel, deepest=1.2
    )
    valid = np.isfinite(corrected)
    truth = twin.truth.height[valid]
    before, after = result.height[valid] - truth, corrected[valid] - truth
    assert np.count_nonzero(valid) > 0.4 * np.count_nonzero(result.status == 1)
    assert before.mean() < -0.1
    assert abs(after.mean()) < abs(before.mean()) / 5
    assert np.sqrt(np.mean(after**2)) < np.sqrt(np.mean(before**2)) / 3


def test_numbers_that_a_press_does_not_determine_are_left_at_zero_and_named():
    whole = made_up(2.0, 0.21, 0.0, 0.0, 0.0, 0.0)
    narrow = np.hypot(whole.x, whole.y) < 0.9
    few = BallOnset(
        *(part[narrow] for part in (whole.travel, whole.sigma, whole.x, whole.y)), 2.0, 0.417, 0.005
    )
    fit = fit_gel([few], sheet=0.0)
    assert fit.undetermined
    for name in fit.undetermined:
        assert getattr(fit.gel, name) == 0
        assert name not in fit.gel.sigma
    assert fit.gel.threshold == pytest.approx(0.21, abs=0.01)


def test_presses_that_contain_no_information_are_refused():
    with pytest.raises(InputError, match="at least one press"):
        fit_gel([])
    source = type("Source", (), {"name": "turn.h5", "header": io.Header("axial")})()
    lit = np.zeros((9, 9), np.float32)
    press = Result(height=lit, height_sigma=lit, status=np.full((9, 9), 2, np.uint8))
    with pytest.raises(InputError, match=r"turn\.h5 is not a press"):
        ball_onset(Result(), source, 2.0)
    with pytest.raises(InputError, match=r"turn\.h5 has no pixel size"):
        ball_onset(press, source, 2.0)
    source.header = io.Header("vertical", pixel_size=(0.1, 0.1))
    with pytest.raises(InputError, match=r"turn\.h5: 0 pixels turned bright"):
        ball_onset(press, source, 2.0)
    with pytest.raises(InputError, match="diameter is -2 mm"):
        ball_onset(press, source, -1.0)
