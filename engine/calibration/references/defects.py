"""Which pixels are hot, dead or saturated, told from their dark and bright levels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from mirrorskin.engine.calibration.references.levels import Level, rare_ratio
from mirrorskin.io.calibration.types import DEAD, HOT, SATURATED
from mirrorskin.io.types import Floats

_WINDOW = 5  # pixels across and down of a neighbourhood
_MEDIAN = 0.6745  # of the magnitude of a normal variate
_FAR = 7.0  # standard deviations
_GLOW = 0.05  # of full light: what a pixel may glow more than its neighbours, whatever its noise
_GLARE = 0.5  # of full light: what no sound pixel shows without light
_UNREST = 16.0  # usual variances: four times the usual noise
_WEAK = 0.5  # of the neighbours' light
_BLIND = 0.1  # of the light of the picture's brighter pixels
_BRIGHTER = 90.0  # per cent of the pixels that show less light than these
_FULL = 0.1  # of a pixel's samples that are clipped


def full_span(span: Floats) -> float:
    """Return how many counts light makes in the picture's brighter pixels; 0 if none is told."""
    known = span[np.isfinite(span)]
    return float(np.percentile(known, _BRIGHTER)) if known.size else 0.0


def find_defects(dark: Level, bright: Level, freedom: int, whole: bool) -> NDArray[np.uint8]:
    """Find the pixels that are of no use.

    Vignetting, uneven gains and a dark level that rises across the picture are no defects: what decides is
    how a pixel compares with the median of the 5 x 5 around it.

    - *hot*: its dark level is above theirs by more than seven standard deviations of such differences
      (told from their median) and by more than 5 % of full light, or is above half of full light; or
      its dark samples scatter four times as much as usual.
    - *dead*: light makes less than half as much of it as of them, or less than a tenth of what it makes of
      the picture's brighter pixels, or no more than its noise; or it gave no numbers.
    - *saturated*: a tenth of its samples in full light lie on the top of the camera's scale.

    Parameters
    ----------
    dark, bright : Level
    freedom : int
        Degrees of freedom of a pixel's own dark variance.
    whole : bool
        Whether samples are whole numbers; their rounding is no unrest.

    Returns
    -------
    ndarray, (H, W), uint8
        A sum of 1 hot, 2 dead, 4 saturated; 0 of a sound pixel.
    """
    span = bright.value - dark.value
    light = full_span(span)
    hot = _glows(dark.value, bright.value, light) | _is_restless(dark, freedom, whole)
    bits = HOT * hot + DEAD * _is_dead(span, light, dark, bright) + SATURATED * (bright.clipped >= _FULL)
    return np.asarray(bits, np.uint8)


def _glows(dark: Floats, bright: Floats, light: float) -> NDArray[np.bool_]:
    above = dark - _around(dark)
    known = above[np.isfinite(above)]
    usual = float(np.median(np.abs(known))) / _MEDIAN if known.size else 0.0
    middle = float(np.nanmedian(dark)) if known.size else 0.0
    return np.asarray((above > max(_FAR * usual, _GLOW * light)) | (dark > middle + _GLARE * light))


def _is_restless(dark: Level, freedom: int, whole: bool) -> NDArray[np.bool_]:
    usual = max(_UNREST, rare_ratio(max(freedom, 1)))
    # Almost without noise, samples that jump between two whole numbers scatter far more than usual ones.
    return np.asarray((dark.excess > usual) & ((dark.excess * dark.noise**2 > 1) | (not whole)))


def _is_dead(span: Floats, light: float, dark: Level, bright: Level) -> NDArray[np.bool_]:
    noise = _FAR * np.sqrt(dark.sigma**2 + bright.sigma**2)
    seen = span > np.maximum(noise, max(_BLIND * light, 0.0))
    return np.asarray(~(seen & (span >= _WEAK * _around(span))))


def _around(values: Floats) -> Floats:
    """Return the median of each pixel's neighbourhood; pixels without a value count as the median of all."""
    known = values[np.isfinite(values)]
    filled = np.where(np.isfinite(values), values, np.median(known) if known.size else 0.0)
    return np.asarray(median_filter(filled.astype(np.float32), _WINDOW, mode="mirror"), np.float64)
