"""A ball of known size: its image at each pixel, and its position in a picture."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.correlation.design_matrix import basis, check_phases
from mirrorskin.io import InputError, pixel_axes
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import geman_mcclure


class BallSight(NamedTuple):
    """The points of a ball that n pixels see in T poses; NaN where they do not see it in contact."""

    contact: NDArray[np.bool_]  # (T, n): whether the sheet touches the ball there (paper, eq. 1)
    z: Doubles  # (T, n): height of the visible point above the rest plane, mm
    normal: Doubles  # (T, n, 3): unit normal of the ball there, in the body's frame of that pose


def rotations(lean: ArrayLike) -> Doubles:
    """Return the rotations from the world to the body's frame, (T, 3, 3), for leans l, (T, 2), radians.

    In a precession of tilt d at the phase a, l = (d cos a, d sin a). The body's axis is
    ``(-sin|l| l/|l|, cos|l|)``, and a world vector x becomes ``Rz(a) Ry(|l|) Rz(-a) x``.
    """
    lean = np.asarray(lean, np.float64)
    angle = np.sqrt(np.sum(lean**2, axis=1))
    cross = np.zeros((len(lean), 3, 3))
    cross[:, :2, 2], cross[:, 2, :2] = lean, -lean
    # Rodrigues' formula. np.sinc(x) is sin(pi x) / (pi x), also at 0.
    once, twice = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    turned = once[:, np.newaxis, np.newaxis] * cross + twice[:, np.newaxis, np.newaxis] * (cross @ cross)
    return np.asarray(np.eye(3) + turned)


def moved(point: ArrayLike, lean: ArrayLike, pivot: ArrayLike) -> Doubles:
    """Return the position of a point of the mean pose, (3,), mm, in each pose, (T, 3), mm."""
    pivot = np.asarray(pivot, np.float64)
    return np.asarray(pivot + rotations(lean) @ (np.asarray(point, np.float64) - pivot))


def see_ball(
    sight: Doubles, centre: ArrayLike, radius: float, lean: ArrayLike, pivot: ArrayLike
) -> BallSight:
    """Return what pixels see of a ball that is pressed into the sheet.

    The ball's centre C in the mean pose (pressed, upright) is at ``pivot + R (C - pivot)`` in a pose with the
    rotation R. A line of sight meets the ball's upper side; the sheet touches the ball where that point is
    above the rest plane, z > 0. ``sight`` are the lines of sight, (4, n): x and y on the rest plane, mm, and
    their displacement along x and y per mm of z.
    """
    x, y, slope_x, slope_y = sight
    middle = moved(centre, lean, pivot)
    start_x, start_y = x - middle[:, :1], y - middle[:, 1:2]
    start_z = -middle[:, 2:]
    # |start + z v|^2 = radius^2 with v = (slope_x, slope_y, 1); the greater root is the upper side.
    square = slope_x**2 + slope_y**2 + 1
    linear = start_x * slope_x + start_y * slope_y + start_z
    discriminant = linear**2 - square * (start_x**2 + start_y**2 + start_z**2 - radius**2)
    z = (np.sqrt(np.where(discriminant >= 0, discriminant, np.nan)) - linear) / square
    with np.errstate(invalid="ignore"):
        contact = (z > 0) & (z > middle[:, 2:])
    z = np.where(contact, z, np.nan)
    offset = np.stack([start_x + z * slope_x, start_y + z * slope_y, start_z + z], axis=-1)
    return BallSight(contact, z, offset / radius)


# --- the outline of the light -------------------------------------------------------------------------------

_SEARCH_SIZE = 128  # pixels: longer side of a downscaled picture for the search
_FIT_SIZE = 256  # the same for the fit
_SEARCH_BLUR = 1.5  # pixels, standard deviation: blur of the search for edges
_FIT_BLUR = 0.7  # pixels: blur of the last fit; more would shift the edge of a disc that brightens outwards
_MIN_EDGE_CONTRAST = 6.0  # minimum slope of an edge, times the median slope of the picture
_MIN_EDGE_SLOPE = 0.1  # minimum slope of an edge, as a share of the maximum slope of the picture
_MIN_RADIUS = 2.5  # pixels: minimum radius of an outline
_MIN_VISIBLE = 0.25  # minimum share of an outline that is visible
_NEAR = 4  # pixels: distance from the outline within which its edge is searched for
_OUTSIDE = 0.5  # maximum distance of a ball's centre from the picture, in radii of the ball
_RAYS = 90  # number of rays from the centre along which the edge is located
_SHARP = 0.5  # pixels: minimum scatter of the edge's distances, for weights
_CONVERGED = 3e-3  # pixels: size of the last step of a fit
_ROUND = 1.5  # pixels: maximum distance of the edge from the fitted circle
_STRAY, _OFF = 3.0, 2.0  # times the median residual: scale of the robust weights of frames, and of an edge
_FIT_ITERATIONS = 8  # iterations of a fit


class BallCentres(NamedTuple):
    """A ball's centre in each frame, in the body's frame of that pose; NaN where no ball is visible."""

    centres: Doubles  # (T, 3): mm
    sigma: Doubles  # (T, 3): standard errors from the scatter of the outline's edge, mm


def find_ball(
    frames: NDArray[Any], phase: ArrayLike, pixel_size: tuple[float, float], radius: float
) -> Doubles:
    """Return the mean centre, (3,), mm, of the ball that is pressed into the sheet during a rotation.

    For a tilt d it differs from the centre in the mean pose by d^2 / 2 times the distance from the pivot.
    """
    alpha = check_phases(phase)
    return np.asarray(smooth_turn(follow_ball(frames, pixel_size, radius).centres, alpha)[0])


def follow_ball(frames: NDArray[Any], pixel_size: tuple[float, float], radius: float) -> BallCentres:
    """Find a ball's centre in each frame, in the body's frame of that pose.

    Light ends on a circle about the ball's centre, where the sheet leaves the ball, or where the ball becomes
    too steep to reflect the wall. A Hough transform that uses the directions of edges finds the circle: edges
    vote for centres on their bright side, for each radius. The circle is then fitted to the edge, which is
    located along rays from the centre.

    A circle of radius a implies a centre at sqrt(radius^2 - a^2) below the rest plane. If the light ends
    before the contact does, the true centre is lower. InputError if a ball is visible in less than half of
    the frames.
    """
    centres, sigma = np.full((2, len(frames), 3), np.nan)
    for number, frame in enumerate(frames):
        fitted = _outline(frame, pixel_size, radius)
        if fitted is not None:
            (x, y, outline), error = fitted
            below = math.sqrt(max(radius**2 - outline**2, 0.01 * radius**2))
            centres[number] = x, y, -math.sqrt(max(0.0, radius**2 - outline**2))
            sigma[number] = error * (1, 1, outline / below)
    count = int(np.isfinite(centres[:, 0]).sum())
    if 2 * count <= len(frames):
        raise InputError(
            f"a ball of {2 * radius:g} mm is seen in {count} of {len(frames)} frames: check its diameter and"
            " the pixel size, and press it until a ring of light shows in all frames"
        )
    return BallCentres(centres, sigma)


def smooth_turn(values: Doubles, phase: Doubles) -> Doubles:
    """Fit mean, cosine and sine, (3, c), to values, (T, c), over a rotation, robustly."""
    valid = np.isfinite(values).all(axis=1)
    functions, values = basis(phase[valid]), values[valid]
    weight = np.ones(len(values))
    for _ in range(_FIT_ITERATIONS):
        root = np.sqrt(weight)[:, np.newaxis]
        wave = np.linalg.lstsq(functions * root, values * root, rcond=None)[0]
        residual = np.sqrt(np.sum((values - functions @ wave) ** 2, axis=1))
        weight = geman_mcclure(_STRAY).weights(residual / (float(np.median(residual)) + 1e-9))
    return np.asarray(wave)


class _Circle(NamedTuple):
    """Millimetres from the picture's centre."""

    x: float
    y: float
    radius: float


