"""Brightness by place and normal, from presses of a ball."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import find_ball, moved
from mirrorskin.engine.calibration.wall_fit import Prior, fit_touch
from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    SENSOR,
    Samples,
)
from mirrorskin.engine.calibration.wall_response import make_response
from mirrorskin.io import InputError, Precession, References, Source, WallResponse, pixel_axes
from mirrorskin.io.calibration.types import PATTERNS

Doubles = NDArray[np.float64]

_STEEPEST = math.radians(50.0)  # zenith on the ball up to which samples are taken
_BEYOND = 1.35  # times the outline of the light up to which they are, too
_PLACE = 1.0  # mm by which the picture alone may misplace a ball
_DEPTH = 0.2  # mm by which a travel that was told may be off from how deep the ball is pressed
_LEAST = 20  # samples of a frame
_FRAMES = 16  # of a recording that are held at most
_CLIPPED = 64  # samples at one value of the form 2^n - 1 from which on it is the camera's end
_FAR = 30.0  # mm of the pivot where nothing is told of it
_NEAR = 3.0  # mm by which a pivot may be off that was told, not calibrated
_OFFSET = math.radians(2.0)  # by which a phase may be off that was calibrated
_ANY = math.radians(45.0)  # by which it may be off that a recording tells
_DOUBT = 0.02  # of these, by which calibrated ones may be off at least


@dataclass(frozen=True, slots=True, eq=False)
class BallPress:
    """An axial recording of a ball, read.

    Attributes
    ----------
    name : str
        Of its source.
    light : ndarray, (M,), float64
    place : ndarray, (2, M), float64
        Of each sample's pixel on the rest plane, mm.
    frame : ndarray, (M,), intp
    lean : ndarray, (T, 2), float64
        Radians, of each frame.
    centre : ndarray, (3,), float64
        Of the ball in the mean pose, mm: where the picture has it, as deep as the recording says if that can
        be.
    centre_sigma : ndarray, (3,), float64
        By how much that may be off, mm.
    outline : float
        Radius of the circle in which light is seen, mm.
    pivot : (float, float, float)
        What is known of the pivot, mm.
    """

    name: str
    light: Doubles
    place: Doubles
    frame: NDArray[np.intp]
    lean: Doubles
    centre: Doubles
    centre_sigma: Doubles
    outline: float
    pivot: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Pivot:
    """What the body turns about, mm, and the standard errors of that and of the phases' zero."""

    place: tuple[float, float, float]
    sigma: tuple[float, ...]
    phase_sigma: float


def read_press(
    source: Source,
    ball: float,
    references: References | None,
    precession: Precession | None,
    count: int,
) -> BallPress:
    """Read a recording once, find the ball, and keep some samples of its neighbourhood.

    Parameters
    ----------
    source : Source
        An axial recording; its frames are held while the ball is looked for.
    ball : float
        Radius, mm.
    references : References, optional
        Else those of the source's header.
    precession : Precession, optional
        Else a circle of the header's tilt.
    count : int
        Samples to keep, about.

    Raises
    ------
    InputError
        The recording is of another motion, lacks what is needed, or shows no ball.
    """
    levels, pixel_size = _levels(source, references), _pixel_size(source)
    pivot = pivot_of(source, precession).place
    frames, phase = _read(source)
    lean = _circle(source, phase) if precession is None else precession.lean(phase)
    try:
        found = find_ball(frames, phase, pixel_size, ball)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from None
    centre, sigma = np.array([found.x, found.y, found.depth - ball]), np.full(3, _PLACE)
    outline = math.sqrt(max(ball**2 - centre[2] ** 2, 1e-6))
    press = source.header.press
    if press is not None and abs(press - found.depth) < _PLACE:
        centre[2], sigma[2] = press - ball, _DEPTH
    reach = min(ball * math.sin(_STEEPEST), _BEYOND * outline)
    places = np.stack([axis.ravel() for axis in np.meshgrid(*pixel_axes(frames.shape[1:], pixel_size))])
    chosen = _choose(frames, levels, places, moved(centre, lean, pivot), reach, count)
    total = sum(map(len, chosen))
    if total < _LEAST * len(frames):
        raise InputError(
            f"{source.name}: only {total} samples of the ball have references and are not at the ends of the"
            " camera's range: expose less, or take the references anew"
        )
    dark, bright = (level.ravel() for level in levels)
    light = [
        (frame.ravel()[some] - dark[some]) / (bright[some] - dark[some])
        for frame, some in zip(frames, chosen, strict=True)
    ]
    frame_of = np.repeat(np.arange(len(frames)), [len(some) for some in chosen])
    place = places[:, np.concatenate(chosen)]
    return BallPress(source.name, np.concatenate(light), place, frame_of, lean, centre, sigma, outline, pivot)


