"""Turns of the body on a ball or on a plate, read from recordings."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import BallView, Followed, ball_view, follow_ball
from mirrorskin.engine.calibration.brightness import LinearShown, Shown
from mirrorskin.io import InputError, Source, pixel_axes

Doubles = NDArray[np.float64]

_MOST_BYTES = 2_000_000_000  # bytes of frames that are held


@dataclass(frozen=True, slots=True, eq=False)
class BallTurn:
    """A turn of the body on a ball."""

    name: str  # Of where it comes from
    frames: NDArray[Any]  # (T, H, W): Counts
    phase: Doubles  # (T,): Radians, as the recording says
    pixel_size: tuple[float, float]  # Millimetres along x and y
    radius: float  # Of the ball, mm
    press: float | None = None  # By how much the stage says that it is pressed, upright, mm


@dataclass(frozen=True, slots=True, eq=False)
class PlateTurn:
    """A turn of the body on a flat plate."""

    name: str  # See `BallTurn`
    frames: NDArray[Any]  # See `BallTurn`
    phase: Doubles  # See `BallTurn`
    level: bool  # Whether the plate is known to be level; else it is a wedge, inclined anyhow


def read_ball(source: Source, radius: float) -> BallTurn:
    """Read an axial recording of a ball of some radius, mm."""
    pixel_size = source.header.pixel_size
    if pixel_size is None:
        raise InputError(f"{source.name}: its pixel size is not told: give it, as in --pixel-size 0.03mm")
    if not radius > 0:
        raise InputError(f"a ball of {2 * radius:g} mm cannot be: give its diameter")
    return BallTurn(source.name, *_read(source), pixel_size, radius, source.header.press)


def read_plate(source: Source, level: bool) -> PlateTurn:
    """Read an axial recording of a flat plate, level or not; see `read_ball`."""
    return PlateTurn(source.name, *_read(source), level)


def _read(source: Source) -> tuple[NDArray[Any], Doubles]:
    """Return all frames and their phases."""
    if source.motion != "axial":
        raise InputError(f"{source.name} is of {source.motion} motion: an axial recording is needed")
    frames = int(np.prod(source.shape)) * source.dtype.itemsize
    if frames > _MOST_BYTES:
        raise InputError(f"{source.name}: {frames / 1e9:.1f} GB of frames are too much: take a turn or two")
    room = np.empty(source.shape, source.dtype)
    phases: list[Doubles] = []
    count = 0
    while count < len(room) and (block := source.read(room[count:])) is not None:
        if block.phase is None:
            raise InputError(f"{source.name} tells no phases: give them, as in --phase-step 45deg")
        room[count : count + len(block.frames)] = block.frames
        count += len(block.frames)
        phases.append(block.phase)
    return room[:count], np.concatenate([*phases, np.zeros(0)])


_MARGIN = 2.0  # pixels from the outline within which a sample may be of the rest sheet
_MOST = 20_000  # samples of a frame that are fitted
_FEWEST = 30
_ROUNDS = 8
_STEP = 1e-3  # mm, to differentiate by
_SETTLED = 1e-6  # mm
_MEDIAN = 1.4826  # standard deviations of a normal variate, of its median magnitude
_STRAY = 4.0  # standard deviations from which on a sample counts little
_FAR = 0.25  # radii by which light may correct an outline
_DEEP = 0.5  # mm by which an outline may mistake the depth where it is not that of the contact
_RIM = 0.85  # share of the outline's radius from which on the rim is looked at
_MOSTLY = 0.8  # share of the rim that must show the ball
_SHALLOWER = 0.1  # share of the press by which the depth may differ from it
_ODD = 0.01  # radians by which it may do so wrongly
_FAINT = 0.01  # share of the range that a plate must show


@dataclass(frozen=True, slots=True, eq=False)
class Tilts:
    """The zenith that a plate shows in each frame, and its standard error; (T,), radians."""

    zenith: Doubles
    sigma: Doubles

    def with_sigma(self, sigma: float) -> Tilts:
        """Return the same with one standard error."""
        return replace(self, sigma=np.full_like(self.sigma, sigma))


def track_ball(turn: BallTurn, shown: Shown) -> Followed:
    """Tell where a ball's centre is in each frame.

    Its outline tells that roughly (see `follow_ball`). Then what the ball shows is fitted to the light inside
    by Gauss-Newton steps. Light that is linear in the zenith does not depend on how deep the ball lies: that
    is told by the outline alone, if that is where the contact ends. It is not, and the depth all but unknown,
    where what lies within does not show the ball up to the rim (the wall ends before the contact does), and
    where the stage says that the ball is pressed by something else (the gel gives way, or the stage's zero is
    wrong).
    """
    try:
        followed = follow_ball(turn.frames, turn.pixel_size, turn.radius)
    except InputError as error:
        raise InputError(f"{turn.name}: {error}") from None
    centres, sigma = followed.centres.copy(), followed.sigma.copy()
    for number in np.flatnonzero(np.isfinite(centres[:, 0])):
        _fit_place(turn, shown, int(number), centres[number], sigma[number])
    if isinstance(shown, LinearShown) and not _as_deep_as_told(turn, centres):
        sigma[:, 2] = np.fmax(sigma[:, 2], _DEEP)
    return Followed(centres, sigma)


def track_plate(turn: PlateTurn, shown: LinearShown) -> Tilts:
    """Tell how far a plate leans in each frame, by the mean of the pixels that show it."""
    count = len(turn.frames)
    pixels = np.arange(turn.frames[0].size)
    zenith = shown.of_counts(turn.frames.reshape(count, -1), pixels)
    mean = zenith.mean(axis=0)
    with np.errstate(invalid="ignore"):
        faint = np.where(np.isfinite(shown.high - shown.low), _FAINT * (shown.high - shown.low), 0.0)
        seen = (mean > shown.low + faint) & (mean < shown.high - faint)
    zenith = zenith[:, seen]
    for _ in range(2):  # without the plate's edge, where frames do not go as those of the others
        if zenith.shape[1] < _FEWEST:
            raise InputError(
                f"{turn.name}: no flat plate is seen: with this pattern it is dark unless it is inclined"
                " more; take a wedge of 25 degrees, say"
            )
        middle = np.median(zenith, axis=1, keepdims=True)
        away = np.sqrt(np.mean((zenith - middle) ** 2, axis=0))
        zenith = zenith[:, away < _STRAY * np.median(away) + 1e-12]
    spread = zenith.std(axis=1) + 1e-9
    return Tilts(zenith.mean(axis=1), spread / math.sqrt(zenith.shape[1]))


def _fit_place(turn: BallTurn, shown: Shown, number: int, centre: Doubles, sigma: Doubles) -> None:
    """Bring a centre of one frame, and its standard errors, (3,), to what the light says, in place."""
    pixels, x, y = _inside(turn, centre)
    light = shown.of_counts(turn.frames[number].ravel()[pixels], pixels)
    view = BallView(np.stack([x, y, *shown.sight(pixels)]))
    outlined = isinstance(shown, LinearShown)
    error, outline_error = float(sigma[2]) if outlined else _DEEP, sigma[2]
    sigma[2] = _DEEP  # until it is seen that the outline is that of the contact
    place = centre.copy()
    for _ in range(_ROUNDS):
        modelled, within = _modelled(turn, shown, view, pixels, place)
        beside = [_modelled(turn, shown, view, pixels, place + step)[0] for step in _STEP * np.eye(3)]
        slopes, left = (np.stack(beside, axis=1) - modelled[:, np.newaxis]) / _STEP, light - modelled
        used = within & np.isfinite(left) & np.isfinite(slopes).all(axis=1)
        if np.count_nonzero(used) < _FEWEST:
            return
        slopes, left = slopes[used], left[used]
        spread = _MEDIAN * float(np.median(np.abs(left))) + 1e-9
        weighted = slopes / ((1 + (left / (_STRAY * spread)) ** 2) * spread)[:, np.newaxis] ** 2
        square, pull = weighted.T @ slopes, weighted.T @ left
        square[2, 2] += error**-2
        pull[2] += (centre[2] - place[2]) / error**2
        step = np.linalg.solve(square, pull)
        place = place + np.clip(step, -1, 1) * min(1.0, float(turn.radius))
        if np.max(np.abs(step)) < _SETTLED:
            break
    if np.linalg.norm((place - centre)[:2]) > _FAR * turn.radius:
        return
    centre[:], sigma[:] = place, np.sqrt(np.diag(np.linalg.inv(square)))
    away = np.hypot(x - place[0], y - place[1])
    if outlined:
        sigma[2] = outline_error if _shows_rim(away, used, left, spread) else _DEEP


def _shows_rim(away: Doubles, used: NDArray[np.bool_], left: Doubles, spread: float) -> bool:
    """Tell whether samples so far from the centre show the ball up to its outline."""
    rim = away > _RIM * away.max()
    odd = left[rim[used]]
    if odd.size < max(1, _MOSTLY * np.count_nonzero(rim)):
        return False
    return abs(float(np.mean(odd))) < _ODD + _STRAY * spread / math.sqrt(odd.size)


def _as_deep_as_told(turn: BallTurn, centres: Doubles) -> bool:
    """Tell whether the mean depth is that of the stage, if it tells one."""
    if turn.press is None:
        return True
    depth = float(np.nanmean(centres[:, 2])) + turn.radius
    return abs(depth - turn.press) < _SHALLOWER * turn.press


def _inside(turn: BallTurn, centre: Doubles) -> tuple[NDArray[np.intp], Doubles, Doubles]:
    """Return pixels well inside a ball's outline, not too many, and where they are, mm."""
    shape = turn.frames.shape[1], turn.frames.shape[2]
    x, y = np.meshgrid(*pixel_axes(shape, turn.pixel_size))
    outline = math.sqrt(max(turn.radius**2 - float(centre[2]) ** 2, 0.0)) - _MARGIN * max(turn.pixel_size)
    inside = np.flatnonzero(np.hypot(x - centre[0], y - centre[1]) < outline)
    inside = inside[:: max(1, len(inside) // _MOST)]
    return inside, x.ravel()[inside], y.ravel()[inside]


def _modelled(
    turn: BallTurn, shown: Shown, view: BallView, pixels: NDArray[np.intp], centre: Doubles
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return what pixels, (n,), show of a ball upright at a place, and whether that is within range."""
    seen = ball_view(view, centre, turn.radius, np.zeros((1, 2)), (0.0, 0.0, 0.0))
    with np.errstate(invalid="ignore"):
        light, within = shown.of_normals(seen.normal, seen.z, pixels)
    return light[0], within[0] & seen.contact[0]
