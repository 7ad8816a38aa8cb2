"""Displacement of the skin by friction: ``skin.cl`` in plain NumPy with float64.

In the frame of the object that it touches, the traction displaces the skin's surface by a map u. While the
object moves by U relative to the body, a point of it is ahead of the skin by U - u: the skin there was at
this position plus U - u at the press. A position is (x, y) for a movement along the skin, mm, or (angle,) for
a twist about the origin, radians. U is then proportional to the angle, and U - u is treated as an arc about
the origin and a radial distance; this is exact where all sticks and where nothing does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

ROUNDS = 200  # maximum number of fixed-point iterations; each reduces the error by the surface's strain
CLOSE = 1e-4  # tolerance of a point of the skin, pixels
FLAKES = 512  # period of the coefficients of flakes along each axis


def skin_displacement(
    shift: NDArray[Any],
    displacement: NDArray[Any],
    place_x: float,
    place_y: float,
    along_x: float,
    along_y: float,
    twist: int = 0,
) -> None:
    """Write the displacement of the skin that was at the pixels at the press.

    Parameters
    ----------
    shift : (2, R, C), u along x and y (up), mm; extrapolated by its border values
    displacement : (2, H, W), mm; the initial value, replaced by the result: NaN where the skin would fold
    place_x, place_y : position of the body, mm; for a twist the angle, radians, and an ignored number
    along_x, along_y : pixel size of both maps, which have the same centre, mm
    twist : 1 for a twist
    """
    rows, columns = displacement.shape[1:]
    rest = _rest(rows, columns, along_x, along_y)
    place = np.array([place_x] if twist else [place_x, place_y])
    reached = rest + np.nan_to_num(displacement)
    open_ = np.ones((rows, columns), bool)
    for _ in range(ROUNDS):
        missing = rest[:, open_] - material(shift, (along_x, along_y), place, reached[:, open_])
        reached[:, open_] += missing
        open_[open_] = np.hypot(*missing) > CLOSE * min(along_x, along_y)
        if not open_.any():
            break
    reached[:, open_] = np.nan
    displacement[...] = reached - rest


def skin_flakes(
    shift: NDArray[Any],
    visible: NDArray[Any],
    flakes: NDArray[np.uint8],
    cell_x: NDArray[np.int32],
    cell_y: NDArray[np.int32],
    part_x: NDArray[Any],
    part_y: NDArray[Any],
    place_x: float,
    place_y: float,
    along_x: float,
    along_y: float,
    spacing: float,
    twist: int = 0,
) -> Doubles:
    """Return the share of flakes on the skin seen by each pixel, (H, W): a cubic B-spline, 0 to 1.

    Parameters
    ----------
    shift, place_x, place_y, along_x, along_y, twist : see `skin_displacement`
    visible : (2, H, W), offset along x and y from a pixel to the point that it sees, mm
    flakes : (`FLAKES`, `FLAKES`), coefficients by x and y, 0 or 1, periodic
    cell_x, cell_y, part_x, part_y : (W,) and (H,), position among the coefficients of the skin that was at
        each pixel at the press: integer part, and remainder
    spacing : distance of coefficients, mm
    """
    from scipy.ndimage import map_coordinates

    rest = _rest(visible.shape[1], visible.shape[2], along_x, along_y)
    place = np.array([place_x] if twist else [place_x, place_y])
    dragged = material(shift, (along_x, along_y), place, rest + visible) - rest
    cells = np.stack(np.meshgrid(cell_x + part_x.astype(float), cell_y + part_y.astype(float)))
    fraction: Doubles = map_coordinates(
        flakes.astype(float), cells + dragged / spacing, order=3, mode="grid-wrap", prefilter=False
    )
    return fraction


def _rest(rows: int, columns: int, along_x: float, along_y: float) -> Doubles:
    """Return x and y of pixels, (2, H, W), mm."""
    x = (np.arange(columns) - (columns - 1) / 2) * along_x
    y = ((rows - 1) / 2 - np.arange(rows)) * along_y
    return np.stack(np.meshgrid(x, y))


def material(
    shift: NDArray[Any], pixel_size: tuple[float, float], place: Doubles, points: Doubles
) -> Doubles:
    """Return the positions at the press of the skin that is now at points, (2, ...), mm along x and y."""
    from scipy.ndimage import map_coordinates

    at = on_object(place, points)
    rows, columns = shift.shape[1:]
    index = np.stack([(rows - 1) / 2 - at[1] / pixel_size[1], at[0] / pixel_size[0] + (columns - 1) / 2])
    shifted = [map_coordinates(part, index, order=1, mode="nearest") for part in shift]
    return _behind(place, at, drive(place, at) - np.stack(shifted))


def drive(place: Doubles, at: Doubles) -> Doubles:
    """Return U at points of the object, (2, ...), mm, in the linear theory of small angles."""
    if len(place) == 1:
        return np.stack([place[0] * at[1], -place[0] * at[0]])
    return np.broadcast_to(-place.reshape(2, *[1] * (at.ndim - 1)), at.shape)


def on_object(place: Doubles, points: Doubles) -> Doubles:
    """Return the points of the object, by their positions at the press, that are now at points, (2, ...)."""
    if len(place) == 1:
        return _as_plane((points[0] + 1j * points[1]) * np.exp(1j * place[0]))
    return points + place.reshape(2, *[1] * (points.ndim - 1))


def _behind(place: Doubles, at: Doubles, lag: Doubles) -> Doubles:
    """Return the positions at the press of the skin, for points of the object that are ahead by a lag."""
    if len(place) != 1:
        return at + lag
    point, ahead = at[0] + 1j * at[1], lag[0] + 1j * lag[1]
    fraction = np.divide(ahead, point, out=np.zeros_like(point), where=point != 0)
    return _as_plane(np.where(point != 0, point * (1 + fraction.real) * np.exp(1j * fraction.imag), ahead))


def _as_plane(number: NDArray[np.complex128]) -> Doubles:
    return np.stack([number.real, number.imag])
