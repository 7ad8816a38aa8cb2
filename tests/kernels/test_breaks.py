"""Links that let go: the device against the reference, and what the reference promises."""

import numpy as np
import pytest
from launches import launch

from mirrorskin.kernels import breaks
from mirrorskin.kernels.breaks import DOWN, RIGHT

SIZE = np.float32(0.4), np.float32(0.7)
SHAPES = pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (37, 53), (5, 700)], ids=str)


def picture(shape):
    """Return flags, links to the right and down, slopes, cosines of normals, and heights."""
    rng = np.random.default_rng(shape[0] * 1000 + shape[1])
    flags = ((rng.random(shape) < 0.85) * RIGHT + (rng.random(shape) < 0.85) * DOWN).astype(np.uint8)
    flags[:, -1] &= DOWN
    flags[-1] &= RIGHT
    links = [np.where(flags & bit, rng.uniform(0.1, 2, shape), 0) for bit in (RIGHT, DOWN)]
    slopes = [rng.normal(0, 0.5, shape) for _ in range(2)]
    maps = [*links, *slopes, rng.uniform(0.05, 1, shape), rng.normal(0, 0.5, shape)]
    return flags, *(one.astype(np.float32) for one in maps)


def run(device, name, shape, arguments, outputs):
    """Run a kernel that writes so many maps, and for links a sum for each of its items."""

    def put(values):
        values = np.asarray(values)
        if values.ndim == 0:
            return values.item()
        return device.given("map", values, np.uint8 if values.dtype == np.uint8 else np.float32)

    items = shape[0] * -(-shape[1] // min(device.layout.tile, 256))
    made = [put(np.full(shape, np.nan)) for _ in range(outputs)]
    if name == "links":
        made.append(put(np.full(items, np.nan)))
    launch(device.kernel("breaks", f"breaks_{name}"), items, *shape, *map(put, arguments), *made)
    return [array.download() for array in made]


@SHAPES
def test_what_tells_of_tears_is_that_of_the_reference(device, shape):
    flags, _, _, slope_x, slope_y, *_ = picture(shape)
    (curl,) = run(device, "curl", shape, [flags, slope_x, slope_y, *SIZE], 1)
    np.testing.assert_allclose(curl, breaks.breaks_curl(flags, slope_x, slope_y, *SIZE), atol=1e-6)
    for wide, reach in ((0, 1), (1, 5)):
        sums, wanted = curl, curl
        for downwards in (0, 1):
            (sums,) = run(device, "sum", shape, [sums, reach, downwards], 1)
            wanted = breaks.breaks_sum(wanted, reach, bool(downwards))
        np.testing.assert_allclose(sums, wanted, atol=1e-5)
        (tears,) = run(device, "spread", shape, [curl, sums, reach, 0.05, wide], 1)
        np.testing.assert_allclose(
            tears, breaks.breaks_spread(curl, sums, reach, 0.05, bool(wide)), atol=1e-5
        )


@SHAPES
def test_trust_and_links_are_those_of_the_reference(device, shape):
    _, right, down, slope_x, slope_y, facing, heights = picture(shape)
    tears = np.pad(np.abs(heights)[:-1, :-1], (0, 1))
    known = right, down, slope_x, slope_y, facing, tears, 0.01, 0.5, 2.0, 1e-3
    found = run(device, "trust", shape, known, 4)
    wanted = breaks.breaks_trust(*known)
    for one, other, there in zip(found, wanted, 2 * (right > 0, down > 0), strict=True):
        np.testing.assert_allclose(one[there], other[there], rtol=1e-5, atol=1e-6)
    links = *found, slope_x, slope_y, facing, heights, *SIZE, 0.25, 4.0, 6.0
    *maps, sums = run(device, "links", shape, links, 3)
    *wanted, broken = breaks.breaks_links(*links)
    for one, other in zip(maps, wanted, strict=True):
        # A square of 6 is cut, or not, by its last digit.
        assert np.mean(np.abs(one - other) > 2e-5) <= 0.002
    np.testing.assert_allclose(sums.sum(dtype=float), broken, rtol=1e-5)


def test_the_slope_of_a_link_is_without_error_on_a_sphere():
    y, x = np.indices((9, 9)) - 4.0
    z = np.sqrt(5.7**2 - x * x - y * y)
    one = np.ones_like(z)
    *_, rise_x, rise_y = breaks.breaks_trust(one, one, -x / z, -y / z, z / 5.7, 0 * z, 1, 0, 0, 0)
    np.testing.assert_allclose(rise_x[:, :-1], np.diff(z, axis=1), atol=1e-12)
    np.testing.assert_allclose(rise_y[:-1], np.diff(z, axis=0), atol=1e-12)


def test_solving_its_links_lowers_the_sum():
    _, right, down, slope_x, slope_y, facing, heights = picture((6, 7))
    one = np.ones(right.shape)
    known = right, down, slope_x, slope_y, facing, 0 * one
    trust = breaks.breaks_trust(*known, 0.01, 0.5, 2.0, 1e-5)

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
        known = *trust, slope_x, slope_y, 0 * one, heights
        x, y, source, _ = breaks.breaks_links(*known, *SIZE, 0.25, 4.0, 1e30)
        number = np.arange(heights.size).reshape(heights.shape)
        matrix = np.zeros((heights.size, heights.size))
        for weight, axis in ((x, 1), (y, 0)):
            ends = number.ravel(), np.roll(number, -1, axis).ravel()
            np.subtract.at(matrix, ends, weight.ravel())
        matrix += matrix.T
        matrix[np.diag_indices_from(matrix)] = -matrix.sum(axis=1)
        before, heights = cost(heights), (np.linalg.pinv(matrix) @ source.ravel()).reshape(heights.shape)
        assert cost(heights) < before
