"""Bilateral weights: the device against the reference, and the reference against sums by hand."""

import math

import numpy as np
import pytest
from launches import launch

from mirrorskin.kernels import bilateral
from mirrorskin.kernels.bilateral import DOWN, RIGHT

SIZE = np.float32(0.4), np.float32(0.7)
SHAPES = pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (37, 53), (5, 700)], ids=str)


def picture(shape, rough=1.0):
    """Return flags, slopes, normals' z squared, confidences, anchors, known heights, and heights."""
    rng = np.random.default_rng(shape[0] * 1000 + shape[1])
    flags = ((rng.random(shape) < 0.85) * RIGHT + (rng.random(shape) < 0.85) * DOWN).astype(np.uint8)
    flags[:, -1] &= DOWN
    flags[-1] &= RIGHT
    slopes = [rng.normal(0, 0.5, shape) for _ in range(2)]
    sure = [rng.uniform(0.1, 2, shape) for _ in range(2)]
    anchor, known = rng.uniform(0, 1, shape) * (rng.random(shape) < 0.3), rng.normal(0, 2, shape)
    maps = [*slopes, rng.uniform(0.2, 1, shape), *sure, anchor, known, rough * rng.normal(0, 0.5, shape)]
    return flags, *(one.astype(np.float32) for one in maps)


