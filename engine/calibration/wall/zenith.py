"""Brightness as a function of the normal and the place, learned from presses of a ball of known size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mirrorskin.engine.calibration.wall import curve
from mirrorskin.engine.calibration.wall.fit import Prior
from mirrorskin.engine.calibration.wall.model import SENSOR
from mirrorskin.engine.calibration.wall.response import make_response
from mirrorskin.engine.calibration.wall.samples import BallPress, Pivot, join, pivot_of, read_press
from mirrorskin.engine.calibration.wall.touch import fit_touch
from mirrorskin.io import InputError, Precession, References, Source, WallResponse
from mirrorskin.io.calibration.types import PATTERNS

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
    steps = np.zeros(curve.COEFFICIENTS), np.full(curve.COEFFICIENTS, np.inf)
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
