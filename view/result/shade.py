"""Heights as a lit surface: colour tells how high, light how steep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mirrorskin.engine.nearest import with_nearest
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import filled_colours
from mirrorskin.view.colours import MISSING_RGB, Colours

_LAMP = 315.0, 45.0  # degrees: azimuth clockwise from above, which is the upper left, and elevation
_SMOOTH = 1.0  # pixels, of the slopes that light falls on: steps of a press are no terraces
_SHOWN = 98.0  # per cent of the slopes that the light tells apart
_STEEPEST = 20.0  # light tells gentle slopes apart as if they were so many times as steep


def shaded(
    height: NDArray[np.float32],
    filled: NDArray[np.bool_],
    pixel: tuple[float, float],
    span: tuple[float, float],
) -> Colours:
    """Return the colours of heights under a lamp at the upper left.

    Parameters
    ----------
    height : ndarray, (H, W), float32
        Millimetres; NaN has the colour of what has no answer.
    filled : ndarray, (H, W), bool
        Where heights were not measured: these have colours of their own.
    pixel : (float, float)
        Size of a pixel along x and y, mm.
    span : (float, float)
        Heights at the ends of the colours, mm.

    Returns
    -------
    ndarray, (H, W, 3), uint8
    """
    from matplotlib import colormaps
    from matplotlib.colors import LightSource, Normalize

    known = np.isfinite(height)
    if not known.any():
        return np.broadcast_to(np.array(MISSING_RGB, np.uint8), (*height.shape, 3)).copy()
    level = Normalize(*span, clip=True)(np.where(known, height, span[0]))
    colours = np.where(
        filled[..., np.newaxis],
        filled_colours()(level, bytes=True)[..., :3],
        colormaps["viridis"](level, bytes=True)[..., :3],
    )
    lamp = LightSource(*_LAMP)
    light = _light(height, pixel, lamp.direction)
    lit = lamp.blend_soft_light(colours.astype(np.float32) / 255, light[..., np.newaxis])
    return np.asarray(np.where(known[..., np.newaxis], np.rint(255 * lit), MISSING_RGB), np.uint8)


def _light(height: NDArray[np.float32], pixel: tuple[float, float], lamp: Floats) -> NDArray[np.float32]:
    """Return the light on a surface, from 0 to 1; level ground has 0.5."""
    whole = gaussian_filter(with_nearest(height), _SMOOTH, mode="nearest")
    dz_dx, dz_dy = _slope(whole, pixel[0], 1), -_slope(whole, pixel[1], 0)
    change = (lamp[2] - lamp[0] * dz_dx - lamp[1] * dz_dy) / np.sqrt(1 + dz_dx**2 + dz_dy**2) - lamp[2]
    usual = float(np.percentile(np.abs(change[np.isfinite(height)]), _SHOWN))
    return np.asarray(np.clip(0.5 + change * min(0.5 / max(usual, 1e-9), _STEEPEST), 0, 1), np.float32)


def _slope(height: NDArray[np.float32], step: float, axis: int) -> Floats:
    """Return the change along an axis of the array, mm per mm; 0 along a single row or column."""
    if height.shape[axis] == 1:
        return np.zeros(height.shape)
    return np.asarray(np.gradient(height.astype(np.float64), step, axis=axis))
