"""Surfaces with real and apparent jumps of depth, and the areas where normals determine the height.

Nowhere do normals tell how deep a step is that no slope leads up or down. So heights are compared within
each part of the picture that hangs together, each about its own median. Within it, pixels count whose height
the direct solve of the same noisy slopes gets within 1 % of the step when it is told where the steps are:
elsewhere it is the noise, or the pixels' coarseness, that errs. Nor do pixels count within 3 of a step that
is less than 5 pixels deep, such as the end of a tear: there the energy's least may be a bend.

Where the lips of a tear differ by the same height all along, nothing tells between which pixels it runs; here
they part further and further.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import slope_oracle
from numpy.typing import NDArray
from scipy import ndimage

from mirrorskin.evaluation.scenes import surfaces

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]

RELIEF = 0.25  # mm, of the coin


class Case(NamedTuple):
    """What is looked at, with pixels of what size in mm, and how deep the step is in mm."""

    seen: surfaces.Sample
    pixel_size: tuple[float, float]
    step: float
    mask: Mask


def on_grid(
    surface: surfaces.Shape,
    shape: tuple[int, int],
    step: float,
    pixel_size: tuple[float, float] = (0.05, 0.05),
    mask: Mask | None = None,
) -> Case:
    """Look at a surface; the step is told in pixels."""
    mask = np.ones(shape, bool) if mask is None else mask
    return Case(surfaces.sample(surface, shape, pixel_size), pixel_size, step * pixel_size[0], mask)


def on_coin(x: float, y: float, shape: tuple[int, int], pixel: float = 0.016) -> Case:
    """Look at the twin's coin, round a place in mm."""
    from mirrorskin.twin.coin import Coin

    columns, rows = surfaces.places(shape)
    place = x + pixel * columns, y + pixel * rows
    view = surfaces.Sample(Coin().height(*place), *Coin().slope(*place), np.zeros(shape, np.intp))
    return Case(view, (pixel, pixel), RELIEF, np.ones(shape, bool))


def cap(size: float) -> surfaces.Shape:
    """Return a ball's cap, as far as a zenith of 55 degrees, whose rim is one radius above a plane."""
    return surfaces.ball_on_plane(size, size, float(np.sin(np.radians(55))))


CASES: dict[str, Callable[[], Case]] = {
    "ball on a plane, through a disc": lambda: on_grid(cap(32), (66, 71), 32, mask=surfaces.disc((66, 71))),
    "ball on a plane, long pixels": lambda: on_grid(cap(32), (50, 71), 32, (0.02, 0.028)),
    "stairs": lambda: on_grid(surfaces.stairs(2, 20, 30, 36), (24, 130), 30),
    "coin: writing": lambda: on_coin(-4.5, -5.3, (120, 120)),
    # One lip rises along the tear; below, where the sheet is whole, normals tell how far above the other.
    "torn sheet": lambda: on_grid(surfaces.tear(24, 60), (96, 96), 24),
}


def tilted(view: surfaces.Sample, angle: float, seed: int = 0) -> Map:
    """Return the slopes (2, H, W) of normals with noise of so many radians on each of their three numbers."""
    normals = np.stack([-view.dz_dx, -view.dz_dy, np.ones_like(view.dz_dx)])
    normals /= np.linalg.norm(normals, axis=0)
    normals += np.random.default_rng([seed, 21]).normal(0, angle, normals.shape)
    return np.asarray(-normals[:2] / normals[2])


def determined(case: Case, slopes: Map) -> NDArray[np.intp]:
    """Return the part to which a pixel belongs whose height normals determine, else -1, (H, W)."""
    problem = slope_oracle.Problem(slopes[0], slopes[1], case.pixel_size, case.mask)
    exact = slope_oracle.solve(problem, surfaces.joined(case.seen.side))
    off = exact.height - case.seen.height
    part = np.full(case.mask.shape, -1)
    for label in range(len(exact.offset_unknown)):
        within = exact.component == label
        part[within & (np.abs(off - np.median(off[within])) <= 0.01 * case.step)] = label
    part[ndimage.binary_dilation(beside_steps(case, below=5.0), iterations=3)] = -1
    return part


def errors(height: NDArray[np.floating], case: Case, part: NDArray[np.intp]) -> Map:
    """Return the error as a share of the step, about each part's median; NaN where none is determined."""
    error = np.full(height.shape, np.nan)
    for label in np.unique(part[part >= 0]):
        within = part == label
        off = height[within] - case.seen.height[within]
        error[within] = (off - np.median(off)) / case.step
    return error


def beside_steps(case: Case, below: float = np.inf) -> Mask:
    """Return the pixels on either side of a step that is less than so many pixels deep."""
    beside = np.zeros(case.mask.shape, bool)
    for axis, joined in zip((1, 0), surfaces.joined(case.seen.side), strict=True):
        jump = np.abs(np.diff(case.seen.height, axis=axis)) / case.pixel_size[1 - axis]
        line = ~joined & (jump < below)
        first, second = ((slice(None), part) if axis == 1 else part for part in (np.s_[:-1], np.s_[1:]))
        beside[first] |= line
        beside[second] |= line
    return np.asarray(beside & case.mask)