def _choose(
    frames: NDArray[Any],
    levels: tuple[Doubles, Doubles],
    places: Doubles,
    middle: Doubles,
    reach: float,
    count: int,
) -> list[NDArray[np.intp]]:
    """Return the numbers of some pixels of each frame about the ball's middle that can be used."""
    span = (levels[1] - levels[0]).ravel()
    usable = np.isfinite(span) & (span > 0)
    clipped = _ends(frames)
    generator = np.random.default_rng(0)  # the same samples in every run
    chosen = []
    for frame, (x, y, _) in zip(frames.reshape(len(frames), -1), middle, strict=True):
        near = usable & ((places[0] - x) ** 2 + (places[1] - y) ** 2 <= reach**2)
        inside = np.flatnonzero(near & np.isfinite(frame) & ~np.isin(frame, clipped))
        some = generator.choice(inside, min(max(1, count // len(frames)), len(inside)), replace=False)
        chosen.append(np.sort(some))
    return chosen


def pivot_of(source: Source, precession: Precession | None) -> Pivot:
    """Return what is known of the pivot: of the calibration, else of the recording, else not much."""
    if precession is not None and np.isfinite(precession.pivot).all():
        sigma = tuple(_error(precession, f"pivot_{axis}", _NEAR) for axis in "xyz")
        return Pivot(precession.pivot, sigma, _error(precession, "phase_offset", _OFFSET))
    offset = _ANY if precession is None else _error(precession, "phase_offset", _OFFSET)
    pivot = source.header.pivot
    if pivot is None:
        return Pivot((0.0, 0.0, 0.0), (_FAR,) * 3, offset)
    return Pivot(pivot, (_NEAR,) * 3, offset)


def _error(precession: Precession, name: str, unknown: float) -> float:
    """Return a standard error that a calibration tells, and not quite to the letter."""
    told = precession.sigma.get(name, math.nan)
    return math.hypot(told, _DOUBT * unknown) if math.isfinite(told) else unknown


def join(presses: Sequence[BallPress], ball: float) -> Samples:
    """Return the samples of all presses."""
    frames = np.array([len(press.lean) for press in presses])
    first = np.cumsum(frames) - frames
    return Samples(
        np.concatenate([press.light for press in presses]),
        np.concatenate([press.place for press in presses], axis=1),
        np.concatenate([press.frame + start for press, start in zip(presses, first, strict=True)]),
        np.repeat(np.arange(len(presses)), frames),
        np.concatenate([press.lean for press in presses]),
        ball,
    )


def _levels(source: Source, references: References | None) -> tuple[Doubles, Doubles]:
    header = source.header
    dark, bright = header.dark, header.bright
    if references is not None:
        dark, bright = references.dark, references.bright
    if dark is None or bright is None:
        raise InputError(
            f"{source.name}: there are no dark and bright references: make them first with"
            " 'mirrorskin calibrate references'"
        )
    if dark.shape != source.shape[1:] or bright.shape != source.shape[1:]:
        raise InputError(
            f"{source.name}: frames of {source.shape[1:]} pixels do not fit references of {dark.shape}:"
            " take both with the same region of the camera"
        )
    return np.asarray(dark, np.float64), np.asarray(bright, np.float64)


def _pixel_size(source: Source) -> tuple[float, float]:
    if source.header.pixel_size is None:
        raise InputError(f"{source.name}: its pixel size is not told: give it, as in --pixel-size 0.03mm")
    return source.header.pixel_size


def _circle(source: Source, phase: Doubles) -> Doubles:
    if source.header.tilt is None:
        raise InputError(f"{source.name}: the tilt of its rotation is not told: give it, as in --tilt 2.5deg")
    return source.header.tilt * np.stack([np.cos(phase), np.sin(phase)], axis=1)


def _read(source: Source) -> tuple[NDArray[Any], Doubles]:
    """Return the frames and their phases; evenly spread ones of a recording of many."""
    if source.motion != "axial":
        raise InputError(f"{source.name}: its motion is {source.motion}: take an axial one of the ball")
    if source.rewindable:
        source.rewind()
    total = source.shape[0]
    wanted = np.unique(np.linspace(0, total - 1, min(total, _FRAMES)).round().astype(np.intp))
    frames, phase = np.empty((len(wanted), *source.shape[1:]), source.dtype), np.zeros(len(wanted))
    room, kept = np.empty((min(total, _FRAMES), *source.shape[1:]), source.dtype), 0
    while (block := source.read(room)) is not None:
        if block.phase is None:
            raise InputError(f"{source.name}: its phases are not told: give --phase-step, as in 45deg")
        for number in range(len(block.frames)):
            if kept < len(wanted) and block.index + number >= wanted[kept]:
                frames[kept], phase[kept] = block.frames[number], block.phase[number]
                kept += 1
    return frames[:kept], phase[:kept]


def _ends(frames: NDArray[Any]) -> NDArray[Any]:
    """Return the counts at which samples may be clipped: 0, and the most that so many bits can tell."""
    if frames.dtype.kind == "f":
        return np.empty(0, frames.dtype)
    most = int(frames.max())
    ends = [0, int(np.iinfo(frames.dtype).max)]
    if most & (most + 1) == 0 and np.count_nonzero(frames == most) >= _CLIPPED:
        ends.append(most)
    return np.array(ends, frames.dtype)


BODY_RADIUS, BODY_HEIGHT = 17.5, 40.0
"""Of the paper's body, mm."""

FEWEST = 5
"""Presses that are needed."""

_SAMPLES = 60_000  # of all presses
_KNOWN = {
    **dict.fromkeys(("axis_x", "axis_y"), (0.0, 1.0)),
    "sight_0": (0.004, 0.004),  # a camera 100 to 200 mm away; 0 is telecentric
    "sight_2": (0.0, 3e-7),
    "scatter": (math.radians(3.0), math.radians(2.0)),
    **dict.fromkeys(("lamp_x", "lamp_y"), (0.0, 0.2)),
    **dict.fromkeys((f"shade_{number}" for number in range(5)), (0.0, 0.02)),
}
"""What is likely of a sensor: means and standard deviations of its parameters."""


def fit_zenith(
    presses: Sequence[Source],
    ball: float,
    *,
    references: References | None = None,
    precession: Precession | None = None,
    pattern: str = "graded",
    body: tuple[float, float] = (BODY_RADIUS, BODY_HEIGHT),
    progress: Callable[[int], None] | None = None,
) -> WallResponse:
    """Learn how bright a mirror looks, from axial recordings of one ball pressed at several places.

    What the wall is like (its radius, rim and axis, the camera's lines of sight, the lamps, the scatter, the
    shading, and the printed pattern as a monotone curve) and where the balls are is fitted to the light of
    some ten thousand samples at once. A sphere looks the same however it is turned: the tilt of the rotation
    hardly matters, only where the ball moves to, and the pivot is fitted too.

    How far the sheet takes the ball's shape is told by the data: from the middle on, rings of samples are
    taken in until one does not fit.

    Parameters
    ----------
    presses : sequence of Source
        At least five, better nine, spread over the field; read one after the other, once.
    ball : float
        Radius of the ball, mm.
    references : References, optional
        Dark and bright; by default each recording's own.
    precession : Precession, optional
        The calibrated rotation; by default the tilt and the pivot that the recordings tell.
    pattern : {"graded", "uniform"}
        Whether the wall's brightness changes with its height.
    body : (float, float)
        Nominal radius of the body and height of the wall, mm: the fit begins with them, and they count as
        known within a tenth.
    progress : callable, optional
        Told the number of presses read so far.

    Returns
    -------
    WallResponse

    Raises
    ------
    InputError
        There are too few presses, one lacks what is needed or shows no ball, or one does not fit to the
        others; the message names it.
    """
    _check(presses, ball, pattern, body)
    read = []
    for number, source in enumerate(presses, 1):
        read.append(read_press(source, ball, references, precession, _SAMPLES // len(presses)))
        if progress:
            progress(number)
    prior = _prior(read, pivot_of(presses[0], precession), pattern, body)
    touch = fit_touch(join(read, ball), read, prior)
    return make_response(touch.fit, touch.samples, touch.noise, pattern, presses[0])


def _prior(
    presses: Sequence[BallPress],
    pivot: Pivot,
    pattern: str,
    body: tuple[float, float],
) -> Prior:
    """Return what is known before."""
    radius, rim = body
    known = dict(_KNOWN, radius=(radius, 0.1 * radius), rim=(rim, 0.1 * rim))
    for axis, *told in zip("xyz", pivot.place, pivot.sigma, strict=True):
        known[f"pivot_{axis}"] = told[0], told[1]
    known["phase_offset"] = (0.0, pivot.phase_sigma)
    mean, sigma = np.array([known[name] for name in SENSOR], np.float64).T
    centres = np.concatenate([press.centre for press in presses])
    steps = np.zeros(CURVE_COEFFICIENTS), np.full(CURVE_COEFFICIENTS, np.inf)
    if pattern == "uniform":
        steps[0][0], steps[1][1:] = 1.0, 0.0
    return Prior(
        np.concatenate([mean, steps[0], centres]),
        np.concatenate([sigma, steps[1], *(press.centre_sigma for press in presses)]),
    )


def _check(presses: Sequence[Source], ball: float, pattern: str, body: tuple[float, float]) -> None:
    """Raise where the call itself cannot be."""
    if len(presses) < FEWEST:
        raise InputError(f"{len(presses)} presses do not determine the wall: take {FEWEST} or more")
    if not (math.isfinite(ball) and ball > 0):
        raise InputError(f"a ball of radius {ball} mm cannot be: give its diameter, as in --ball 4mm")
    if pattern not in PATTERNS:
        raise InputError(f"pattern {pattern!r} is unknown: take {' or '.join(PATTERNS)}")
    if not (min(body) > 0 and max(body) < math.inf):
        raise InputError(f"a body of {body[0]} mm radius and {body[1]} mm height cannot be: give more")
    first = presses[0]
    for source in presses[1:]:
        told = source.shape[1:], source.header.pixel_size
        if told != (first.shape[1:], first.header.pixel_size):
            raise InputError(f"{source.name} and {first.name} differ in pixels or their size: take all alike")
