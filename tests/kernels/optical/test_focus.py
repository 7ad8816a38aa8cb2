"""The contrast around each pixel: the kernel compared with the reference, and that with exact numbers."""

import numpy as np
import pytest

from mirrorskin.kernels.optical.focus import focus_scan

SHAPE = (11, 130)
FRAMES = np.random.default_rng(0).integers(0, 250, (9, *SHAPE))


def state(reach):
    """Return the maps best, peak, recent, detail and last."""
    planes = (np.zeros((count, *SHAPE)) for count in (2 * reach + 1, reach, 2 * reach + 1, 2 * reach + 1))
    return np.zeros(SHAPE, np.int32), *planes


def test_the_contrast_is_the_sum_of_squares_about_the_mean_of_the_window():
    _, peak, *_ = maps = state(1)
    focus_scan(FRAMES[:1], 0, 2, 1, 0, 1, *maps)
    assert peak[1, 5, 70] == pytest.approx(25 * FRAMES[0, 3:8, 68:73].var())
    assert peak[1, 0, 0] == pytest.approx(9 * FRAMES[0, :3, :3].var())


def test_the_frames_around_the_greatest_contrast_are_kept():
    best, peak, *_ = maps = state(2)
    for first in range(9):
        focus_scan(FRAMES[first : first + 1], first, 1, 2, 0, 1, *maps)
    window = FRAMES[:, 4:7, 59:62].reshape(9, 9).astype(float)
    contrast = np.pad(window.var(axis=1) * 9, 2, constant_values=np.nan)
    top = np.nanargmax(contrast) - 2
    assert best[5, 60] == top
    np.testing.assert_allclose(peak[:, 5, 60], contrast[top : top + 5])
