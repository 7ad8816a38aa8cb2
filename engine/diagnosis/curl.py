"""Rotation of all slopes about the axis of the camera, from their curl.

The slopes of a surface z are free of curl. Slopes that are rotated by the angle psi have the curl
sin(psi) laplace(z) and the divergence cos(psi) laplace(z), so the tangent of psi is the regression of the one
on the other: a wrong phase of the first frame. If psi changes from row to row, rows are exposed one after the
other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import AnyArray
from mirrorskin.engine.base.frames import take_places
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import fit_clipped

_EXTENT_PER_HALF_SIDE = 40  # extent of the normals over half a side of the largest loop
_HALF_SIDES, _MIN_LARGEST = (1, 2, 4, 8, 16), 3  # pixels: half sides of smaller loops; least of the largest
_MOST_NOISE = 0.02  # of divergences, share of their variance, that changes an angle by as much
_GRID_LINES = 48  # lines of loops along a side
_MIN_LOOPS = 200  # loops
_EXPLAINED = np.array([0.2, 0.5])  # least share of the curl that an angle explains, and one that changes
_CLEAR_Z_SCORE = 8.0  # standard errors from which on a rotation is reported
_MIN_ANGLE = math.radians(1.5)  # least rotation that is reported


@dataclass(frozen=True, slots=True)
class AzimuthBias:
    """Angle by which slopes are rotated, radians: ``first`` in the first row, ``last`` in the last."""

    first: float
    last: float
    sigma: float

    def remove(self, normals: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return normals, (H, W, 3), without the error."""
        angle = -np.linspace(self.first, self.last, len(normals))[:, np.newaxis]
        cosine, sine = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
        x, y, z = np.moveaxis(normals, -1, 0)
        return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)


def find_azimuth_bias(
    normals: AnyArray, contact: NDArray[Any], pixel_size: tuple[float, float]
) -> AzimuthBias | None:
    """Return the rotation of the slopes of normals, (H, W, 3), in contact; None if it is not significant."""
    extent = math.isqrt(int(np.count_nonzero(contact)))
    largest = max(_MIN_LARGEST, extent // _EXTENT_PER_HALF_SIDE)
    # Fine relief changes inside of large loops, and noise hides the curl of small ones.
    for half in (*(side for side in _HALF_SIDES if side < largest), largest):
        found = _of_loops(normals, contact, pixel_size, half, max(1, extent // _GRID_LINES))
        if found is None or found.is_precise:
            break
    return None if found is None else found.bias


@dataclass(frozen=True, slots=True)
class _Regression:
    """Rotation by loops of one size, None if it is not significant, and whether this is certain."""

    bias: AzimuthBias | None
    is_precise: bool


def _of_loops(
    normals: AnyArray, contact: NDArray[Any], pixel_size: tuple[float, float], half: int, thin: int
) -> _Regression | None:
    """Return the rotation by loops around every n-th pixel, of some half side; None if there are too few."""
    rows, columns = contact.shape
    if min(rows, columns) <= 2 * half:
        return None
    down, right = range(half, rows - half, thin), range(half, columns - half, thin)
    ends = -half, 0, half
    places = [(row, column) for row in ends for column in ends if row or column]
    (vectors,), (touched,) = (take_places([values], down, right, places) for values in (normals, contact))
    slopes = []
    for vector, touches in zip(vectors, touched, strict=True):
        x, y, z = vector.astype(np.float64)
        z = np.where(touches > 0, z, np.nan)
        slopes.append((-x / z, -y / z))
    p, q = (dict(zip(places, values, strict=True)) for values in zip(*slopes, strict=True))

    def side(part: dict[tuple[int, int], Doubles], row: int, column: int) -> Doubles:
        """Return the mean along a side by Simpson's rule, which a curved slope changes as across it."""
        first, last = ((row, end) if row else (end, column) for end in (-half, half))
        return (part[first] + 4 * part[row, column] + part[last]) / 6

    (p_up, q_up), (p_down, q_down), (p_right, q_right), (p_left, q_left) = (
        (side(p, *place), side(q, *place)) for place in ((-half, 0), (half, 0), (0, half), (0, -half))
    )
    across, upwards = 1 / pixel_size[0], 1 / pixel_size[1]
    curl = (q_right - q_left) * across - (p_up - p_down) * upwards
    divergence = (p_right - p_left) * across + (q_up - q_down) * upwards
    place = np.broadcast_to((1 - 2 * np.array(down) / (rows - 1))[:, np.newaxis], curl.shape)
    finite = np.isfinite(curl) & np.isfinite(divergence)
    if np.count_nonzero(finite) < _MIN_LOOPS:
        return None
    overlap = max(1.0, (2 * half / thin) ** 2 / 12)  # of loops, whose errors are then correlated
    return _regression(curl[finite], divergence[finite], place[finite], overlap)


def _regression(curl: Doubles, divergence: Doubles, place: Doubles, overlap: float) -> _Regression | None:
    """Fit a rotation that may change with the place of the row, 1 for the first and -1 for the last."""
    columns = np.stack([divergence, divergence * place], axis=1)
    result = fit_clipped(columns, curl, condition=1e9)
    if result is None:
        return None
    fit, inverse, residual, kept = result
    spread = np.sqrt(np.diag(inverse) * float(np.mean(residual[kept] ** 2)) * overlap)
    explained = 1 - float(np.var(residual[kept])) / max(float(np.var(curl[kept])), 1e-30)
    clear = (
        (np.abs(fit) > _CLEAR_Z_SCORE * spread)
        & (np.abs(fit) > math.tan(_MIN_ANGLE))
        & (explained > _EXPLAINED)
    )
    noise = float(np.var(residual[kept])) / max(float(np.var(divergence[kept])), 1e-30)
    is_precise = bool(_CLEAR_Z_SCORE * spread[0] < math.tan(_MIN_ANGLE)) and noise < _MOST_NOISE
    if not clear.any():
        return _Regression(None, is_precise and bool((np.abs(fit) < math.tan(_MIN_ANGLE)).all()))
    middle, change = fit[0], fit[1] if clear[1] else 0.0
    first, last = math.atan(middle + change), math.atan(middle - change)
    sigma = float(np.hypot(spread[0], spread[1] if clear[1] else 0.0))
    return _Regression(AzimuthBias(first, last, sigma), is_precise)
