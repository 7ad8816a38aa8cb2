"""A ball of known size: what each frame sees of it, and where it lies in the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from mirrorskin.engine.rotation.design_matrix import basis, check_phases
from mirrorskin.io import InputError, pixel_axes

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
    """Return how the body sees the world turned, (T, 3, 3), in poses in which it leans."""
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


_COARSE, _LONGEST = 128, 256  # pixels along a side to which pictures are made small, to search and to measure
_BLUR = 1.5  # pixels, standard deviation, under which edges are looked for
_FINE = 0.7  # pixels, under which they are measured: of a disc that brightens outwards they seem further out
_CLEAR = 6.0  # times the median slope of the picture that an edge must have
_FAINT = 0.1  # of the picture's steepest slope that an edge must have
_LEAST = 2.5  # pixels, the radius of the smallest outline
_SHARE = 0.25  # of an outline that must be seen
_NEAR = 4  # pixels about an outline within which its edge is
_OUTSIDE = 0.5  # radii of the ball by which its centre may lie outside of the picture
_RAYS = 90
_SHARP = 0.5  # pixels by which the places of an edge differ at least
_SETTLED = 3e-3  # pixels that do not matter
_ROUND = 1.5  # pixels by which an outline may miss the circle
_STRAY = 3.0  # times the median distance from the rest beyond which a frame's ball is a mistake
_ROUNDS = 8


class Found(NamedTuple):
    """A ball's place in the mean pose."""

    x: float  # Of its centre, millimetres from the picture's centre
    y: float  # Of its centre, millimetres from the picture's centre
    depth: float  # By how much its top stands above the rest plane, mm


class Followed(NamedTuple):
    """A ball's place in each frame; NaN where none is seen.

    Attributes
    ----------
    centres, sigma : ndarray, (T, 3), float64
        Of its centre in the body's frame of that pose, and their standard errors as the outline's own
        unevenness has them; millimetres from the picture's centre and the rest plane.
    """

    centres: Doubles
    sigma: Doubles

    def with_sigma(self, sigma: float) -> Followed:
        """Return the same with one standard error."""
        return self._replace(sigma=np.full_like(self.sigma, sigma))


def find_ball(
    frames: NDArray[Any], phase: ArrayLike, pixel_size: tuple[float, float], radius: float
) -> Found:
    """Find the one ball that is pressed into the sheet during a turn; see `follow_ball`."""
    alpha = check_phases(phase)
    centres = follow_ball(frames, pixel_size, radius).centres
    x, y, z = smooth_turn(centres, alpha)[0]
    return Found(float(x), float(y), float(z) + radius)


def follow_ball(frames: NDArray[Any], pixel_size: tuple[float, float], radius: float) -> Followed:
    """Find a ball's centre in each frame, in the body's frame of that pose.

    Where the sheet leaves the ball, and where the ball gets too steep for the wall to be seen, light ends on
    a circle about the ball's centre. So the edges beyond which a picture is darker vote, for each radius of
    the circle, for centres on the bright side (Hough's transform, with the direction of the edge). The best
    circle is fitted to where its edge is, by rays from its centre.

    From a circle of radius a the ball's centre is sqrt(radius^2 - a^2) below the rest plane. Where the light
    ends before the contact does, it is lower than told.
    """
    centres, sigma = np.full((2, len(frames), 3), np.nan)
    for number, frame in enumerate(frames):
        fitted = _outline(frame, pixel_size, radius)
        if fitted is not None:
            (x, y, outline), error = fitted
            below = math.sqrt(max(radius**2 - outline**2, 0.01 * radius**2))
            centres[number] = x, y, -math.sqrt(max(0.0, radius**2 - outline**2))
            sigma[number] = error * (1, 1, outline / below)
    seen = int(np.isfinite(centres[:, 0]).sum())
    if 2 * seen <= len(frames):
        raise InputError(
            f"a ball of {2 * radius:g} mm is seen in {seen} of {len(frames)} frames: check its diameter and"
            " the pixel size, and press it until a ring of light shows in all frames"
        )
    return Followed(centres, sigma)


def smooth_turn(values: Doubles, phase: Doubles) -> Doubles:
    """Fit mean, cosine and sine over a turn, whatever a few values say that are wrong."""
    known = np.isfinite(values).all(axis=1)
    functions, values = basis(phase[known]), values[known]
    weight = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, np.newaxis]
        wave = np.linalg.lstsq(functions * root, values * root, rcond=None)[0]
        away = np.sqrt(np.sum((values - functions @ wave) ** 2, axis=1))
        usual = _STRAY * float(np.median(away)) + 1e-9
        weight = 1 / (1 + (away / usual) ** 2) ** 2
    return np.asarray(wave)


