"""From references to light levels: the kernels against their NumPy references, to the last bit."""

import numpy as np
import pytest

from mirrorskin.engine import OnsetSearch
from mirrorskin.kernels import onset as reference

SHAPE = (61, 67)
TOP = {"uint8": 255, "uint16": 65535, "float32": 3.0}


def random_references(dtype, seed):
    """References of all kinds: plain, fractional, beyond the range, negative, equal, swapped, no numbers."""
    generator = np.random.default_rng(seed)
    top = TOP[dtype]
    dark = generator.uniform(-0.2, 0.6, SHAPE) * top
    bright = dark + generator.uniform(0, 1, SHAPE) * top
    whole = generator.random(SHAPE) < 0.5
    dark, bright = np.where(whole, np.rint(dark), dark), np.where(whole, np.rint(bright), bright)
    odd = generator.random(SHAPE)
    bright = np.select([odd < 0.02, odd < 0.04, odd < 0.06], [dark, dark - 1, np.inf], bright)
    dark = np.select([odd > 0.98, odd > 0.96], [np.nan, -np.inf], dark)
    return dark.astype(np.float32), bright.astype(np.float32)


@pytest.mark.parametrize("event", ["onset", "release"])
@pytest.mark.parametrize("threshold", [0.0, 0.1, 0.5, 0.55, 0.9, 1.0])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_levels_are_those_of_the_reference(device, dtype, threshold, event):
    dark, bright = random_references(dtype, seed=1)
    noise = 0.01 * TOP[dtype]
    search = OnsetSearch(
        SHAPE, dtype, dark=dark, bright=bright, threshold=threshold, noise=noise, event=event, device=device
    )
    (band,) = search._bands
    known = band.maps["levels"].download().copy()[:, : band.pixels].reshape(2, *SHAPE)
    search.push(np.zeros((1, *SHAPE), dtype), travel=np.zeros(1))  # looks for what is surely dark
    for name in ("marks", "closed"):
        band.maps[name].download()
    level, plateau, light = reference.onset_levels(
        bright, dark, threshold - 1e-12, np.dtype(dtype), release=event == "release"
    )
    alive = np.isfinite(level)
    assert 0.6 < np.mean(alive) < 0.99  # a release needs levels above 0
    np.testing.assert_array_equal(band.plane("closed", 1) == 0, alive)
    # A level that is 0 but for rounding is so in float64, too.
    found, zero = known[0], np.abs(level) < 1e-6
    np.testing.assert_array_equal(found[alive & ~zero], level[alive & ~zero])
    np.testing.assert_allclose(found[alive & zero], level[alive & zero], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(known[1][alive], plateau[alive])
    np.testing.assert_array_equal(band.plane("marks", 0)[alive], light[alive])
    sure = reference.onset_sure(level, light, 6 * noise)
    np.testing.assert_array_equal(band.plane("marks", 1)[alive], sure[alive])


def test_pixels_beside_the_picture_are_closed(device):
    search = OnsetSearch((3, 7), np.uint8, device=device)
    (band,) = search._bands
    closed = band.maps["closed"].download()[1]
    np.testing.assert_array_equal(closed != 0, np.arange(closed.size) >= 21)
