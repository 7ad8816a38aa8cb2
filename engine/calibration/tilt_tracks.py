"""The lean of the body in a rotation: the position of a ball in each frame, or the zenith of a plate."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.calibration.ball import follow_ball, see_ball
from mirrorskin.engine.calibration.brightness import Brightness, LinearBrightness
from mirrorskin.engine.calibration.sources import check_ball_radius, pixel_size_of, read_turn
from mirrorskin.engine.correlation.design_matrix import check_phases
from mirrorskin.io import InputError, Source, pixel_axes
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import mad_sigma

_MOST_BYTES = 2_000_000_000  # maximum size of frames in memory
_PHASES = 4  # minimum number of phases for an ellipse and its mean
_SAME_PHASE = 1e-6  # radians
_OUTLINE_MARGIN = 2.0  # pixels from the outline within which a sample may show the free sheet
_MAX_SAMPLES = 20_000  # maximum number of fitted samples of a frame
_MIN_SAMPLES = 30  # minimum number of samples of a frame
_DERIVATIVE_STEP = 1e-3  # mm: step of numerical derivatives
_OUTLIER_Z_SCORE = 4.0  # standard deviations: scale of the robust weights
_OUT = 1e3  # residual of a sample that does not show the ball, or is out of range
_FAR = 0.25  # radii: maximum distance of the fitted centre from the outline's centre
_DEEP = 0.5  # mm: standard deviation of the depth if the outline is not the outline of the contact
_RIM = 0.85  # inner radius of the rim, as a share of the outline's radius
_MOSTLY = 0.8  # minimum share of the rim that shows the ball
_SHALLOWER = 0.1  # maximum relative difference of the depth from the recorded press
_RIM_ERROR = 0.01  # radians: maximum mean residual of a valid rim
_EXCLUDED_ENDS = 0.01  # share of the range, at both ends, that is excluded for a plate


class BallTrack(NamedTuple):
    """A ball's centre in the frames of a rotation; NaN where no ball is visible."""

    phase: Doubles  # (T,): radians, as in the recording
    centres: Doubles  # (T, 3): mm, in the body's frame of that pose
    sigma: Doubles  # (T, 3): standard errors, mm


class PlateTrack(NamedTuple):
    """The zenith of a plate in the frames of a rotation; (T,), radians."""

    phase: Doubles
    zenith: Doubles
    sigma: Doubles
    level: bool  # whether the plate is level; otherwise it is a wedge of unknown inclination


class _BallTurn(NamedTuple):
    frames: NDArray[Any]
    pixel_size: tuple[float, float]
    radius: float
    light: Brightness


def track_ball(source: Source, radius: float, light: Brightness) -> BallTrack:
    """Find a ball's centre in each frame of an axial recording.

    The outline determines an approximate centre (see `follow_ball`); the light inside it is then fitted by
    Gauss-Newton steps. Light that is linear in the zenith does not depend on the ball's depth, so the depth
    is computed from the outline only, provided that it is the outline of the contact. The depth is nearly
    unknown if the rim does not show the ball (the wall ends before the contact does), or if the depth differs
    from the recorded press (the elastomer deflects, or the stage's zero is wrong).

    Parameters
    ----------
    source : Source
    radius : float
        Radius of the ball, mm.
    light : LinearBrightness or WallBrightness
    """
    pixel_size = pixel_size_of(source)
    check_ball_radius(radius)
    frames, phase = _read_turn(source)
    with naming(source):
        centres, sigma = follow_ball(frames, pixel_size, radius)
    turn = _BallTurn(frames, pixel_size, radius, light)
    for number in np.flatnonzero(np.isfinite(centres[:, 0])):
        _fit_centre(turn, frames[number], centres[number], sigma[number])
    press = source.header.press
    if isinstance(light, LinearBrightness) and press is not None:
        depth = float(np.nanmean(centres[:, 2])) + radius
        if abs(depth - press) >= _SHALLOWER * press:
            sigma[:, 2] = np.fmax(sigma[:, 2], _DEEP)
    return BallTrack(phase, centres, sigma)


def track_plate(source: Source, level: bool, light: Brightness) -> PlateTrack:
    """Find the zenith of a plate in each frame of an axial recording, as the mean of the pixels that show it.

    A level plate is dark unless the wall reaches up to the camera; then a wedge is needed.

    Parameters
    ----------
    source : Source
    level : bool
        Whether the plate is level.
    light : LinearBrightness
    """
    if not isinstance(light, LinearBrightness):
        raise InputError(
            f"{source.name}: a plate shows its zenith only where brightness is linear in it:"
            " give the zenith gain and offset, or take balls at several places"
        )
    frames, phase = _read_turn(source)
    zenith = light.of_counts(frames.reshape(len(frames), -1), np.arange(frames[0].size))
    mean = zenith.mean(axis=0)
    with np.errstate(invalid="ignore"):
        margin = np.where(np.isfinite(light.high - light.low), _EXCLUDED_ENDS * (light.high - light.low), 0.0)
        zenith = zenith[:, (mean > light.low + margin) & (mean < light.high - margin)]
    for _ in range(2):  # without the plate's edge, where brightness varies differently
        if zenith.shape[1] < _MIN_SAMPLES:
            raise InputError(
                f"{source.name}: no flat plate is seen: with this pattern it is dark unless it is inclined"
                " more; take a wedge of 25 degrees, say"
            )
        middle = np.median(zenith, axis=1, keepdims=True)
        residual = np.sqrt(np.mean((zenith - middle) ** 2, axis=0))
        zenith = zenith[:, residual < _OUTLIER_Z_SCORE * np.median(residual) + 1e-12]
    sigma = (zenith.std(axis=1) + 1e-9) / math.sqrt(zenith.shape[1])
    return PlateTrack(phase, zenith.mean(axis=1), sigma, level)