class _Gradients(NamedTuple):
    """Gradients of a downscaled and blurred picture."""

    slope: Doubles  # (2, h, w): along x and y, counts per mm
    steepness: Doubles  # (h, w): length of the slope
    corner: Doubles  # (2,): x and y of the first pixel, mm
    step: Doubles  # (2,): difference in x from column to column, and in y from row to row, mm

    @property
    def pixel(self) -> float:
        """Larger side of a pixel, mm."""
        return float(np.max(np.abs(self.step)))

    def at(self, values: Doubles, places: Doubles) -> Doubles:
        """Interpolate a map, (h, w), linearly at places, (2, ...), mm; 0 outside."""
        from scipy.ndimage import map_coordinates

        columns, rows = ((places.T - self.corner) / self.step).T
        return np.asarray(map_coordinates(values, [rows, columns], order=1, cval=0.0))


def _outline(
    frame: NDArray[Any], pixel_size: tuple[float, float], radius: float
) -> tuple[_Circle, Doubles] | None:
    """Return the circle where the light of a frame ends, and its standard errors; None if none."""
    circle = _find_circle(_gradients(*_downscale(frame, pixel_size, _SEARCH_SIZE), _SEARCH_BLUR), radius)
    small = _downscale(frame, pixel_size, _FIT_SIZE)
    fitted = None
    for blur in (_SEARCH_BLUR, _FIT_BLUR):
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
    valid = np.isfinite(values)
    values = np.where(valid, values, np.median(values[valid]) if valid.any() else 0.0)
    small = values.reshape(rows, block, columns, block).mean(axis=(1, 3))
    x, y = pixel_axes((frame.shape[0], frame.shape[1]), pixel_size)
    corner = np.array([x[:block].mean(), y[:block].mean()])
    step = np.array([pixel_size[0], -pixel_size[1]]) * block
    return np.asarray(median_filter(small, 3, mode="nearest")), corner, step