class _Circle(NamedTuple):
    """Millimetres from the picture's centre."""

    x: float
    y: float
    radius: float


class _Picture(NamedTuple):
    """How the brightness of a picture that was made small and blurred changes."""

    slope: Doubles  # (2, h, w): Along x and y, a millimetre
    steep: Doubles  # (h, w): Their length
    corner: Doubles  # (2,): x and y of the first pixel, mm
    step: Doubles  # (2,): What a column adds to x, and a row to y, mm

    def at(self, values: Doubles, places: Doubles) -> Doubles:
        """Read a map, (h, w), between its pixels at places, (2, ...), mm; 0 beyond its edges."""
        way = (places.T - self.corner).T
        columns, rows = (way.T / self.step).T
        return np.asarray(ndimage.map_coordinates(values, [rows, columns], order=1, cval=0.0))


def _outline(
    frame: NDArray[Any], pixel_size: tuple[float, float], radius: float
) -> tuple[_Circle, Doubles] | None:
    """Return the circle on which the light of a frame ends, if there is one, and its standard errors."""
    circle = _find_circle(_slopes(*_made_small(frame, pixel_size, _COARSE), _BLUR), radius)
    small = _made_small(frame, pixel_size, _LONGEST)
    fitted = None
    for blur in (_BLUR, _FINE):
        if circle is None:
            return None
        fitted = _fit_circle(_slopes(*small, blur), circle, radius)
        circle = None if fitted is None else fitted[0]
    return fitted


