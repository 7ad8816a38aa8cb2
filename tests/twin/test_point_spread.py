"""The blur of the camera's lens, compared with the documented Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from mirrorskin.twin.camera import Camera, Sensor

SHAPE = (41, 50)


def blurred(light: NDArray[np.float32], sigma: float) -> NDArray[np.float64]:
    """Return light after the lens, from counts without noise."""
    camera = Camera(np.dtype(np.float32), 0.0, point_spread=sigma)
    counts = np.empty(light.shape, np.float32)
    before = light.copy()
    Sensor(camera, light.shape).expose(light, 0, counts)
    np.testing.assert_array_equal(light, before)
    return (counts.astype(float) - camera.dark) / (camera.bright - camera.dark)


def point(row: int, column: int) -> NDArray[np.float32]:
    light = np.zeros(SHAPE, np.float32)
    light[row, column] = 1
    return light


@pytest.mark.parametrize("sigma", [0.5, 1.0, 1.7, 3.2])
def test_a_point_becomes_a_gaussian_and_its_light_is_kept(sigma: float) -> None:
    image = blurred(point(20, 24), sigma)
    row, column = np.indices(SHAPE)
    square = (row - 20.0) ** 2 + (column - 24.0) ** 2
    gaussian = np.exp(-square / (2 * sigma**2))
    np.testing.assert_allclose(
        image, gaussian / gaussian.sum(), atol=2e-4 * gaussian.max() / gaussian.sum() + 1e-6
    )
    assert image.sum() == pytest.approx(1, abs=1e-4)
    if sigma >= 1:  # a narrower one is more peaked than pixels can tell
        assert np.sqrt(np.sum(square * image) / 2) == pytest.approx(sigma, rel=0.01)


@pytest.mark.parametrize("sigma", [0.6, 2.0])
def test_beyond_the_edge_the_picture_goes_on_as_it_ends(sigma: float) -> None:
    light = np.random.default_rng(4).random(SHAPE).astype(np.float32)
    expected = ndimage.gaussian_filter(light.astype(float), sigma, mode="nearest", truncate=6)
    np.testing.assert_allclose(blurred(light, sigma), expected, atol=3e-4)
    even = np.full(SHAPE, 0.37, np.float32)
    np.testing.assert_allclose(blurred(even, sigma), 0.37, atol=1e-6)
