"""Edges of an object: ``edges.cl`` in plain NumPy with float64.

At a pixel and in eight directions, pairs of positions that are point-symmetric about it are compared.
Contributions that are even about the pixel cancel in their differences. The remainder is a straight line over
the distance: its slope is the curvature of the surface, its value at distance 0 is the jump (least squares).
Three passes search for smaller jumps in more noise: `NEAR` requires two distances to agree and tolerates some
curvature, `FINE` fits lines to three distances, `COARSE` to three distances of means of 3 x 3 pixels. A pass
decides where jumps are clear; the last one searches elsewhere, and not across lines that are drawn already.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Array = NDArray[Any]
Mask = NDArray[np.bool_]

DIRECTIONS = 8  # number of directions, over half a turn
MARGIN = 10  # pixels around the cells, which contain all pairs
CELLS = ("x", "y", "z", "variance", "valid", "free")
"""Planes of the cells: mean normal, mean square sigma, share of valid pixels, 1 where no line is drawn."""


@dataclass(frozen=True, slots=True)
class Pass:
    """Parameters of a pass.

    Attributes
    ----------
    spacing : int
        Distance between positions, and side of a cell, pixels.
    steps : int
        Number of distances of pairs from the pixel; with two, no bend is fitted.
    min_pairs : float
        Minimum number of valid pairs, at each of two distances, otherwise in all.
    reach : int
        Half-width of the non-maximum suppression, pixels.
    guard : int
        Minimum distance from the lines of earlier passes, pixels.
    part : float
        Minimum share of the mean difference that the jump must be; less is a bend.
    """

    spacing: int
    steps: int
    min_pairs: float
    reach: int
    guard: int
    part: float = 0.0


NEAR = Pass(spacing=1, steps=2, min_pairs=1.5, reach=2, guard=0)
FINE = Pass(spacing=1, steps=3, min_pairs=4.5, reach=2, guard=2, part=0.5)
COARSE = Pass(spacing=3, steps=3, min_pairs=5.4, reach=3, guard=5, part=0.6)
PASSES = (NEAR, FINE, COARSE)


@dataclass(frozen=True, slots=True)
class Limits:
    """Criteria of an edge; angles in radians.

    Attributes
    ----------
    jump : float
        Angle to look for.
    bend : float
        Added to `jump` in `NEAR`, which cannot distinguish bends from jumps.
    significance : float
        Minimum size of a jump in standard errors.
    quiet : float
        Standard error of a jump below which no coarser pass is needed.
    floor : float
        Minimum standard error of a jump.
    lowest : float
        Angle below which nothing is an edge.
    """

    jump: float
    bend: float
    significance: float
    quiet: float
    floor: float
    lowest: float


def pairs(chosen: Pass) -> tuple[Array, Array]:
    """Return the positions of the pairs of a pass.

    ``places``, (WAYS, 3, steps, 2), are columns to the right and rows down, for three parallel lines; the
    second position of a pair is the negative. ``distances``, (WAYS, 3, steps), are measured from the pixel
    along the direction; 0 for duplicates.
    """
    angle = np.pi / DIRECTIONS * np.arange(DIRECTIONS)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, np.newaxis, np.newaxis]
    across = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)[:, np.newaxis, np.newaxis]
    away = chosen.spacing * np.arange(chosen.steps) + (chosen.spacing + 1) / 2
    aside = chosen.spacing * np.array([0, -1, 1])
    exact = away[:, np.newaxis] * along + aside[:, np.newaxis, np.newaxis] * across
    places = np.floor(exact + 0.5 + 1e-9).astype(np.int32)
    distances = np.sum(places * along, axis=-1).astype(np.float32)
    for direction in range(DIRECTIONS):
        flat = places[direction].reshape(-1, 2)
        duplicate = [any((position == flat[:k]).all(axis=1)) for k, position in enumerate(flat)]
        distances[direction].reshape(-1)[duplicate] = 0
    return places, distances


def edges_clean(contact: Array) -> Array:
    """Invert the flags, (H, W), that contradict the neighbours of a pixel.

    A pixel out of contact is set to contact if three quarters of its neighbours are in contact: six of eight,
    which fills lines one pixel wide and no corner. One in contact is cleared if all but one of them are out
    of contact.
    """
    touched = np.pad((contact != 0).astype(np.int64), 1)
    inside = np.pad(np.ones(contact.shape, np.int64), 1)
    rows, columns = contact.shape
    around = [np.s_[y : y + rows, x : x + columns] for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    near, neighbours = (np.sum([mask[place] for place in around], axis=0) for mask in (touched, inside))
    stays, fills = (near > 1) | (neighbours < 2), (4 * near >= 3 * neighbours) & (neighbours > 0)
    return np.asarray(np.where(contact != 0, stays, fills), np.uint8)


def edges_cells(vectors: Array, sigma: Array, contact: Array, clean: Array) -> Doubles:
    """Return the cells of one pixel each, (6, H + 2 MARGIN, W + 2 MARGIN), invalid in the margin.

    ``vectors`` are unit normals, or NaN; ``sigma`` is their standard error, radians. A normal is valid only
    if both ``contact`` and ``clean`` are set: a pixel that only ``clean`` adds along a crease has seen both
    sides of it in turn.
    """
    valid = (clean != 0) & (contact != 0) & np.isfinite(vectors).all(axis=-1) & (sigma >= 0)
    valid &= sigma < np.inf
    maps = [*np.moveaxis(vectors.astype(np.float64), -1, 0), sigma.astype(np.float64) ** 2]
    planes = [*(np.where(valid, part, 0.0) for part in maps), valid.astype(np.float64)]
    cells = np.pad(np.stack(planes), ((0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN)))
    return np.concatenate([cells, np.ones((1, *cells.shape[1:]))])


def edges_join(cells: Doubles, edges: Array) -> Doubles:
    """Return cells of 3 x 3 pixels around each pixel, from cells of one pixel and the lines so far."""
    valid, drawn = cells[4], np.pad(edges != 0, MARGIN)
    joined = np.zeros_like(cells)
    rows, columns = (slice(1, size - 1) for size in valid.shape)
    last = valid.shape[0] - 2, valid.shape[1] - 2
    around = [np.s_[y : y + last[0], x : x + last[1]] for y in range(3) for x in range(3)]
    count = np.sum([valid[place] for place in around], axis=0)
    for number in range(4):
        total = np.sum([(valid * cells[number])[place] for place in around], axis=0)
        joined[number, rows, columns] = total / np.maximum(count, 1)
    joined[4, rows, columns] = count / 9
    joined[5, rows, columns] = ~np.any([drawn[place] for place in around], axis=0)
    return joined


def edges_jumps(cells: Doubles, chosen: Pass, limits: Limits, undecided: Array) -> tuple[Doubles, Array]:
    """Return strengths and directions of the jumps of the normal.

    The strength is the largest jump over all directions, in standard errors; 0 where there is no edge.
    Directions are numbered clockwise from x as seen in the picture. ``undecided``, (H, W), is updated in
    place: 1 where all passes so far were too noisy to decide. Pixels already decided get no jump.
    """
    strength, direction = np.zeros(undecided.shape), np.zeros(undecided.shape, np.uint8)
    jump, error = np.zeros((2, *undecided.shape))
    min_error = np.full(undecided.shape, np.inf)
    for number, (places, distances) in enumerate(zip(*pairs(chosen), strict=True)):
        fitted = _fit(cells, chosen, places, distances, limits.floor)
        min_error = np.fmin(min_error, fitted[1])
        contrast = np.where(fitted[2], fitted[0] / fitted[1], 0)
        better = contrast > strength
        strength[better], direction[better] = contrast[better], number
        jump[better], error[better] = fitted[0][better], fitted[1][better]
    unclear = (min_error > limits.quiet) | (chosen is NEAR)
    clear = (chosen is COARSE) | ~unclear
    required = limits.jump + np.where(clear, -1.0, 0.5) * error
    bend = limits.bend if chosen is NEAR else 0.0
    enough = np.maximum(np.maximum(required, limits.lowest), limits.significance * error) + bend
    strength[(jump < enough) | (undecided == 0)] = 0
    undecided &= unclear
    return strength, direction


def _fit(
    cells: Doubles, chosen: Pass, places: Array, distances: Array, floor: float
) -> tuple[Doubles, Doubles, Mask]:
    """Return the jump in one direction, its standard error, and where it is a jump and not a bend."""
    rows, columns = (size - 2 * MARGIN for size in cells.shape[1:])

    def at(right: int, down: int) -> Doubles:
        return cells[:, MARGIN + down : MARGIN + down + rows, MARGIN + right : MARGIN + right + columns]

    sums = np.zeros((10, rows, columns))  # sums of 1, u, u^2, variance, difference, u times difference
    for line, away in zip(places, distances, strict=True):
        open_ = np.ones((rows, columns))
        for step, ((right, down), u) in enumerate(zip(line.tolist(), away.tolist(), strict=True)):
            position, opposite = at(right, down), at(-right, -down)
            if step > 0:
                open_ = open_ * position[5] * opposite[5]
            weight = position[4] * opposite[4] * open_ * (u > 0)
            # With two distances each one is summed separately.
            once, moment = (step == 0, step == 1) if chosen.steps == 2 else (1.0, u)
            difference = position[:3] - opposite[:3]
            parts = [once, moment, moment * u, once * (position[3] + opposite[3])]
            parts += [*(once * difference), *(moment * difference)]
            sums += np.stack([weight * part for part in parts])
    jump, factor, usable, real = (_agreed if chosen.steps == 2 else _straight)(sums, chosen)
    variance = sums[3] / np.where(usable, sums[0], 1.0) / chosen.spacing**2
    error = np.where(usable, np.sqrt(factor * variance + floor**2), np.inf)
    return jump, error, usable & real


def _agreed(sums: Doubles, chosen: Pass) -> tuple[Doubles, Doubles, Mask, Mask]:
    """Return the jump on which differences at two distances agree, its variance as a factor, and flags."""
    usable = (sums[0] >= chosen.min_pairs) & (sums[1] >= chosen.min_pairs)
    near, far = (np.where(usable, part, 1.0) for part in sums[:2])
    first, second = sums[4:7] / near, sums[7:] / far
    longer = np.sqrt(np.maximum(np.sum(first**2, axis=0), np.sum(second**2, axis=0)))
    common = np.sum(first * second, axis=0)
    jump = np.where(usable & (common > 0), common / np.maximum(longer, 1e-15), 0.0)
    return jump, 1 / near, usable, jump > 0


def _straight(sums: Doubles, chosen: Pass) -> tuple[Doubles, Doubles, Mask, Mask]:
    """Return the jump of straight lines, its variance as a factor, and where it is valid and not a bend."""
    n, u1, u2 = sums[:3]
    usable = n >= chosen.min_pairs
    spread = n * u2 - u1 * u1
    usable &= spread > 1e-3 * n * u2
    n, spread = np.where(usable, n, 1.0), np.where(usable, spread, 1.0)
    mean = sums[4:7] / n
    jump = (u2 * sums[4:7] - u1 * sums[7:]) / spread
    square, both = np.sum(jump**2, axis=0), np.sum(jump * mean, axis=0)
    # Next to an edge the line overshoots; where the surface bends the mean is larger.
    real = (2 * both >= square) & (square >= chosen.part**2 * np.sum(mean**2, axis=0))
    return np.sqrt(square), u2 / spread, usable, real


def edges_thin(strength: Doubles, direction: Array, chosen: Pass, edges: Array) -> Array:
    """Add lines, where the strength has a maximum across them, to those drawn so far.

    A pixel is not drawn if a line of an earlier pass is within ``guard`` pixels in the direction of its jump,
    or up to 45 degrees from that: it would duplicate that line.
    """
    added = np.array(edges)
    for row, column in np.argwhere(strength > 0):
        angle = np.pi / DIRECTIONS * direction[row, column]
        cosine, sine = np.cos(angle), np.sin(angle)
        here = strength[row, column]
        for step in range(1, chosen.reach + 1):
            right, down = int(np.floor(step * cosine + 0.5)), int(np.floor(step * sine + 0.5))
            if _value(strength, row + down, column + right) > here:
                here = 0.0
            if _value(strength, row - down, column - right) >= here:
                here = 0.0
        if here > 0 and not _guarded(edges, row, column, cosine, sine, chosen.guard):
            added[row, column] = 1
    return added


def _value(values: Array, row: int, column: int) -> float:
    inside = 0 <= row < values.shape[0] and 0 <= column < values.shape[1]
    return float(values[row, column]) if inside else 0.0


def _guarded(edges: Array, row: int, column: int, cosine: float, sine: float, guard: int) -> bool:
    """Return whether a line is at or next to a pixel."""
    for down in range(-guard, guard + 1):
        for right in range(-guard, guard + 1):
            along = abs(right * cosine + down * sine)
            across = abs(down * cosine - right * sine)
            adjacent = along <= guard + 0.2 and across <= along + 0.1
            if adjacent and _value(edges, row + down, column + right) > 0:
                return True
    return False


def edges_bound(clean: Array, edges: Array) -> Array:
    """Draw the pixels in contact with one of four neighbours out of contact; adjacent lines are removed."""
    touched = np.pad(clean != 0, 1, constant_values=True)
    inner = touched[:-2, 1:-1] & touched[2:, 1:-1] & touched[1:-1, :-2] & touched[1:-1, 2:]
    # The border of the picture is not an edge: everything beyond it is treated as in contact.
    bound = (clean != 0) & ~inner
    around = np.pad(bound, 1)
    rows, columns = clean.shape
    near = np.any([around[y : y + rows, x : x + columns] for y in range(3) for x in range(3)], axis=0)
    return np.asarray(bound | ((edges != 0) & (clean != 0) & ~near), np.uint8)
