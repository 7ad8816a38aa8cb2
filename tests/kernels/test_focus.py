"""The contrast around each pixel: the kernel against the reference, and that against exact numbers."""

import numpy as np
import pytest

from mirrorskin.kernels.device import C_TYPES
from mirrorskin.kernels.focus import focus_scan

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


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize(("radius", "reach"), [(1, 1), (3, 2)])
def test_the_kernel_is_the_reference(device, dtype, radius, reach):
    frames = FRAMES.astype(dtype)
    if dtype == "float32":
        frames[4, 5, 20] = np.nan
        frames[0, 9, 50] = np.nan
    best, peak, recent = expected = state(reach)
    arrays = [
        device.given("state", one, kind) for one, kind in zip(expected, ("i4", "f4", "f4"), strict=True)
    ]
    scan = device.kernel("focus", "focus_scan", FRAME=C_TYPES[dtype])
    for part in (slice(0, 4), slice(4, 9)):
        focus_scan(frames[part], part.start, radius, reach, best, peak, recent)
        scan(
            -(-best.size // device.layout.tile), frames=device.given("frames", frames[part], dtype),
            count=part.stop - part.start, rows=SHAPE[0], columns=SHAPE[1], first=part.start, radius=radius,
            reach=reach, best=arrays[0], peak=arrays[1], recent=arrays[2], moved=0,
        )  # fmt: skip
    for found, one in zip(arrays, expected, strict=True):
        np.testing.assert_allclose(found.download(), one, rtol=2e-5)