def run(device, name, shape, arguments, outputs, known=1):
    """Run a kernel; `outputs` are sizes of new arrays, or maps that it changes."""

    def put(values):
        values = np.asarray(values)
        if values.ndim == 0:
            return float(values)
        dtype = np.uint8 if values.dtype == np.uint8 else np.float32
        array = device.array("map", values.shape, dtype)
        array.host[...] = values
        array.upload()
        return array

    chunk = min(device.layout.tile, 256)
    pieces = shape[0] * -(-shape[1] // chunk)
    items = -(-shape[0] * shape[1] // device.layout.tile) if name == "step" else pieces
    made = [put(np.full(shape, np.nan) if one is None else one) for one in outputs]
    if name == "shares":
        made.append(put(np.full(pieces, np.nan)))
    given = [put(one) for one in arguments]
    kernel = device.kernel("bilateral", f"bilateral_{name}", KNOWN=known)
    launch(kernel, items, *shape, *given, *made)
    return [array.download() for array in made]


@SHAPES
@pytest.mark.parametrize(("k", "rough"), [(0.0, 1.0), (0.5, 1.0), (2.0, 1e-3), (2.0, 1e4), (60.0, 1.0)])
def test_shares_and_energy_are_those_of_the_reference(device, shape, k, rough):
    maps = picture(shape, rough)
    x, y, sums = run(device, "shares", shape, [*maps, k, *SIZE], [None, None])
    wanted_x, wanted_y, energy = bilateral.bilateral_shares(*maps, k, *SIZE)
    for one, other in ((x, wanted_x), (y, wanted_y)):
        # Squares of misfits have 7 digits: where they are huge, and nearly equal, none is left of the share.
        assert np.mean(np.abs(one - other) > 3e-6 * (1 + k)) <= (0.01 if rough > 1 else 0.0)
    np.testing.assert_allclose(sums.sum(dtype=float), energy, rtol=3e-6)


def test_no_known_heights_cost_nothing(device):
    maps = picture((7, 11))
    free = [one for number, one in enumerate(maps) if number not in (6, 7)]
    *_, sums = run(device, "shares", (7, 11), [*free, 2.0, *SIZE], [None, None], known=0)
    _, _, energy = bilateral.bilateral_shares(*maps[:6], 0 * maps[6], *maps[7:], 2.0, *SIZE)
    np.testing.assert_allclose(sums.sum(dtype=float), energy, rtol=2e-6)


@SHAPES
def test_links_and_what_is_left_over_are_those_of_the_reference(device, shape):
    maps = picture(shape)
    share_x, share_y, _ = bilateral.bilateral_shares(*maps, 2.0, *SIZE)
    arguments = [*maps[:6], share_x.astype(np.float32), share_y.astype(np.float32), maps[8], *SIZE]
    wanted = bilateral.bilateral_links(*arguments)
    found = run(device, "links", shape, arguments, [None] * 4)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)
    (left,) = run(device, "residual", shape, [*found[2:], *maps[6:]], [None])
    np.testing.assert_allclose(left, bilateral.bilateral_residual(*wanted[2:], *maps[6:]), atol=6e-6)
    (free,) = run(device, "residual", shape, found[2:], [None], known=0)
    np.testing.assert_allclose(free, bilateral.bilateral_residual(*wanted[2:], 0, 0, maps[8]), atol=6e-6)


@SHAPES
def test_links_open_where_there_is_curl(device, shape):
    flags, slope_x, slope_y = picture(shape)[:3]
    (curl,) = run(device, "curl", shape, [flags, slope_x, slope_y, *SIZE], [None])
    wanted = bilateral.bilateral_curl(flags, slope_x, slope_y, *SIZE)
    np.testing.assert_allclose(curl, wanted, atol=1e-6)
    links = [np.full(shape, value, np.float32) for value in (1, 2, 3, 4)]
    found = run(device, "open", shape, [curl, 0.3], links)
    for one, other in zip(found, bilateral.bilateral_open(curl, 0.3, *links), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)


def soft_minimum(squares, k):
    """Return -1/k ln of the mean of exp(-k square), of one or two."""
    least = min(squares)
    mean = sum(math.exp(-k * (square - least)) for square in squares) / len(squares)
    return least - math.log(mean) / k


def energy_by_hand(maps, k):
    flags, slope_x, slope_y, steep, confidence_x, confidence_y, anchor, known, u = (
        one.astype(float) for one in maps
    )
    total = 0.0
    for row, column in np.ndindex(flags.shape):
        here = row, column
        total += anchor[here] * (u[here] - known[here]) ** 2
        for bit, slope, sure, size, (down, right) in (
            (RIGHT, slope_x, confidence_x, SIZE[0], (0, 1)),
            (DOWN, slope_y, confidence_y, SIZE[1], (1, 0)),
        ):
            squares, before = [], (row - down, column - right)
            if int(flags[here]) & bit:
                rise = u[row + down, column + right] - u[here]
                squares.append(steep[here] * (rise / size - slope[here]) ** 2)
            if min(before) >= 0 and int(flags[before]) & bit:
                squares.append(steep[here] * ((u[here] - u[before]) / size - slope[here]) ** 2)
            total += sure[here] * (soft_minimum(squares, k) if squares else 0.0)
    return total


@pytest.mark.parametrize("k", [0.5, 2.0, 30.0])
def test_the_energy_is_that_of_soft_minima(k):
    maps = picture((6, 8))
    *_, energy = bilateral.bilateral_shares(*maps, k, *SIZE)
    assert energy == pytest.approx(energy_by_hand(maps, k), rel=1e-9)


def test_what_is_left_over_is_how_the_energy_falls():
    maps = picture((5, 6))
    share_x, share_y, _ = bilateral.bilateral_shares(*maps, 2.0, *SIZE)
    pulls = bilateral.bilateral_links(*maps[:6], share_x, share_y, maps[8], *SIZE)[2:]
    area = SIZE[0] * SIZE[1]
    left = bilateral.bilateral_residual(*pulls, area * maps[6], *maps[7:])
    change = 2.0**-10  # exact in float32 at these heights, nearly
    for place in np.ndindex(5, 6):
        energies = []
        for sign in (1, -1):
            heights = maps[8].astype(float)
            heights[place] += sign * change
            energies.append(bilateral.bilateral_shares(*maps[:8], heights, 2.0, *SIZE)[2])
        assert (energies[1] - energies[0]) / (4 * change) == pytest.approx(left[place] / area, abs=2e-4)
