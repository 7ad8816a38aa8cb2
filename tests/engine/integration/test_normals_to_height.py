"""Slopes of normals and their standard deviations, compared with closed forms and draws of eq. 10."""

from dataclasses import replace

import numpy as np
import pytest

from mirrorskin.engine.integration.normals_to_height import find_slopes
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT, UNEVEN, Setup

ONE = np.ones((1, 1), np.float32)


def slopes_at(zenith, azimuth, sigma=0.001, contact=1, tilt=None, **options):
    """Take degrees; return a slope along x and y, and their weights."""
    vectors = rotations.direction(np.radians(zenith), np.radians(azimuth)).astype(np.float32)
    touched = np.full((1, 1), contact, np.uint8)
    slopes = find_slopes(vectors[np.newaxis, np.newaxis], np.float32(sigma) * ONE, touched, tilt, **options)
    return slopes.dz_dx[0, 0], slopes.dz_dy[0, 0], *slopes.weights[:, 0, 0], slopes.defined[0, 0]


@pytest.mark.parametrize(("zenith", "azimuth"), [(0, 0), (1, 30), (30, 135), (60, -90)])
def test_slopes_are_those_of_the_plane_at_right_angles(zenith, azimuth):
    dz_dx, dz_dy, *_ = slopes_at(zenith, azimuth)
    steepness = np.tan(np.radians(zenith))
    assert dz_dx == pytest.approx(-steepness * np.cos(np.radians(azimuth)), abs=1e-6)
    assert dz_dy == pytest.approx(-steepness * np.sin(np.radians(azimuth)), abs=1e-6)


def test_without_a_tilt_errors_go_both_ways_alike():
    cosine, part = np.cos(np.radians(60)), 0.01**2 / 2
    *_, along, across, _ = slopes_at(60, 0, sigma=0.01)
    assert 1 / along == pytest.approx(part / cosine**4, rel=1e-4)
    assert 1 / across == pytest.approx(part / cosine**2, rel=1e-4)
    *_, weight_x, weight_y, _ = slopes_at(60, 45, sigma=0.01)
    assert 1 / weight_x == pytest.approx(1 / weight_y)
    assert 1 / weight_x == pytest.approx((1 / along + 1 / across) / 2, rel=1e-4)


@pytest.mark.parametrize(
    "change",
    [
        {"contact": 0},
        {"sigma": np.nan},
        {"sigma": np.inf},
        {"sigma": 0},
        {"zenith": 90.5},
        {"zenith": np.nan},
    ],
)
def test_what_means_nothing_gives_no_slope(change):
    dz_dx, dz_dy, *weights, usable = slopes_at(**{"zenith": 30, "azimuth": 20} | change)
    assert np.isnan([dz_dx, dz_dy]).all()
    assert weights == [0, 0]
    assert not usable


def test_walls_are_steep_but_not_without_bounds():
    dz_dx, _, weight, *_ = slopes_at(89.99, 0, sigma=0.01, tilt=TILT)
    assert dz_dx == pytest.approx(-np.tan(np.radians(80)), rel=0.05)
    assert 0 < weight < 1e4
    steep = slopes_at(80, 0, sigma=0.01, tilt=TILT)
    assert dz_dx == pytest.approx(steep[0], rel=0.05)


SETUP = Setup(gain=3.0, noise=1.5, offset=12.0)


STEEP = (10, 30, 50)


@pytest.mark.parametrize(("phase", "azimuth"), [(EIGHTHS, 20), (EIGHTHS, 130), (UNEVEN, 45)])
def test_slopes_have_true_errors_and_no_bias(phase, azimuth):
    setup = replace(SETUP, phase=phase)
    arguments = {
        "phase": setup.phase,
        "tilt": setup.tilt,
        "zenith_gain": setup.slope,
        "zenith_offset": setup.offset,
    }
    # Uneven phases tell azimuths of one direction better than those of another.
    tolerance = 0.15 if phase is EIGHTHS else 0.4
    toward = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    for zenith in (0, 1, 4, *STEEP):
        true = np.tile(rotations.direction(np.radians(zenith), np.radians(azimuth)), (100, 100, 1))
        frames = rotations.expose(true, setup, seed=zenith)
        normals = rotations.estimate(frames, **arguments, noise=setup.spread)
        result = find_slopes(normals.normals, normals.normals_sigma, np.ones_like(normals.contact), TILT)
        steepness = np.tan(np.radians(zenith))
        slopes = result.dz_dx, result.dz_dy
        for slope, weight, component in zip(slopes, result.weights, toward, strict=True):
            assert np.mean((slope + steepness * component) ** 2 * weight) == pytest.approx(1, abs=tolerance)
        if zenith in STEEP:
            # By the azimuth's noise alone slopes would be flatter by half its variance, 0.5 %.
            means = [
                np.average(slope, weights=weight)
                for slope, weight in zip(slopes, result.weights, strict=True)
            ]
            assert -(means[0] * toward[0] + means[1] * toward[1]) == pytest.approx(steepness, rel=1.5e-3)


def test_on_a_ridge_weights_depend_on_the_axis_across_it():
    vectors = np.tile(rotations.direction(np.radians(30), 0.0), (20, 20, 1))
    vectors[:, 10:, 0] *= -1
    size = vectors.shape[:2]
    result = find_slopes(
        vectors.astype(np.float32), np.full(size, 0.01, np.float32), np.ones(size, np.uint8), TILT
    )
    for weight in result.weights:
        assert weight == pytest.approx(np.full(size, weight[0, 0]), rel=1e-4)
    assert result.weights[0, 0, 0] > 50 * result.weights[1, 0, 0]


def test_weights_may_depend_on_other_errors():
    plain = slopes_at(40, 0, sigma=0.02, tilt=TILT)
    white = slopes_at(40, 0, sigma=0.02, tilt=TILT, independent_sigma=np.float32(0.04) * ONE)
    assert white[:2] == plain[:2]
    assert white[2:4] == slopes_at(40, 0, sigma=0.04, tilt=TILT)[2:4]
    assert white[2:4] != plain[2:4]