def _made_small(
    frame: NDArray[Any], pixel_size: tuple[float, float], longest: int
) -> tuple[Doubles, Doubles, Doubles]:
    """Average blocks of pixels, and take out what stands alone; see `_Picture` for corner and step."""
    block = -(-max(frame.shape) // longest)
    rows, columns = (size // block for size in frame.shape)
    values = np.asarray(frame[: rows * block, : columns * block], np.float64)
    known = np.isfinite(values)
    values = np.where(known, values, np.median(values[known]) if known.any() else 0.0)
    small = values.reshape(rows, block, columns, block).mean(axis=(1, 3))
    x, y = pixel_axes((frame.shape[0], frame.shape[1]), pixel_size)
    corner = np.array([x[:block].mean(), y[:block].mean()])
    step = np.array([pixel_size[0], -pixel_size[1]]) * block
    return np.asarray(ndimage.median_filter(small, 3, mode="nearest")), corner, step


def _slopes(small: Doubles, corner: Doubles, step: Doubles, blur: float) -> _Picture:
    """Blur a picture, and take its slopes."""
    orders = zip(((0, 1), (1, 0)), step, strict=True)
    slope = np.stack(
        [ndimage.gaussian_filter(small, blur, order=order, mode="nearest") / way for order, way in orders]
    )
    return _Picture(slope, np.hypot(*slope), corner, step)


def _find_circle(picture: _Picture, radius: float) -> _Circle | None:
    """Return the circle on which most of the outline of something bright lies, if there is one."""
    places, inwards = _edges(picture)
    pixel = float(np.max(np.abs(picture.step)))
    best, votes = None, 0.0
    margin = round(_OUTSIDE * radius / pixel)
    least = min(_LEAST * pixel, radius)
    for outline in np.linspace(least, radius, 1 + math.ceil((radius - least) / (_BLUR * pixel))):
        count = _vote(picture, places + outline * inwards, margin)
        row, column = np.unravel_index(np.argmax(count), count.shape)
        share = count[row, column] * pixel / (2 * np.pi * outline)
        if share >= _SHARE and count[row, column] > votes:
            votes = float(count[row, column])
            x, y = picture.corner + picture.step * (column - margin, row - margin)
            best = _Circle(float(x), float(y), float(outline))
    return best


def _edges(picture: _Picture) -> tuple[Doubles, Doubles]:
    """Return where the picture is steepest along its own slope, and the ways uphill, (2, n) each."""
    steep = picture.steep
    clear = steep > max(_CLEAR * float(np.median(steep)), _FAINT * float(steep.max()), 1e-12)
    rows, columns = np.nonzero(clear)
    places = (picture.corner + picture.step * np.stack([columns, rows], axis=1)).T
    here = steep[rows, columns]
    uphill = picture.slope[:, rows, columns] / here
    pixel = float(np.max(np.abs(picture.step)))
    before, behind = (picture.at(steep, places + way * pixel * uphill) for way in (-1, 1))
    ridge = (here >= before) & (here >= behind)
    return places[:, ridge], uphill[:, ridge]


def _vote(picture: _Picture, centres: Doubles, margin: int) -> Doubles:
    """Count the centres, (2, n), near each pixel: one counts less the farther off it is.

    Returned is a map as large as the picture with a margin of so many pixels round it.
    """
    rows, columns = (size + 2 * margin for size in picture.steep.shape)
    column, row = np.rint(((centres.T - picture.corner) / picture.step).T).astype(np.intp) + margin
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    count = np.bincount((row * columns + column)[inside], minlength=rows * columns)
    near = ndimage.gaussian_filter(
        count.reshape(rows, columns).astype(np.float64), _BLUR, mode="constant", truncate=2.0
    )
    return np.asarray(near * (2 * np.pi * _BLUR**2))


def _fit_circle(picture: _Picture, circle: _Circle, radius: float) -> tuple[_Circle, Doubles] | None:
    """Bring a circle to where the light ends on rays from its centre; None if it ends elsewhere on most.

    Also returned are the standard errors of its numbers.
    """
    pixel = float(np.max(np.abs(picture.step)))
    turn = np.arange(_RAYS) * 2 * np.pi / _RAYS
    way = np.stack([np.cos(turn), np.sin(turn)])
    functions = np.stack([*way, np.ones(_RAYS)], axis=1)
    for _ in range(_ROUNDS):
        away, fall = _light_ends(picture, circle, way)
        if not (fall > 0).any():
            return None
        # A centre that is off by (x, y) sees the edge at away = x cos + y sin + what the radius lacks.
        usual = max(float(np.median(np.abs(away[fall > 0]))), _SHARP * pixel)
        weight = np.sqrt(np.maximum(fall / fall.max(), 0)) / (1 + (away / (2 * usual)) ** 2)
        weighted = functions * weight[:, np.newaxis]
        step = np.linalg.lstsq(weighted, away * weight, rcond=None)[0]
        x, y, outline = np.array(circle) + step
        circle = _Circle(float(x), float(y), min(max(float(outline), pixel), radius))
        if np.max(np.abs(step)) < _SETTLED * pixel:
            break
    clear = fall > _FAINT * float(picture.steep.max())
    ends = np.array(circle[:2])[:, np.newaxis] + way * circle.radius
    inside = picture.at(np.ones_like(picture.steep), ends)
    met = clear & (np.abs(away) <= _ROUND * pixel)
    if 2 * np.count_nonzero(met) <= np.count_nonzero(inside):
        return None
    # Rays that pass less than a blur apart tell the same.
    shared = max(1.0, _RAYS * 2 * _BLUR * pixel / (2 * np.pi * circle.radius))
    variance = shared * np.sum((weight * (away - functions @ step)) ** 2) / np.sum(weight**2)
    spread = np.linalg.pinv(weighted.T @ weighted)
    error = np.sqrt(np.maximum(variance, (_SETTLED * pixel) ** 2) * np.diag(spread))
    return circle, np.asarray(error)


def _light_ends(picture: _Picture, circle: _Circle, way: Doubles) -> tuple[Doubles, Doubles]:
    """Return by how much the light ends beyond a circle along some ways, mm, and how steeply it does."""
    pixel = float(np.max(np.abs(picture.step)))
    reach = np.arange(-_NEAR, _NEAR + 0.25, 0.5) * pixel
    middle = np.array(circle[:2])[:, np.newaxis, np.newaxis]
    places = middle + way[:, :, np.newaxis] * np.maximum(circle.radius + reach, 0)
    across, up = (picture.at(slope, places) for slope in picture.slope)
    fall = -(way[0, :, np.newaxis] * across + way[1, :, np.newaxis] * up)
    peak = np.clip(np.argmax(fall, axis=1), 1, len(reach) - 2)
    before, most, behind = (fall[np.arange(len(peak)), peak + step] for step in (-1, 0, 1))
    # The top of the parabola through three values.
    curvature = np.minimum(before - 2 * most + behind, -1e-300)
    beyond = np.clip((before - behind) / (2 * curvature), -1, 1)
    return reach[peak] + beyond * 0.5 * pixel, most
