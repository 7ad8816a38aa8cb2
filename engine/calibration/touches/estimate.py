"""Calibration of a sensor from touches of unknown objects.

Each touch is a press and a turn at one place, or a turn alone. The surfaces are unknown and are
eliminated; see `mirrorskin.engine.calibration.touches.window`. What remains is the information about the
sensor, which is summed over touches, kept with the calibration, and forgotten with a time constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mirrorskin.engine.base.reconstruction import calibrated
from mirrorskin.engine.calibration.touches.fit import Attempt
from mirrorskin.engine.calibration.touches.memory import Earlier
from mirrorskin.engine.calibration.touches.pressed import gel_of
from mirrorskin.engine.calibration.touches.priors import (
    Movement,
    Priors,
    Stated,
    search,
)
from mirrorskin.engine.calibration.touches.reading import TouchReader
from mirrorskin.engine.calibration.touches.result import Estimate, TouchFit, result_of
from mirrorskin.engine.calibration.touches.sensor import SensorModel, model_of, with_levels
from mirrorskin.engine.calibration.touches.view import NOT_FOLLOWED
from mirrorskin.engine.calibration.touches.wall_result import earlier_of, scatter_of
from mirrorskin.engine.calibration.wall import check_body
from mirrorskin.io import (
    Calibrated,
    Calibration,
    Gel,
    Header,
    InputError,
    Source,
)
from mirrorskin.kernels.device import Device


def from_touches(
    touches: Sequence[tuple[Source | None, Source]],
    *,
    calibration: Calibration | None = None,
    stated: Mapping[str, Stated | tuple[float, float]] | None = None,
    forget: float | None = None,
    zenith_gain: float | None = None,
    zenith_offset: float | None = None,
    body: tuple[float, float] | None = None,
    device: str | Device | None = None,
) -> TouchFit:
    """Estimate response and movement of a sensor from touches of unknown objects.

    Each touch is a press and a turn of the same object at the same place, or a turn alone. The heights of
    the object at each pixel are unknown, and so are the gain and the offset of each frame; all are eliminated
    from one least-squares fit. The samples of a turn follow ::

        y = dark + (1 + g_t) (1 + u) R (l / R)^gamma + o_t,    l = offset + gain angle(n, t) - dark

    with gains g and offsets o of the frames, uneven light u, and the angle between the normal n, by the
    slopes of the heights, and the body's axis. The press ties heights to travel, so slopes are absolute.
    A turn alone determines response and movement because slopes of a surface are integrable: three to seven
    times less well on rough objects, and hardly on smooth ones. Its heights have an unknown constant, which
    moves points in the picture in the same way as the pivot's height, so it determines neither that nor the
    pixel size.
    If the calibration has a gel, the presses are corrected for it. An error of its compliance is common to
    all of them: it is estimated, from the standard error that the gel has.
    Under a lit wall, the light is that of `mirrorskin.engine.calibration.fit_zenith`.

    Parameters
    ----------
    touches : sequence of (Source or None, Source)
        Presses, or None, and turns. All turns have one half-angle, and an approximate zenith gain.
    calibration : Calibration, optional
        What is already calibrated. If it has a response of touches, these touches are added to it.
    stated : mapping of str to (float, float), optional
        Numbers with standard deviations, such as of a data sheet: ``gamma``, ``zenith_gain`` (counts/rad),
        ``zenith_offset`` (counts), ``tilt`` (rad), ``phase_offset`` (rad), ``pivot_z`` (mm), ``pixel_size``
        (mm), ``compliance`` (1/mm) of a calibrated gel. The pixel size is estimated only if it is given here:
        it is nearly degenerate with the gain.
    forget : float, optional
        Time constant, seconds, after which the information of a touch about the response counts 1/e; by
        default it is kept. That about the movement, the pivot and the area of a pixel is kept in any case.
    zenith_gain, zenith_offset : float, optional
        Approximate response to start with, counts/rad and counts; by default that of the recordings. Not
        under a wall, and not if touches are added to others.
    body : (float, float), optional
        Nominal radius of the body and height of its lit wall, mm, within 10 %: the response is that of the
        wall, whose print gets brighter from the rim down. Turns have references, and need no zenith gain. A
        calibration with a wall needs no body: these touches are added to what it was made with.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    TouchFit

    Raises
    ------
    mirrorskin.io.InputError
        No touch can be used; a recording has no zenith gain (or references), tilt, pixel size or phases; a
        stated number is unknown, or these touches do not depend on it; ``forget`` is given, but a recording
        has no start time; ``body``, ``zenith_gain`` or ``zenith_offset`` contradicts the calibration, or each
        other.

    Examples
    --------
    >>> from mirrorskin.twin import Axial, Twin, Vertical
    >>> thing = {"object": "sphere", "shape": (48, 48), "pixel_size": 0.1}
    >>> press = Twin(movement=Vertical(0.03 * np.arange(1, 60)), **thing)
    >>> turn = Twin(movement=Axial(np.arange(12) * np.pi / 6, 0.05, 1.5), pattern="linear", **thing)
    >>> fit = from_touches([(press, turn)], stated={"tilt": (0.05, 0.001)})
    >>> abs(fit.precession.tilt - 0.05) < 0.002
    True
    """
    if not touches:
        raise InputError("there are no touches: give turns, with or without presses")
    before, body = _start(calibration, body)
    response = {"zenith_gain": zenith_gain, "zenith_offset": zenith_offset}
    _check_response([name for name, value in response.items() if value is not None], before, body)
    opened = [
        (None if press is None else calibrated(press, calibration), _upright(turn, calibration))
        for press, turn in touches
    ]
    for press, turn in opened:
        _check_same(turn, opened[0][1])
        if press is None and body is not None:
            raise InputError(f"{turn.name} follows no press: under a wall, give the press of each turn")
    sensor, header = _sensor(opened, calibration, body, zenith_gain, zenith_offset)
    precession = None if calibration is None else calibration.precession
    readers = [TouchReader.of(press, turn, device) for press, turn in opened]
    movement = Movement.of(sensor, precession)
    has_press = any(reader.has_press for reader in readers)
    gel = next((gel for gel in map(gel_of, [press for press, _ in opened]) if gel is not None), None)
    priors = Priors.of(header, movement, before is not None, stated or {}, has_press, gel)
    reason = NOT_FOLLOWED
    try:
        attempt = Attempt.of(readers, movement, priors, before, forget).registered()
        if precession is None and attempt.may_be_of_another_movement:
            movement = search(max(readers, key=lambda reader: reader.has_press), movement)
            priors = priors.relative_to(movement)
            other = Attempt.of(readers, movement, priors, before, forget).registered()
            attempt = min(other, attempt, key=lambda each: each.noise)
        if not attempt.used:
            reasons = dict.fromkeys(touch.reason for touch in attempt.read)
            reason = "; ".join(reasons)
        used = attempt.following()
        if used and attempt.is_plausible:
            found = result_of(attempt.exact(used))
            return replace(found, gel=_gel_with(found.estimates, calibration))
    except np.linalg.LinAlgError:  # surfaces that are nowhere near those of the touches
        pass
    raise InputError(f"no touch can be used: {reason}")


def _sensor(
    touches: Sequence[tuple[Source | None, Source]],
    calibration: Calibration | None,
    body: tuple[float, float] | None,
    zenith_gain: float | None,
    zenith_offset: float | None,
) -> tuple[SensorModel, Header]:
    """Return the sensor to start with, and the header that states it."""
    turns = [turn for _, turn in touches]
    header = turns[0].header
    if zenith_gain is not None:
        header = replace(header, zenith_gain=np.asarray(zenith_gain, np.float64))
    if zenith_offset is not None:
        header = replace(header, zenith_offset=np.asarray(zenith_offset, np.float64))
    if body is None:
        header = with_levels(header, turns)
    sensor = model_of(turns[0], header, body)
    if sensor.wall is not None and calibration is not None and calibration.zenith is not None:
        known = calibration.zenith
        wall = sensor.wall._replace(axis=known.axis, sight=known.sight, scatter=scatter_of(known))
        sensor = sensor._replace(wall=wall)
    return sensor, header


def _gel_with(estimates: Sequence[Estimate], calibration: Calibration | None) -> Gel | None:
    """Return the gel with its estimated compliance; None where no other one is needed.

    A modulus is learned with a gel: it keeps that gel.
    """
    found = next((estimate for estimate in estimates if estimate.name == "compliance"), None)
    if found is None or calibration is None or calibration.gel is None or calibration.stiffness is not None:
        return None
    sigma = {**calibration.gel.sigma, "compliance": found.sigma}
    return replace(calibration.gel, compliance=max(0.0, found.value), sigma=sigma)


def _start(
    calibration: Calibration | None, body: tuple[float, float] | None
) -> tuple[Earlier | None, tuple[float, float] | None]:
    """Return what earlier touches have told, and radius and height of a wall."""
    if body is not None:
        check_body(body)
    if calibration is None:
        return None, body
    wall, linear = calibration.zenith, calibration.response
    if linear is not None and body is not None:
        raise InputError(
            f"{calibration.name or 'the calibration'} has a response of touches without a wall: leave the"
            " body out, or name another file"
        )
    if wall is not None and wall.pattern == "graded":
        return earlier_of(wall), body or (wall.radius, wall.rim)
    if linear is None:
        return None, body
    told = linear.information, linear.pull, linear.touches, linear.time
    return Earlier(linear.names, linear.values, *told), body


def _check_response(given: Sequence[str], before: Earlier | None, body: tuple[float, float] | None) -> None:
    """Raise InputError if an approximate response is given that would not be used."""
    if not given or (before is None and body is None):
        return
    names = " and ".join(name.replace("_", " ") for name in given)
    options = " and ".join(f"--{name.replace('_', '-')}" for name in given)
    reason = "touches are added to the response of the calibration"
    if body is not None:
        reason = "the response of a lit wall follows from its geometry and the references"
    raise InputError(f"{names} cannot be given: {reason}. Remove {options}")


def _upright(turn: Source, calibration: Calibration | None) -> Source:
    """Return a turn with its calibration, but with phases on a circle: the ellipse is fitted."""
    source = calibrated(turn, calibration)
    if source.motion != "axial":
        raise InputError(f"{source.name} has {source.motion} motion: give turns, each after its press")
    if isinstance(source, Calibrated) and source.whole.precession is not None:
        circle = replace(source.whole.precession, ellipticity=0.0)
        return Calibrated(source.source, replace(source.whole, precession=circle))
    return source


def _check_same(turn: Source, first: Source) -> None:
    """Raise InputError unless two turns are of one sensor and one movement."""
    if turn.shape[1:] != first.shape[1:] or turn.dtype != first.dtype:
        raise InputError(f"{turn.name} and {first.name} are of different cameras or regions")
    for name in ("tilt", "pixel_size", "zenith_gain", "zenith_offset"):
        one, other = (getattr(source.header, name) for source in (turn, first))
        if (one is None) != (other is None) or (one is not None and not np.allclose(one, other)):
            raise InputError(
                f"{turn.name} and {first.name} state different values of {name.replace('_', ' ')}: give one"
                " for all"
            )
