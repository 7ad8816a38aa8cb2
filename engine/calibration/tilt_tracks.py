"""What a turn shows of the body's lean: where a ball is in each frame, or how a plate is inclined."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import follow_ball, pixel_size_of, read_turn, see_ball
from mirrorskin.engine.calibration.brightness import Brightness, LinearBrightness
from mirrorskin.engine.rotation.design_matrix import check_phases
from mirrorskin.io import InputError, Source, pixel_axes

Doubles = NDArray[np.float64]

_MOST_BYTES = 2_000_000_000  # of frames that are held
_PHASES = 4  # that an ellipse and its mean need, at least
_SAME_PHASE = 1e-6  # radians
_MARGIN = 2.0  # pixels from the outline within which a sample may be of the rest sheet
_MOST = 20_000  # samples of a frame that are fitted
_FEWEST = 30
_ROUNDS = 8
_STEP = 1e-3  # mm, of differences
_CONVERGED = 1e-6  # mm
_MEDIAN = 1.4826  # standard deviations of a normal variate, of its median magnitude
_OUTLIER = 4.0  # standard deviations from which on a sample counts little
_FAR = 0.25  # radii by which light may correct an outline
_DEEP = 0.5  # mm by which an outline may mistake the depth where it is not that of the contact
_RIM = 0.85  # share of the outline's radius from which on the rim is looked at
_MOSTLY = 0.8  # share of the rim that must show the ball
_SHALLOWER = 0.1  # share of the press by which the depth may differ from it
_RIM_ERROR = 0.01  # radians that the mean residual of a sound rim may have
_FAINT = 0.01  # share of the range that a plate must show


class BallTrack(NamedTuple):
    """A ball's centre in the frames of a turn; NaN where it is not seen."""

    phase: Doubles  # (T,): radians, as the recording has them
    centres: Doubles  # (T, 3): mm, in the body's frame of that pose
    sigma: Doubles  # (T, 3): standard errors, mm


class PlateTrack(NamedTuple):
    """The zenith that a plate shows in the frames of a turn; (T,), radians."""

    phase: Doubles
    zenith: Doubles
    sigma: Doubles
    level: bool  # else it is a wedge, inclined anyhow


class _BallTurn(NamedTuple):
    frames: NDArray[Any]
    pixel_size: tuple[float, float]
    radius: float
    light: Brightness