def _read_turn(source: Source) -> tuple[NDArray[Any], Doubles]:
    """Return all frames and their phases, if these determine an ellipse."""
    size = int(np.prod(source.shape)) * source.dtype.itemsize
    if size > _MOST_BYTES:
        raise InputError(f"{source.name}: {size / 1e9:.1f} GB of frames are too much: take a turn or two")
    frames, phase = read_turn(source)
    phase = check_phases(phase)
    different = len(np.unique(np.round(np.mod(phase, math.tau) / _SAME_PHASE)))
    if different < _PHASES:
        raise InputError(f"{source.name}: {different} different phases, at least {_PHASES} are needed")
    return frames, phase


def _fit_centre(turn: _BallTurn, frame: NDArray[Any], centre: Doubles, sigma: Doubles) -> None:
    """Fit the centre in one frame, (3,), and its standard errors to the light, in place."""
    x, y = np.meshgrid(*pixel_axes((frame.shape[0], frame.shape[1]), turn.pixel_size))
    outline = math.sqrt(max(turn.radius**2 - float(centre[2]) ** 2, 0.0)) - _OUTLINE_MARGIN * max(
        turn.pixel_size
    )
    pixels = np.flatnonzero(np.hypot(x - centre[0], y - centre[1]) < outline)
    pixels = pixels[:: max(1, len(pixels) // _MAX_SAMPLES)]
    x, y = x.ravel()[pixels], y.ravel()[pixels]
    light = turn.light.of_counts(frame.ravel()[pixels], pixels)
    sight = np.stack([x, y, *turn.light.sight(pixels)])
    linear = isinstance(turn.light, LinearBrightness)
    prior, outline_sigma = float(sigma[2]) if linear else _DEEP, sigma[2]
    sigma[2] = _DEEP  # unless the outline is found to be the outline of the contact

    def residuals(place: Doubles) -> Doubles:
        expected, within = _expected(turn, sight, pixels, place)
        off = expected - light
        return np.where(within & np.isfinite(off), off, _OUT)

    def jacobian(place: Doubles) -> Doubles:
        expected, _ = _expected(turn, sight, pixels, place)
        moved = [_expected(turn, sight, pixels, place + step)[0] for step in _DERIVATIVE_STEP * np.eye(3)]
        return np.nan_to_num((np.stack(moved, axis=1) - expected[:, np.newaxis]) / _DERIVATIVE_STEP)

    def noise(off: Doubles) -> float:
        return mad_sigma(off[off != _OUT]) + 1e-9

    first = residuals(centre)
    if np.count_nonzero(first != _OUT) < _MIN_SAMPLES:
        return
    solution = least_squares.fit(
        residuals,
        centre.copy(),
        jacobian=jacobian,
        noise=noise(first),
        rescale=noise,
        loss=least_squares.geman_mcclure(_OUTLIER_Z_SCORE),
        prior=least_squares.Prior(np.array([[0, 0, 1 / prior]]), centre[2:] / prior),
    )
    place, used = solution.parameters, solution.residuals != _OUT
    if np.count_nonzero(used) < _MIN_SAMPLES:
        return
    if np.linalg.norm((place - centre)[:2]) > _FAR * turn.radius:
        return
    centre[:], sigma[:] = place, np.sqrt(np.diag(solution.covariance()))
    if linear:
        away = np.hypot(x - place[0], y - place[1])
        rim = away > _RIM * away.max()
        off = solution.residuals[rim & used]
        visible = off.size >= max(1, _MOSTLY * np.count_nonzero(rim)) and (
            abs(float(np.mean(off)))
            < _RIM_ERROR + _OUTLIER_Z_SCORE * noise(solution.residuals) / math.sqrt(off.size)
        )
        sigma[2] = outline_sigma if visible else _DEEP


def _expected(
    turn: _BallTurn, sight: Doubles, pixels: NDArray[np.intp], centre: Doubles
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return the brightness of pixels, (n,), for a ball at a position, and whether it is within range."""
    projected = see_ball(sight, centre, turn.radius, np.zeros((1, 2)), (0.0, 0.0, 0.0))
    with np.errstate(invalid="ignore"):
        light, within = turn.light.of_normals(projected.normal, projected.z, pixels)
    return light[0], within[0] & projected.contact[0]
