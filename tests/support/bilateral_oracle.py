"""Heights across depth discontinuities that nobody marked, in float64: bilateral weights, solved directly.

It shares no code with mirrorskin. Every pixel asks, along x and along y, that the surface go on from it with
its slope s, to either side: with a = n_z = 1 / sqrt(1 + s_x^2 + s_y^2) and the pixel size p,

    r+ = a (z_next - z - p s) / p        r- = a (z_previous - z + p s) / p

are by how many pixels that fails, seen across the surface. On a discontinuity one of the two must fail, so
only the better one is to count: with a soft minimum the energy is the sum over pixels and axes of

    F = -(1/k) ln((exp(-k r+^2) + exp(-k r-^2)) / 2)

or r^2 where there is a neighbour on one side alone. For weights w+- = exp(-k r+-^2) / sum, held while the
squares w r^2 are minimised, F never rises.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.special import expit

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST = 1e-9  # of a weight, so that what has come loose keeps a place


class Terms(NamedTuple):
    """All residuals, `matrix @ z - wanted` in pixels: those r+ first, then those r- of the same pixels."""

    matrix: sparse.csr_array  # (terms, n)
    wanted: Map  # (terms,)
    there: Mask  # (2, terms / 2): whether there is a neighbour
    place: NDArray[np.intp]  # (H, W): number of the unknown, -1 where there is none

    def residuals(self, heights: Map) -> Map:
        """Return r+ and r-, (2, terms / 2); of no meaning where there is no neighbour."""
        return np.asarray(self.matrix @ heights - self.wanted).reshape(2, -1)


class Found(NamedTuple):
    """What the alternation ends with."""

    height: Map  # (H, W), mm, about the mean of each region of the mask
    energy: list[float]  # of every step


def terms(dz_dx: Map, dz_dy: Map, pixel_size: tuple[float, float], mask: Mask) -> Terms:
    """Write down the residuals of a picture."""
    shape = mask.shape
    place = np.where(mask, np.cumsum(mask.ravel()).reshape(shape) - 1, -1)
    facing = 1 / np.sqrt(1 + dz_dx**2 + dz_dy**2)
    ringed = np.pad(place, 1, constant_values=-1)
    centre = ringed[1:-1, 1:-1]
    around = {  # the next along x and y, and the previous; y grows upwards
        "x": (ringed[1:-1, 2:], ringed[1:-1, :-2], pixel_size[0], dz_dx),
        "y": (ringed[:-2, 1:-1], ringed[2:, 1:-1], pixel_size[1], dz_dy),
    }
    sides: list[list[tuple[sparse.csr_array, Map, Mask]]] = [[], []]
    for following, previous, size, slope in around.values():
        for number, (neighbour, sign) in enumerate(((following, 1.0), (previous, -1.0))):
            there = (neighbour >= 0)[mask]
            share = np.where(there, facing[mask] / size, 0.0)
            rows = np.arange(len(share))
            ends = np.concatenate([np.where(there, neighbour[mask], 0), centre[mask]])
            values = np.concatenate([share, -share])
            matrix = sparse.csr_array((values, (np.tile(rows, 2), ends)), shape=(len(share), len(share)))
            sides[number].append((matrix, sign * share * size * slope[mask], there))
    ordered = sides[0] + sides[1]
    return Terms(
        sparse.csr_array(sparse.vstack([part[0] for part in ordered])),
        np.concatenate([part[1] for part in ordered]),
        np.concatenate([part[2] for part in ordered]).reshape(2, -1),
        place,
    )


def energy(asked: Terms, heights: Map, k: float) -> float:
    """Return F of heights (n,), mm."""
    square = asked.residuals(heights) ** 2
    both = asked.there.all(axis=0)
    least = square.min(axis=0)
    soft = least - np.log((1 + np.exp(-k * (square.max(axis=0) - least))) / 2) / k
    lone = np.where(asked.there, square, 0).sum(axis=0)
    return float(np.where(both, soft, lone).sum())


def energy_of(asked: Terms, picture: NDArray[np.floating], k: float) -> float:
    """Return F of heights (H, W)."""
    return energy(asked, picture[asked.place >= 0].astype(float), k)


def weights(asked: Terms, heights: Map, k: float) -> Map:
    """Return w+ and w-, (2, terms / 2)."""
    square = asked.residuals(heights) ** 2
    share = expit(k * (square[1] - square[0]))
    return np.where(asked.there.all(axis=0), [share, 1 - share], asked.there)


def alternate(asked: Terms, k: float, steps: int = 300, tolerance: float = 1e-7) -> Found:
    """Begin with equal weights, and change weights and heights in turns until F stays."""
    share = np.where(asked.there.all(axis=0), 0.5, asked.there)
    heights, course = _squares(asked, share), [np.inf]
    course.append(energy(asked, heights, k))
    while len(course) < steps + 2 and course[-2] - course[-1] > tolerance * course[-1]:
        heights = _squares(asked, weights(asked, heights, k))
        course.append(energy(asked, heights, k))
    picture = np.full(asked.place.shape, np.nan)
    picture[asked.place >= 0] = heights
    return Found(picture, course[1:])


def _squares(asked: Terms, share: Map) -> Map:
    """Minimise the weighted squares; the mean of what hangs together in the mask is 0."""
    counted = sparse.diags_array(np.maximum(share, _LEAST * asked.there).ravel())
    matrix = sparse.csr_array(asked.matrix.T @ counted @ asked.matrix)
    source = asked.matrix.T @ (counted @ asked.wanted)
    _, label = connected_components(matrix, directed=False)
    _, first = np.unique(label, return_index=True)
    kept = np.ones(len(source), bool)
    kept[first] = False
    heights = np.zeros(len(source))
    factors = splu(matrix[kept][:, kept].tocsc(), permc_spec="COLAMD", diag_pivot_thresh=0.0)
    heights[kept] = factors.solve(source[kept])
    mean = np.bincount(label, heights) / np.bincount(label)
    return np.asarray(heights - mean[label])