def _gradients(small: Doubles, corner: Doubles, step: Doubles, blur: float) -> _Gradients:
    from scipy.ndimage import gaussian_filter

    orders = zip(((0, 1), (1, 0)), step, strict=True)
    slope = np.stack([gaussian_filter(small, blur, order=order, mode="nearest") / h for order, h in orders])
    return _Gradients(slope, np.hypot(*slope), corner, step)


def _find_circle(picture: _Gradients, radius: float) -> _Circle | None:
    """Return the circle that contains most of the outline of a bright area; None if there is none."""
    places, inwards = _edges(picture)
    pixel = picture.pixel
    best, votes = None, 0.0
    margin = round(_OUTSIDE * radius / pixel)
    min_radius = min(_MIN_RADIUS * pixel, radius)
    for outline in np.linspace(
        min_radius, radius, 1 + math.ceil((radius - min_radius) / (_SEARCH_BLUR * pixel))
    ):
        count = _vote(picture, places + outline * inwards, margin)
        row, column = np.unravel_index(np.argmax(count), count.shape)
        coverage = count[row, column] * pixel / (2 * np.pi * outline)
        if coverage >= _MIN_VISIBLE and count[row, column] > votes:
            votes = float(count[row, column])
            x, y = picture.corner + picture.step * (column - margin, row - margin)
            best = _Circle(float(x), float(y), float(outline))
    return best


def _edges(picture: _Gradients) -> tuple[Doubles, Doubles]:
    """Return the points of greatest slope along their gradient, and the uphill directions, (2, n) each."""
    steepness = picture.steepness
    threshold = max(
        _MIN_EDGE_CONTRAST * float(np.median(steepness)), _MIN_EDGE_SLOPE * float(steepness.max()), 1e-12
    )
    rows, columns = np.nonzero(steepness > threshold)
    places = (picture.corner + picture.step * np.stack([columns, rows], axis=1)).T
    here = steepness[rows, columns]
    uphill = picture.slope[:, rows, columns] / here
    before, behind = (picture.at(steepness, places + sign * picture.pixel * uphill) for sign in (-1, 1))
    ridge = (here >= before) & (here >= behind)
    return places[:, ridge], uphill[:, ridge]


