"""The contrast around each pixel: the kernel against the reference, and that against exact numbers."""

import numpy as np
import pytest
from launches import launch

from mirrorskin.kernels.focus import focus_fit, focus_scan

SHAPE = (11, 130)
FRAMES = np.random.default_rng(0).integers(0, 250, (9, *SHAPE))


def state(reach):
    return np.zeros(SHAPE, np.int32), np.zeros((2 * reach + 1, *SHAPE)), np.zeros((reach, *SHAPE))


def test_the_contrast_is_the_sum_of_squares_about_the_mean_of_the_window():
    best, peak, recent = state(1)
    focus_scan(FRAMES[:1], 0, 2, 1, best, peak, recent)
    assert peak[1, 5, 70] == pytest.approx(25 * FRAMES[0, 3:8, 68:73].var())
    assert peak[1, 0, 0] == pytest.approx(9 * FRAMES[0, :3, :3].var())


def test_the_frames_around_the_greatest_contrast_are_kept():
    best, peak, recent = state(2)
    for first in range(9):
        focus_scan(FRAMES[first : first + 1], first, 1, 2, best, peak, recent)
    window = FRAMES[:, 4:7, 59:62].reshape(9, 9).astype(float)
    contrast = np.pad(window.var(axis=1) * 9, 2, constant_values=np.nan)
    top = np.nanargmax(contrast) - 2
    assert best[5, 60] == top
    np.testing.assert_allclose(peak[:, 5, 60], contrast[top : top + 5])


@pytest.mark.parametrize("reach", [1, 2, 4])
@pytest.mark.parametrize("noise", [0.0, 1.5])
def test_the_kernel_fits_as_the_reference(device, reach, noise):
    generator = np.random.default_rng(1)
    travel = np.cumsum(generator.uniform(0.01, 0.03, 12))
    best = generator.integers(0, 12, SHAPE).astype(np.int32)
    frame = best + np.arange(-reach, reach + 1)[:, None, None]
    around = np.arange(12)[:, None] + np.arange(-reach, reach + 1)
    places = ((travel[np.clip(around, 0, 11)] - travel[:, None]) / 0.02).astype(np.float32)
    place = np.moveaxis(places[best], -1, 0)
    peak = 4000 * np.exp(-((place - generator.uniform(-0.4, 0.4, SHAPE)) ** 2) / 8)
    peak = (peak * generator.uniform(0.98, 1.02, peak.shape)).astype(np.float32)
    peak[(frame < 0) | (frame > 11)] = np.nan
    peak[:, 3, 7], peak[1:, 4, 9], peak[:, 5, 5] = np.nan, np.nan, 3.0
    travel = travel.astype(np.float32)
    options = (2, reach, noise**2, 5.0, 3.0)
    expected = [*(np.empty(SHAPE) for _ in range(5)), np.empty(SHAPE, np.uint8)]
    focus_fit(*options, places, travel, 0.02, best, peak, *expected)
    found = [device.array("map", SHAPE, one.dtype.char.replace("d", "f")) for one in expected]
    tables = [device.given("table", table) for table in (places, travel)]
    launch(
        device.kernel("focus", "focus_fit", FRAME="uchar"), -(-best.size // device.layout.tile), *SHAPE, 12,
        *options, *tables, 0.02, device.given("best", best, np.int32), device.given("peak", peak), *found,
    )  # fmt: skip
    assert {*expected[5].flat} == {0, 1, 2, 3}
    found = [one.download() for one in found]
    assert np.mean(found[5] != expected[5]) < 1e-3  # float32 decides of what is at a limit
    sound = (expected[5] == 1) & (found[5] == 1)
    np.testing.assert_allclose(found[0][sound], expected[0][sound], rtol=1e-5)
    np.testing.assert_allclose(found[4], expected[4], rtol=1e-4)
    for k, part in ((1, 1e-3), (2, 1e-3)):
        np.testing.assert_allclose(found[k][sound], expected[k][sound], rtol=part)
    known = sound & np.isfinite(expected[3])
    assert known.any() == (reach > 1)
    scale = np.abs(expected[3][known]).max(initial=0)
    np.testing.assert_allclose(found[3][known], expected[3][known], rtol=2e-2, atol=1e-3 * scale)
