"""Registration: the reference, compared with closed forms."""

from __future__ import annotations

import numpy as np

from mirrorskin.kernels.rotation.registration import (
    BORDER,
    registration_admit,
    registration_resample,
    weights,
)

ALIKE = np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32)
# Pixels to the right and down: a number, and what a column, a row and a millimetre of height add.
SHIFT = np.array([[1.3, 0.011, -0.017, 2.1], [-0.6, -0.021, 0.013, -1.4]], np.float32)


def registered_frame(frame, height, shift):
    """Return a frame that follows the object, and its noise, by the reference."""
    padded = np.full([size + 2 * BORDER for size in frame.shape], np.nan, np.float32)
    registered, noise = np.zeros(frame.shape, np.float32), np.zeros((2, *frame.shape), np.float32)
    registration_admit(frame, *ALIKE, padded)
    registration_resample(padded, height, shift, *ALIKE, registered, noise)
    return registered, noise


def polynomial(x, y):
    """A surface that is cubic along rows, along columns, and in their products."""
    return (2 + x - 0.3 * x**2 + 0.05 * x**3) * (1 - 0.4 * y + 0.2 * y**2 - 0.03 * y**3)


def moved(shift, height):
    """Where each pixel's point is, in columns and rows."""
    row, column = np.indices(height.shape)
    ways = np.stack([np.ones_like(height), column, row, height])
    return column + np.tensordot(shift[0], ways, 1), row + np.tensordot(shift[1], ways, 1)


def test_weights_take_a_cubic_through_four_samples() -> None:
    part = np.linspace(0, 1, 11)
    for power in range(4):
        samples = np.array([-1.0, 0, 1, 2]) ** power
        np.testing.assert_allclose(samples @ weights(part), part**power, atol=1e-14)
    np.testing.assert_array_equal(weights(np.array(0.0)), [0, 1, 0, 0])


def test_the_reference_finds_a_cubic_surface_where_it_has_moved_to() -> None:
    shape = 12, 14
    row, column = np.indices(shape)
    height = np.random.default_rng(0).uniform(-1, 0, shape).astype(np.float32)
    registered = registered_frame(polynomial(column, row).astype(np.float32), height, SHIFT)[0]
    x, y = moved(SHIFT.astype(float), height.astype(float))
    inside = (x >= 1) & (x < 12) & (y >= 1) & (y < 10)
    assert inside.sum() > 60
    np.testing.assert_allclose(registered[inside], polynomial(x, y)[inside], rtol=1e-5, atol=1e-3)
    assert np.isnan(registered[~inside]).all()


def test_a_shift_of_whole_pixels_moves_samples_and_noise_as_they_are() -> None:
    frame = np.random.default_rng(1).normal(100, 30, (8, 9)).astype(np.float32)
    shift = np.array([[2, 0, 0, 0], [-1, 0, 0, 0]], np.float32)
    registered, noise = registered_frame(frame, np.zeros((8, 9), np.float32), shift)
    expected = np.full((8, 9), np.nan, np.float32)
    expected[2:7, :5] = frame[1:6, 2:7]
    # Of what is found elsewhere, one of the 16 samples is beyond the edge.
    np.testing.assert_array_equal(registered[2:7, :5], expected[2:7, :5])
    np.testing.assert_array_equal(noise, np.broadcast_to(np.isfinite(registered), (2, 8, 9)))
    assert np.isfinite(registered).sum() == 5 * 5
