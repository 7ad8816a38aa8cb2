"""A ball of known size: what each frame sees of it, and where it lies in the picture."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.rotation.design_matrix import basis, check_phases
from mirrorskin.io import InputError, Source, pixel_axes

Doubles = NDArray[np.float64]


class BallSight(NamedTuple):
    """What n pixels see of a ball in T poses; NaN where they do not see it in contact."""

    contact: NDArray[np.bool_]  # (T, n): whether the sheet lies on the ball there (eq. 1 of the paper)
    z: Doubles  # (T, n): height of the point that is seen above the rest plane, mm
    normal: Doubles  # (T, n, 3): unit normal of the ball there, in the body's frame of that pose


def rotations(lean: ArrayLike) -> Doubles:
    """Return how the body sees the world turned, (T, 3, 3), in poses in which it leans by l, (T, 2), radians.

    In a precession of tilt d at the phase a, l = (d cos a, d sin a). The body's axis is
    ``(-sin|l| l/|l|, cos|l|)``, and a world vector x is seen as ``Rz(a) Ry(|l|) Rz(-a) x``.
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


def see_ball(
    sight: Doubles, centre: ArrayLike, radius: float, lean: ArrayLike, pivot: ArrayLike
) -> BallSight:
    """Return what pixels see of a ball on which the sheet lies.

    ``sight``, (4, n), are their lines of sight: x and y where a line meets the rest plane, mm, and by how
    much it moves along both for each mm of z.

    The ball's centre C of the mean pose (pressed, upright) is at ``pivot + R (C - pivot)`` in a pose that
    sees the world turned by R. A line of sight meets the upper side of the ball there; the sheet touches
    where that point is above the rest plane, z > 0.
    """
    x, y, slope_x, slope_y = sight
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
    return BallSight(contact, z, offset / radius)


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
_CONVERGED = 3e-3  # pixels that do not matter
_ROUND = 1.5  # pixels by which an outline may miss the circle
_STRAY = 3.0  # times the median distance from the rest beyond which a frame's ball is a mistake
_ROUNDS = 8
_BLOCK = 16  # frames that are read at a time


class BallCentres(NamedTuple):
    """A ball's centre in each frame, (T, 3), mm, in the body's frame of that pose; NaN where none is seen."""

    centres: Doubles
    sigma: Doubles  # standard errors, from the outline's own unevenness


def pixel_size_of(source: Source) -> tuple[float, float]:
    """Return the size of a recording's pixels along x and y, mm."""
    if source.header.pixel_size is None:
        raise InputError(f"{source.name}: its pixel size is not known: give it, as in --pixel-size 0.03mm")
    return source.header.pixel_size


def read_turn(source: Source, most: int | None = None) -> tuple[NDArray[Any], Doubles]:
    """Return the frames of an axial recording, (T, H, W), and phases; at most so many, evenly spread."""
    if source.motion != "axial":
        raise InputError(f"{source.name} is of {source.motion} motion: an axial recording is needed")
    if source.rewindable:
        source.rewind()
    total = source.shape[0]
    wanted = np.unique(np.linspace(0, total - 1, min(total, most or total)).round().astype(np.intp))
    frames, phase = np.empty((len(wanted), *source.shape[1:]), source.dtype), np.zeros(len(wanted))
    room, kept = np.empty((min(total, _BLOCK), *source.shape[1:]), source.dtype), 0
    while (block := source.read(room)) is not None:
        if block.phase is None:
            raise InputError(f"{source.name} has no phases: give them, as in --phase-step 45deg")
        for number in range(len(block.frames)):
            if kept < len(wanted) and block.index + number >= wanted[kept]:
                frames[kept], phase[kept] = block.frames[number], block.phase[number]
                kept += 1
    return frames[:kept], phase[:kept]


def find_ball(
    frames: NDArray[Any], phase: ArrayLike, pixel_size: tuple[float, float], radius: float
) -> Doubles:
    """Return the mean centre, (3,), mm, of the one ball that is pressed into the sheet during a turn.

    For a tilt d that is the centre of the mean pose, but for d^2 / 2 times the distance from the pivot.
    """
    alpha = check_phases(phase)
    return np.asarray(smooth_turn(follow_ball(frames, pixel_size, radius).centres, alpha)[0])


