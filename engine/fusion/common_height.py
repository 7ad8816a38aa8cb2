"""Uncertainty of the common height of a fused surface, from the boundaries between the steps of a press.

Errors of pixels along a boundary are not independent, so their number does not reduce the error of the common
height. At each step, the pixels in contact must be the highest ones: each step shows an error of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mirrorskin.io import Result
from mirrorskin.kernels.array_types import Doubles

_CLEAR = 2.0  # error of the common height, in standard deviations, from which on it is removed
_MIN_PIXELS = 16  # on either side of a step that shows an error
_MIN_SHARE = 0.01  # of a component's pixels on either side; less with many steps,
_MIN_EVEN_SHARE = 0.125  # of the pixels of an average step
_NARROWED = 1.0  # standard deviations of heights by which their noise narrows the range of a boundary
_MAX_CONTRADICTING = 0.25  # pixels that contradict a step, as a share of those on the smaller side


class CommonHeight(NamedTuple):
    """Error of the height that the largest component has in common, mm."""

    shift: float = 0.0  # that was removed
    sigma: float | None = None  # standard deviation that was added; None if no step shows it


@dataclass(frozen=True, slots=True)
class PressSteps:
    """Onsets of a press, and the travel of its frames.

    Attributes
    ----------
    onset : (H, W) array, float64
        Travel at the onset of each pixel, mm; NaN where unknown.
    correction : (H, W) array, float64
        What corrections, such as that for the elastomer, added to the heights, mm.
    sigma : (H, W) array, float64
        Standard deviations of the heights, mm.
    travel : (T,) array, float64
        Travel of the frames, mm, increasing.
    travel_sigma : float
        Standard deviation of the travel, mm; 0 unless it is stated.
    """

    onset: Doubles
    correction: Doubles
    sigma: Doubles
    travel: Doubles
    travel_sigma: float

    @classmethod
    def of(
        cls,
        height: Doubles,
        corrected: Doubles,
        sigma: Doubles,
        travel: Doubles,
        travel_sigma: float | None = None,
    ) -> PressSteps | None:
        """Return the steps of heights before and after corrections; None unless the travel is monotonic."""
        direction = np.diff(travel)
        if not ((direction > 0).all() or (direction < 0).all()):
            return None
        onset = np.where(np.isfinite(corrected), -height, np.nan)
        return cls(onset, corrected - height, sigma, np.sort(travel), travel_sigma or 0.0)

    def place(self, surface: Result) -> tuple[Result, CommonHeight]:
        """Remove a clear error of the common height, and add its uncertainty to ``height_sigma``.

        At each step, the heights that the fewest pixels contradict are compared with the travel: they are a
        range, because the boundary is between two pixels, and its middle has the error e_i. Noise of the
        heights narrows that range, so its width w_i is that observed plus their standard deviation.
        The mean error over the m steps that show one has the variance, the larger of ::

            sum (w_i^2 / 12) / m^2  and  (mean (w_i^2 / 12) + sum (e_i - mean e)^2) / m^2

        times 1 + 1 / m, because few steps show their scatter inaccurately.
        A component without such a step is known at most as well as a single height of the press.
        """
        height = np.asarray(surface.height)
        usable = np.isfinite(height) & np.isfinite(self.onset) & (surface.component >= 0)
        label = surface.component[usable]
        depth = (self.correction - height)[usable]
        onset, sigma = self.onset[usable], self.sigma[usable]
        noise = np.zeros(depth.size) if surface.height_sigma is None else surface.height_sigma[usable]
        count = len(surface.offset_unknown)
        shifts, added, least = np.zeros(count), np.zeros(count), np.zeros(count)
        sizes = np.bincount(label, minlength=count)
        order = np.lexsort((depth, label))
        found = CommonHeight()
        for component, end in zip(np.flatnonzero(sizes), np.cumsum(sizes[sizes > 0]), strict=True):
            part = order[end - sizes[component] : end]
            if part.size == 1:
                continue
            errors, variances = self._errors(depth[part], onset[part], float(np.nanmedian(noise[part])))
            if not errors.size:
                least[component] = np.median(sigma[part])
                continue
            mean = float(errors.mean())
            scatter = float(variances.mean() + np.sum((errors - mean) ** 2))
            variance = max(float(variances.sum()), scatter) / errors.size**2
            added[component] = math.sqrt(variance * (1 + 1 / errors.size))
            if abs(mean) > _CLEAR * added[component]:
                shifts[component] = mean
            if component == np.argmax(sizes):
                found = CommonHeight(float(shifts[component]), float(added[component]))
        at = np.maximum(surface.component, 0)
        inside = surface.component >= 0
        shifted = height + np.where(inside, shifts[at], 0.0).astype(np.float32)
        placed = surface.assign(height=shifted)
        if surface.height_sigma is not None:
            total = np.hypot(surface.height_sigma, np.where(inside, added[at], 0.0))
            total = np.maximum(total, np.where(inside, least[at], 0.0))
            placed = placed.assign(height_sigma=total.astype(np.float32))
        return placed, found

    def _errors(self, depth: Doubles, onset: Doubles, noise: float) -> tuple[Doubles, Doubles]:
        """Return, for each step that shows it, by how much sorted depths are too large there, mm.

        Of the pixels within half a step, those in contact must be the highest ones. The variances, mm^2, are
        those of a boundary anywhere in the range that the fewest pixels contradict, of the noise of heights,
        and of the travel.
        """
        places = self.travel
        share = min(_MIN_SHARE, _MIN_EVEN_SHARE / max(1, places.size - 1))
        fewest = max(_MIN_PIXELS, share * depth.size)
        limits = np.searchsorted(depth, (places[1:] + places[:-1]) / 2)
        errors, variances = [], []
        for place, first, end in zip(places[1:-1], limits[:-1], limits[1:], strict=True):
            near, touched = depth[first:end], onset[first:end] < place
            smaller = min(np.count_nonzero(touched), np.count_nonzero(~touched))
            if smaller < fewest:
                continue
            wrong = np.concatenate([[0], np.cumsum(~touched)])
            wrong += np.concatenate([np.cumsum(touched[::-1])[::-1], [0]])
            if wrong.min() > _MAX_CONTRADICTING * smaller:
                continue
            edges = np.concatenate([near[:1], near, near[-1:]])  # between them, as many are wrong
            best = np.flatnonzero(wrong == wrong.min())
            least, greatest = edges[best[0]], edges[best[-1] + 1]
            errors.append((least + greatest) / 2 - place)
            width = greatest - least + _NARROWED * noise
            variances.append(width**2 / 12 + self.travel_sigma**2)
        return np.array(errors), np.array(variances)
