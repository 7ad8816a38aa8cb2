"""The object's coarse height, from exact normals."""

import math

import numpy as np
import pytest

from mirrorskin.engine.rotation.coarse_height import coarse_heights
from mirrorskin.kernels.device import open_device

PIXEL = 0.05
X, Y = np.meshgrid((np.arange(121) - 60) * PIXEL, (50 - np.arange(101)) * PIXEL)
LEVEL, STEEP = math.radians(13), math.radians(43)


def stand(slope, press, visible=True, contact=True):
    """Find heights where normals are neither too level nor too steep to be seen."""
    east, north = slope
    zenith = np.arctan(np.hypot(east, north))
    slope_known = (zenith > LEVEL) & (zenith < STEEP) & visible & contact
    vectors = (
        np.stack([-east, -north, np.ones_like(east)], axis=-1) / np.sqrt(1 + east**2 + north**2)[..., None]
    )
    vectors[~slope_known] = np.nan
    heights = coarse_heights(
        vectors.astype(np.float32),
        slope_known.astype(np.uint8),
        zenith < LEVEL,
        (PIXEL, PIXEL),
        press,
        open_device(),
    )
    return heights, slope_known


def ball(radius, at=(0.0, 0.0)):
    away = np.hypot(X - at[0], Y - at[1])
    rise = np.sqrt(np.maximum(radius**2 - away**2, 1e-6))
    inside = away < 0.8 * radius
    return rise - radius, ((at[0] - X) / rise, (at[1] - Y) / rise), inside


def test_a_ball_is_as_high_as_its_top_that_is_too_level_to_be_seen():
    height, slope, inside = ball(2.5)
    heights, slope_known = stand(slope, 0.6, inside)
    np.testing.assert_allclose(heights[slope_known], np.clip(0.6 + height, 0, None)[slope_known], atol=3e-3)
    assert heights.max() <= 0.6
    assert heights.min() == 0
    assert np.isfinite(heights).all()


def test_balls_apart_are_all_as_high_as_the_press():
    taller, first, here = ball(1.2, (-1.5, 0.5))
    other, second, second_place = ball(1.0, (1.6, -0.8))
    slope = tuple(np.where(here, a, b) for a, b in zip(first, second, strict=True))
    heights, slope_known = stand(slope, 0.4, here | second_place)
    expected = 0.4 + np.where(here, taller, other)
    np.testing.assert_allclose(heights[slope_known], np.clip(expected, 0, None)[slope_known], atol=5e-3)


def test_a_roof_goes_on_to_its_ridge():
    fall = math.tan(math.radians(28))
    visible = (np.abs(X) > 0.12) & (np.abs(X) < 1.42)
    heights, slope_known = stand((-fall * np.sign(X), np.zeros_like(X)), 0.9, visible)
    np.testing.assert_allclose(heights[slope_known], (0.9 - fall * np.abs(X))[slope_known], atol=0.02)


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (600, 3)])
def test_pictures_may_have_any_size(shape):
    vectors = np.zeros((*shape, 3), np.float32)
    vectors[...] = 0.5, 0.0, math.sqrt(0.75)
    heights = coarse_heights(
        vectors, np.ones(shape, np.uint8), np.zeros(shape, bool), (PIXEL, PIXEL), 1.0, open_device()
    )
    assert heights.shape == shape
    assert heights.max() == pytest.approx(1, abs=0.15)
