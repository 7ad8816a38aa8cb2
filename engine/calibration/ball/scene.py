"""The rigid ball that is pressed into the sheet for a calibration: what each frame sees of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import pixel_axes

Doubles = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BallView:
    """The lines of sight of some pixels: each sees all points ``(x + z vx, y + z vy, z)``.

    Attributes
    ----------
    place : ndarray, (4, n), float64
        x and y where a line meets the rest plane, mm; vx and vy, by how much it moves for each mm of z.
    """

    place: Doubles

    @classmethod
    def straight(cls, x: ArrayLike, y: ArrayLike) -> BallView:
        """Look straight down at places, (n,), mm."""
        across, up = np.broadcast_arrays(np.asarray(x, np.float64).ravel(), np.asarray(y, np.float64).ravel())
        return cls(np.stack([across, up, np.zeros_like(across), np.zeros_like(across)]))

    @classmethod
    def of_picture(cls, shape: tuple[int, int], pixel_size: tuple[float, float]) -> BallView:
        """Look straight down at every pixel of a picture, row by row."""
        return cls.straight(*np.meshgrid(*pixel_axes(shape, pixel_size)))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What some pixels see of a ball in T poses; NaN where they do not see it in contact.

    Attributes
    ----------
    contact : ndarray, (T, n), bool
        Whether the sheet lies on the ball there, if it takes the ball's shape (eq. 1 of the paper).
    z : ndarray, (T, n), float64
        Height of the point that is seen above the rest plane, mm.
    normal : ndarray, (T, n, 3), float64
        Unit normal of the ball there, in the body's frame of that pose.
    """

    contact: NDArray[np.bool_]
    z: Doubles
    normal: Doubles


def rotations(lean: ArrayLike) -> Doubles:
    """Return how the body sees the world turned, (T, 3, 3), in poses in which it leans.

    Parameters
    ----------
    lean : array_like, (T, 2)
        Radians: the vector l, for a precession of tilt d at the phase a (d cos a, d sin a). The body's axis
        is ``(-sin|l| l/|l|, cos|l|)``, and a world vector x is seen as ``Rz(a) Ry(|l|) Rz(-a) x``.
    """
    lean = np.asarray(lean, np.float64)
    angle = np.sqrt(np.sum(lean**2, axis=1))
    cross = np.zeros((len(lean), 3, 3))
    cross[:, :2, 2], cross[:, 2, :2] = lean, -lean
    # Rodrigues' formula; np.sinc is sin(pi x) / (pi x), so that no angle need be divided by.
    once, twice = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    turned = once[:, np.newaxis, np.newaxis] * cross + twice[:, np.newaxis, np.newaxis] * (cross @ cross)
    return np.asarray(np.eye(3) + turned)


def moved(point: ArrayLike, lean: ArrayLike, pivot: ArrayLike) -> Doubles:
    """Return where a point of the mean pose, (3,), mm, is found in each pose, (T, 3), mm."""
    arm = np.asarray(point, np.float64) - np.asarray(pivot, np.float64)
    return np.asarray(np.asarray(pivot, np.float64) + rotations(lean) @ arm)


def ball_view(pixels: BallView, centre: ArrayLike, radius: float, lean: ArrayLike, pivot: ArrayLike) -> Seen:
    """Tell what pixels see of a ball on which the sheet lies.

    The ball's centre C of the mean pose (pressed, upright) is at ``pivot + R (C - pivot)`` in a pose that
    sees the world turned by R. A line of sight meets the upper side of the ball there; the sheet touches
    where that point is above the rest plane, z > 0.

    Parameters
    ----------
    pixels : BallView
        Of n pixels.
    centre : array_like, (3,)
        Of the ball in the mean pose, in the body's frame, mm: at z = depth - radius if its top is pressed so
        deep into the rest plane.
    radius : float
        Of the ball, mm.
    lean : array_like, (T, 2)
        See `rotations`.
    pivot : array_like, (3,)
        That the body turns about, mm, in the body's frame.

    Returns
    -------
    Seen
    """
    x, y, slope_x, slope_y = pixels.place
    middle = moved(centre, lean, pivot)
    start_x, start_y = x - middle[:, :1], y - middle[:, 1:2]
    start_z = -middle[:, 2:]
    # |start + z way|^2 = radius^2 with way = (vx, vy, 1); the greater root is the upper side.
    square = slope_x**2 + slope_y**2 + 1
    linear = start_x * slope_x + start_y * slope_y + start_z
    room = linear**2 - square * (start_x**2 + start_y**2 + start_z**2 - radius**2)
    z = (np.sqrt(np.where(room >= 0, room, np.nan)) - linear) / square
    with np.errstate(invalid="ignore"):
        contact = (z > 0) & (z > middle[:, 2:])
    z = np.where(contact, z, np.nan)
    offset = np.stack([start_x + z * slope_x, start_y + z * slope_y, start_z + z], axis=-1)
    return Seen(contact, z, offset / radius)
