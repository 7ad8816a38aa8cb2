"""The alternation of `bilateral_oracle` with slopes that are not equally sure, and with known heights.

It shares no code with mirrorskin. A pixel's slopes count c times in the energy, and a known height k costs
h (z - k)^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from bilateral_oracle import Map, Mask, terms, weights
from scipy import sparse
from scipy.sparse.linalg import splu

_LEAST = 1e-9  # of a weight, so that nothing comes loose altogether


@dataclass(frozen=True)
class Weighed:
    """Slopes (H, W) with inverse variances, and heights in mm, NaN where unknown, with theirs."""

    dz_dx: Map
    dz_dy: Map
    pixel_size: tuple[float, float]
    mask: Mask
    sure_x: Map
    sure_y: Map
    known: Map
    sure_z: Map

    def held(self) -> tuple[Map, Map]:
        """Return the known heights of the pixels in the mask and their inverse variances, 0 where unknown."""
        there = np.isfinite(self.known)
        return np.where(there, self.known, 0)[self.mask], np.where(there, self.sure_z, 0)[self.mask]

    def energy(self, picture: Map, k: float) -> float:
        """Return the energy of heights (H, W)."""
        heights = picture[self.mask].astype(float)
        known, sure = self.held()
        total = float(np.sum(sure * (heights - known) ** 2))
        asked = terms(self.dz_dx, self.dz_dy, self.pixel_size, self.mask)
        half = asked.there.shape[1] // 2
        square = asked.residuals(heights) ** 2
        both = asked.there.all(axis=0)
        mean = np.exp(-k * square).mean(axis=0)
        least = square.min(axis=0) + np.log(2) / k
        with np.errstate(divide="ignore"):
            soft = np.where(mean > 1e-290, -np.log(mean) / k, least)
        cost = np.where(both, soft, np.where(asked.there, square, 0).sum(axis=0))
        return total + float(self.sure_x[self.mask] @ cost[:half] + self.sure_y[self.mask] @ cost[half:])

    def alternate(self, k: float, steps: int = 100, tolerance: float = 1e-7) -> tuple[Map, list[float]]:
        """Begin with equal weights, and change weights and heights in turns; return heights and energies."""
        asked = terms(self.dz_dx, self.dz_dy, self.pixel_size, self.mask)
        sure = np.tile(np.concatenate([self.sure_x[self.mask], self.sure_y[self.mask]]), (2, 1))
        known, held = self.held()
        picture, course = np.full(self.mask.shape, np.nan), [np.inf, np.inf]
        share = np.where(asked.there.all(axis=0), 0.5, asked.there)
        while len(course) < steps + 2 and not course[-2] - course[-1] <= tolerance * course[-1]:
            counted = sparse.diags_array((sure * np.maximum(share, _LEAST * asked.there)).ravel())
            matrix = asked.matrix.T @ counted @ asked.matrix + sparse.diags_array(held)
            source = asked.matrix.T @ (counted @ asked.wanted) + held * known
            heights = splu(sparse.csc_array(matrix)).solve(source)
            picture[self.mask] = heights
            course.append(self.energy(picture, k))
            share = weights(asked, heights, k)
        return picture, course[2:]
