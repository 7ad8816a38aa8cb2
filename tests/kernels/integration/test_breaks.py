"""Links that break: properties of the reference."""

import numpy as np

from mirrorskin.kernels.integration import breaks
from mirrorskin.kernels.integration.breaks import DOWN, RIGHT

SIZE = np.float32(0.4), np.float32(0.7)


def picture(shape):
    """Return flags, links to the right and down, slopes, cosines of normals, and heights."""
    rng = np.random.default_rng(shape[0] * 1000 + shape[1])
    flags = ((rng.random(shape) < 0.85) * RIGHT + (rng.random(shape) < 0.85) * DOWN).astype(np.uint8)
    flags[:, -1] &= DOWN
    flags[-1] &= RIGHT
    links = [np.where(flags & bit, rng.uniform(0.1, 2, shape), 0) for bit in (RIGHT, DOWN)]
    slopes = [rng.normal(0, 0.5, shape) for _ in range(2)]
    maps = [*links, *slopes, rng.uniform(0.05, 1, shape), rng.normal(0, 0.5, shape)]
    return flags, *(layer.astype(np.float32) for layer in maps)


def test_the_slope_of_a_link_is_without_error_on_a_paraboloid():
    y, x = np.indices((9, 9)) - 4.0
    z, ones = 0.1 * x * x - 0.2 * y * y + 0.05 * x * y, np.ones((9, 9))
    slopes = 0.2 * x + 0.05 * y, 0.05 * x - 0.4 * y
    *_, rise_x, rise_y = breaks.breaks_trust(ones, ones, *slopes, ones, 0 * ones, 1, 0, 0, 0)
    np.testing.assert_allclose(rise_x[:, :-1], np.diff(z, axis=1), atol=1e-12)
    np.testing.assert_allclose(rise_y[:-1], np.diff(z, axis=0), atol=1e-12)


def test_solving_its_links_lowers_the_sum():
    _, right, down, slope_x, slope_y, facing, heights = picture((6, 7))
    ones = np.ones(right.shape)
    links = right, down, slope_x, slope_y, facing, 0 * ones
    trust = breaks.breaks_trust(*links, 0.01, 0.5, 2.0, 1e-5)

    def cost(u):
        total, sizes = 0.0, zip(trust[:2], trust[2:], (1, 0), SIZE, (slope_x, slope_y), strict=True)
        for weight, rise, axis, size, slope in sizes:
            miss = np.abs((np.roll(u, -1, axis) - u) / size - rise)
            miss = np.maximum(miss - 0.25 * np.abs(np.roll(slope, -1, axis) - slope), 0)
            slack = 0.25 * np.abs(np.roll(slope, -1, axis) - slope)
            # The integral of 2 r / (1 + k (r - slack)^2)^2 from 0.
            k = 4.0
            outer = k * miss**2 / (1 + k * miss**2) / k
            outer += slack * (miss / (1 + k * miss**2) + np.arctan(np.sqrt(k) * miss) / np.sqrt(k))
            inner = np.minimum(np.abs((np.roll(u, -1, axis) - u) / size - rise), slack) ** 2
            total += np.sum(weight * size**2 * (outer + inner))
        return total

    for _ in range(3):
        maps = *trust, slope_x, slope_y, 0 * ones, heights
        x, y, source, _ = breaks.breaks_links(*maps, *SIZE, 0.25, 4.0, 1e30)
        number = np.arange(heights.size).reshape(heights.shape)
        matrix = np.zeros((heights.size, heights.size))
        for weight, axis in ((x, 1), (y, 0)):
            ends = number.ravel(), np.roll(number, -1, axis).ravel()
            np.subtract.at(matrix, ends, weight.ravel())
        matrix += matrix.T
        matrix[np.diag_indices_from(matrix)] = -matrix.sum(axis=1)
        before, heights = cost(heights), (np.linalg.pinv(matrix) @ source.ravel()).reshape(heights.shape)
        assert cost(heights) < before