def _vote(picture: _Gradients, centres: Doubles, margin: int) -> Doubles:
    """Count the centres, (2, n), near each pixel of the picture and a margin around it.

    Votes are weighted by a normal distribution of the distance.
    """
    from scipy.ndimage import gaussian_filter

    rows, columns = (size + 2 * margin for size in picture.steepness.shape)
    column, row = np.rint(((centres.T - picture.corner) / picture.step).T).astype(np.intp) + margin
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    count = np.bincount((row * columns + column)[inside], minlength=rows * columns)
    count = count.reshape(rows, columns).astype(np.float64)
    near = gaussian_filter(count, _SEARCH_BLUR, mode="constant", truncate=2.0)
    return np.asarray(near * (2 * np.pi * _SEARCH_BLUR**2))


def _fit_circle(picture: _Gradients, circle: _Circle, radius: float) -> tuple[_Circle, Doubles] | None:
    """Fit a circle to the edge of the light on rays from its centre, and return it with standard errors.

    None if the light ends elsewhere on most rays.
    """
    pixel = picture.pixel
    angle = np.arange(_RAYS) * 2 * np.pi / _RAYS
    rays = np.stack([np.cos(angle), np.sin(angle)])
    functions = np.stack([*rays, np.ones(_RAYS)], axis=1)
    for _ in range(_FIT_ITERATIONS):
        away, fall = _locate_edge(picture, circle, rays)
        if not (fall > 0).any():
            return None
        # An error (x, y) of the centre and r of the radius makes the residual x cos + y sin + r.
        usual = max(float(np.median(np.abs(away[fall > 0]))), _SHARP * pixel)
        weight = np.sqrt(np.maximum(fall / fall.max(), 0) * geman_mcclure(_OFF).weights(away / usual))
        weighted = functions * weight[:, np.newaxis]
        step = np.linalg.lstsq(weighted, away * weight, rcond=None)[0]
        x, y, outline = np.array(circle) + step
        circle = _Circle(float(x), float(y), min(max(float(outline), pixel), radius))
        if np.max(np.abs(step)) < _CONVERGED * pixel:
            break
    on_circle = (fall > _MIN_EDGE_SLOPE * float(picture.steepness.max())) & (np.abs(away) <= _ROUND * pixel)
    ends = np.array(circle[:2])[:, np.newaxis] + rays * circle.radius
    in_picture = picture.at(np.ones_like(picture.steepness), ends)
    if 2 * np.count_nonzero(on_circle) <= np.count_nonzero(in_picture):
        return None
    # Rays that pass less than a blur apart are not independent.
    shared = max(1.0, _RAYS * 2 * _SEARCH_BLUR * pixel / (2 * np.pi * circle.radius))
    variance = shared * np.sum((weight * (away - functions @ step)) ** 2) / np.sum(weight**2)
    covariance = np.linalg.pinv(weighted.T @ weighted)
    error = np.sqrt(np.maximum(variance, (_CONVERGED * pixel) ** 2) * np.diag(covariance))
    return circle, np.asarray(error)


def _locate_edge(picture: _Gradients, circle: _Circle, rays: Doubles) -> tuple[Doubles, Doubles]:
    """Return the distance of the light's edge from a circle along rays, mm, and its steepness."""
    pixel = picture.pixel
    reach = np.arange(-_NEAR, _NEAR + 0.25, 0.5) * pixel
    middle = np.array(circle[:2])[:, np.newaxis, np.newaxis]
    places = middle + rays[:, :, np.newaxis] * np.maximum(circle.radius + reach, 0)
    along_x, along_y = (picture.at(slope, places) for slope in picture.slope)
    fall = -(rays[0, :, np.newaxis] * along_x + rays[1, :, np.newaxis] * along_y)
    peak = np.clip(np.argmax(fall, axis=1), 1, len(reach) - 2)
    before, steepest, behind = (fall[np.arange(len(peak)), peak + step] for step in (-1, 0, 1))
    # Vertex of the parabola through three values.
    curvature = np.minimum(before - 2 * steepest + behind, -1e-300)
    beyond = np.clip((before - behind) / (2 * curvature), -1, 1)
    return reach[peak] + beyond * 0.5 * pixel, steepest