def follow_ball(frames: NDArray[Any], pixel_size: tuple[float, float], radius: float) -> BallCentres:
    """Find a ball's centre in each frame, in the body's frame of that pose.

    Where the sheet leaves the ball, and where the ball gets too steep for the wall to be seen, light ends on
    a circle about the ball's centre. So the edges beyond which a picture is darker vote, for each radius of
    the circle, for centres on the bright side (Hough's transform, with the direction of the edge). The best
    circle is fitted to where its edge is, by rays from its centre.

    From a circle of radius a the ball's centre is sqrt(radius^2 - a^2) below the rest plane. Where the light
    ends before the contact does, it is lower than that.
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
    return BallCentres(centres, sigma)


def smooth_turn(values: Doubles, phase: Doubles) -> Doubles:
    """Fit mean, cosine and sine, (3, c), to values, (T, c), over a turn, robustly."""
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


class _Gradients(NamedTuple):
    """Gradients of a downscaled and blurred picture."""

    slope: Doubles  # (2, h, w): along x and y, per mm
    steep: Doubles  # (h, w): their length
    corner: Doubles  # (2,): x and y of the first pixel, mm
    step: Doubles  # (2,): what a column adds to x, and a row to y, mm

    def at(self, values: Doubles, places: Doubles) -> Doubles:
        """Read a map, (h, w), between its pixels at places, (2, ...), mm; 0 beyond its edges."""
        from scipy.ndimage import map_coordinates

        way = (places.T - self.corner).T
        columns, rows = (way.T / self.step).T
        return np.asarray(map_coordinates(values, [rows, columns], order=1, cval=0.0))


def _outline(
    frame: NDArray[Any], pixel_size: tuple[float, float], radius: float
) -> tuple[_Circle, Doubles] | None:
    """Return the circle on which the light of a frame ends, if there is one, and its standard errors."""
    circle = _find_circle(_gradients(*_downscale(frame, pixel_size, _COARSE), _BLUR), radius)
    small = _downscale(frame, pixel_size, _LONGEST)
    fitted = None
    for blur in (_BLUR, _FINE):
        if circle is None:
            return None
        fitted = _fit_circle(_gradients(*small, blur), circle, radius)
        circle = None if fitted is None else fitted[0]
    return fitted


def _downscale(
    frame: NDArray[Any], pixel_size: tuple[float, float], longest: int
) -> tuple[Doubles, Doubles, Doubles]:
    """Average blocks of pixels, and remove single outliers; see `_Gradients` for corner and step."""
    from scipy.ndimage import median_filter

    block = -(-max(frame.shape) // longest)
    rows, columns = (size // block for size in frame.shape)
    values = np.asarray(frame[: rows * block, : columns * block], np.float64)
    known = np.isfinite(values)
    values = np.where(known, values, np.median(values[known]) if known.any() else 0.0)
    small = values.reshape(rows, block, columns, block).mean(axis=(1, 3))
    x, y = pixel_axes((frame.shape[0], frame.shape[1]), pixel_size)
    corner = np.array([x[:block].mean(), y[:block].mean()])
    step = np.array([pixel_size[0], -pixel_size[1]]) * block
    return np.asarray(median_filter(small, 3, mode="nearest")), corner, step


def _gradients(small: Doubles, corner: Doubles, step: Doubles, blur: float) -> _Gradients:
    """Blur a picture, and take its slopes."""
    from scipy.ndimage import gaussian_filter

    orders = zip(((0, 1), (1, 0)), step, strict=True)
    slope = np.stack(
        [gaussian_filter(small, blur, order=order, mode="nearest") / way for order, way in orders]
    )
    return _Gradients(slope, np.hypot(*slope), corner, step)


def _find_circle(picture: _Gradients, radius: float) -> _Circle | None:
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


def _edges(picture: _Gradients) -> tuple[Doubles, Doubles]:
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


def _vote(picture: _Gradients, centres: Doubles, margin: int) -> Doubles:
    """Count the centres, (2, n), near each pixel: one counts less the farther off it is.

    Returned is a map as large as the picture with a margin of so many pixels round it.
    """
    from scipy.ndimage import gaussian_filter

    rows, columns = (size + 2 * margin for size in picture.steep.shape)
    column, row = np.rint(((centres.T - picture.corner) / picture.step).T).astype(np.intp) + margin
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    count = np.bincount((row * columns + column)[inside], minlength=rows * columns)
    near = gaussian_filter(
        count.reshape(rows, columns).astype(np.float64), _BLUR, mode="constant", truncate=2.0
    )
    return np.asarray(near * (2 * np.pi * _BLUR**2))


def _fit_circle(picture: _Gradients, circle: _Circle, radius: float) -> tuple[_Circle, Doubles] | None:
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
        if np.max(np.abs(step)) < _CONVERGED * pixel:
            break
    clear = fall > _FAINT * float(picture.steep.max())
    ends = np.array(circle[:2])[:, np.newaxis] + way * circle.radius
    inside = picture.at(np.ones_like(picture.steep), ends)
    met = clear & (np.abs(away) <= _ROUND * pixel)
    if 2 * np.count_nonzero(met) <= np.count_nonzero(inside):
        return None
    # Rays that pass less than a blur apart are not independent.
    shared = max(1.0, _RAYS * 2 * _BLUR * pixel / (2 * np.pi * circle.radius))
    variance = shared * np.sum((weight * (away - functions @ step)) ** 2) / np.sum(weight**2)
    spread = np.linalg.pinv(weighted.T @ weighted)
    error = np.sqrt(np.maximum(variance, (_CONVERGED * pixel) ** 2) * np.diag(spread))
    return circle, np.asarray(error)


def _light_ends(picture: _Gradients, circle: _Circle, way: Doubles) -> tuple[Doubles, Doubles]:
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