def track_ball(source: Source, radius: float, light: Brightness) -> BallTrack:
    """Find a ball's centre in each frame of an axial recording.

    Its outline gives it roughly (see `follow_ball`). Then what the ball shows is fitted to the light inside
    by Gauss-Newton steps. Light that is linear in the zenith does not depend on how deep the ball lies: the
    depth then comes from the outline alone, if that is where the contact ends. It is not, and the depth all
    but unknown, where what lies within does not show the ball up to the rim (the wall ends before the contact
    does), and where the stage's press is another (the gel gives way, or the stage's zero is wrong).
    """
    pixel_size = pixel_size_of(source)
    if not radius > 0:
        raise InputError(f"a ball of {2 * radius:g} mm cannot be: give its diameter")
    frames, phase = _read_turn(source)
    try:
        centres, sigma = follow_ball(frames, pixel_size, radius)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from None
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
    """Find how far a plate leans in each frame of an axial recording, by the mean of the pixels that show it.

    A level plate is dark unless the wall reaches up to the camera; a wedge is then needed.
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
        faint = np.where(np.isfinite(light.high - light.low), _FAINT * (light.high - light.low), 0.0)
        seen = (mean > light.low + faint) & (mean < light.high - faint)
    zenith = zenith[:, seen]
    for _ in range(2):  # without the plate's edge, where frames do not vary as those of the others
        if zenith.shape[1] < _FEWEST:
            raise InputError(
                f"{source.name}: no flat plate is seen: with this pattern it is dark unless it is inclined"
                " more; take a wedge of 25 degrees, say"
            )
        middle = np.median(zenith, axis=1, keepdims=True)
        away = np.sqrt(np.mean((zenith - middle) ** 2, axis=0))
        zenith = zenith[:, away < _OUTLIER * np.median(away) + 1e-12]
    sigma = (zenith.std(axis=1) + 1e-9) / math.sqrt(zenith.shape[1])
    return PlateTrack(phase, zenith.mean(axis=1), sigma, level)


def _read_turn(source: Source) -> tuple[NDArray[Any], Doubles]:
    """Return all frames and their phases, if these determine an ellipse."""
    size = int(np.prod(source.shape)) * source.dtype.itemsize
    if size > _MOST_BYTES:
        raise InputError(f"{source.name}: {size / 1e9:.1f} GB of frames are too much: take a turn or two")
    frames, phase = read_turn(source)
    known = check_phases(phase)
    different = len(np.unique(np.round(np.mod(known, math.tau) / _SAME_PHASE)))
    if different < _PHASES:
        raise InputError(f"{source.name}: {different} different phases, at least {_PHASES} are needed")
    return frames, known


def _fit_centre(turn: _BallTurn, frame: NDArray[Any], centre: Doubles, sigma: Doubles) -> None:
    """Bring a centre of one frame, and its standard errors, (3,), to what the light says, in place."""
    x, y = np.meshgrid(*pixel_axes((frame.shape[0], frame.shape[1]), turn.pixel_size))
    outline = math.sqrt(max(turn.radius**2 - float(centre[2]) ** 2, 0.0)) - _MARGIN * max(turn.pixel_size)
    pixels = np.flatnonzero(np.hypot(x - centre[0], y - centre[1]) < outline)
    pixels = pixels[:: max(1, len(pixels) // _MOST)]
    x, y = x.ravel()[pixels], y.ravel()[pixels]
    light = turn.light.of_counts(frame.ravel()[pixels], pixels)
    sight = np.stack([x, y, *turn.light.sight(pixels)])
    linear = isinstance(turn.light, LinearBrightness)
    prior, outline_sigma = float(sigma[2]) if linear else _DEEP, sigma[2]
    sigma[2] = _DEEP  # until it is seen that the outline is that of the contact
    place = centre.copy()
    for _ in range(_ROUNDS):
        expected, within = _expected(turn, sight, pixels, place)
        beside = [_expected(turn, sight, pixels, place + step)[0] for step in _STEP * np.eye(3)]
        slopes, residual = (np.stack(beside, axis=1) - expected[:, np.newaxis]) / _STEP, light - expected
        used = within & np.isfinite(residual) & np.isfinite(slopes).all(axis=1)
        if np.count_nonzero(used) < _FEWEST:
            return
        slopes, residual = slopes[used], residual[used]
        spread = _MEDIAN * float(np.median(np.abs(residual))) + 1e-9
        weighted = slopes / ((1 + (residual / (_OUTLIER * spread)) ** 2) * spread)[:, np.newaxis] ** 2
        square, pull = weighted.T @ slopes, weighted.T @ residual
        square[2, 2] += prior**-2
        pull[2] += (centre[2] - place[2]) / prior**2
        step = np.linalg.solve(square, pull)
        place = place + np.clip(step, -1, 1) * min(1.0, float(turn.radius))
        if np.max(np.abs(step)) < _CONVERGED:
            break
    if np.linalg.norm((place - centre)[:2]) > _FAR * turn.radius:
        return
    centre[:], sigma[:] = place, np.sqrt(np.diag(np.linalg.inv(square)))
    if linear:
        away = np.hypot(x - place[0], y - place[1])
        rim = away > _RIM * away.max()
        off = residual[rim[used]]
        shown = off.size >= max(1, _MOSTLY * np.count_nonzero(rim)) and (
            abs(float(np.mean(off))) < _RIM_ERROR + _OUTLIER * spread / math.sqrt(off.size)
        )
        sigma[2] = outline_sigma if shown else _DEEP


def _expected(
    turn: _BallTurn, sight: Doubles, pixels: NDArray[np.intp], centre: Doubles
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return what pixels, (n,), show of a ball upright at a place, and whether that is within range."""
    seen = see_ball(sight, centre, turn.radius, np.zeros((1, 2)), (0.0, 0.0, 0.0))
    with np.errstate(invalid="ignore"):
        light, within = turn.light.of_normals(seen.normal, seen.z, pixels)
    return light[0], within[0] & seen.contact[0]
