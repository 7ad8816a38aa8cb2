"""Calibration of a sensor from touches of unknown objects.

Each touch is a press and a turn at one place. The surfaces are unknown and are
eliminated; see `mirrorskin.engine.calibration.touch_window`. What remains is the information about the
sensor, which is summed over touches, kept with the calibration, and forgotten with a time constant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from mirrorskin.engine.base.reconstruction import calibrated
from mirrorskin.engine.calibration.touch_window import (
    FOOTPRINT,
    NOT_FOLLOWED,
    SHARED,
    TURNS,
    SensorModel,
    Touch,
    TouchReader,
    Window,
    model_of,
)
from mirrorskin.engine.diagnosis.turn_light import GLOBALS, UNEVEN, uneven_terms
from mirrorskin.engine.diagnosis.turn_nuisances import picture_axes
from mirrorskin.engine.press.intervals import estimate_interval_scatter
from mirrorskin.io import (
    Calibrated,
    Calibration,
    Header,
    InputError,
    LinearResponse,
    Precession,
    Source,
)
from mirrorskin.io.base.types import PROPERTIES
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

_ITERATIONS = 10  # Gauss-Newton steps, at most
_SETTLED = 0.1  # largest last step, in standard errors
_NEARLY_SETTLED = 0.5  # the same, of a fit that is repeated
_ROUGHLY = 2  # steps before outliers are excluded; in an exact fit, heights then stay as they are
_CONTRADICTION = 3.0  # standard deviations between a prior and the touches
_WELL_SHOWN = 0.008  # relative standard error of gain and half-angle by a touch, up to which noise prevails
_CLEAR = 4.0  # standard deviations of the contradiction of touches by chance, from which on it is a note
_NEGLIGIBLE = 1e-6  # standard deviation of a parameter that is not estimated
_MOVED = 0.02  # pixels that points move by an error of the pivot, from which frames are registered again
_UNKNOWN = {
    "gamma": 0.2,
    "zenith_gain": 0.1,
    "zenith_offset": 10.0,
    "tilt": 0.15,
    "phase": 0.3,
    "uneven": 0.05,
    "oval": 0.03,
    "footprint": 2.0,
    "pivot_z": 10.0,
}  # standard deviations of parameters about which nothing is stated; counts of 8 bits, radians, mm
_LOOSER = 10.0  # of the standard deviation of a number that is estimated only if it is stated
_KNOWN_PIVOT = 1.0  # mm: standard deviation of a recorded pivot
_WITHOUT = 1e4  # factor of the standard deviation of a prior that is left out
_REGISTRATIONS = 5  # largest number of registrations with an estimated movement
_SEARCHED = 8  # phases that are tried if frames do not follow the movement
_OTHER_TILT = (
    0.05  # relative difference of the amplitude of the brightness from which the tilt starts with it
)
_IMPLAUSIBLE = 5.0  # standard deviations of what is usual: a fit that is so far off is of another movement
_OTHER_PHASE = 0.2  # radians: difference of phases from which one was searched for
_REMEDIES = {
    "gamma": "touch something whose slopes range from flat to steep, such as a ball",
    "zenith_gain": "press and turn on something rough",
    "zenith_offset": "press and turn on something rough",
    "tilt": "press and turn on something rough, or tilt more",
    "phase": "turn on something with slopes in all directions",
    "uneven": "touch at places all over the field",
    "oval": "press and turn on something rough, in more frames",
    "pivot_z": "press and turn on something with relief",
    "pixel_size": "calibrate the scale",
}
_NEEDED = {"oval": 0.01, "pivot_z": 1.0, "pixel_size": 0.003}  # standard errors of a determined parameter


class Stated(NamedTuple):
    """A number that is stated of the sensor, such as in a data sheet, and its standard deviation."""

    value: float
    sigma: float


class Estimate(NamedTuple):
    """An estimated parameter."""

    name: str
    value: float
    sigma: float  # with priors
    of_touches: float  # standard error without its own prior
    unit: str
    determined: bool


@dataclass(frozen=True, slots=True, eq=False)
class TouchFit:
    """A calibration from touches.

    Attributes
    ----------
    response : LinearResponse
    precession : Precession
    estimates : tuple of Estimate
        All parameters, in the units of files.
    frame_gains : mapping of str to ndarray
        Gain of each frame relative to their mean, by the names of the turns.
    notes : tuple of str
        Sentences: what is not determined, and stated numbers that the touches contradict.
    """

    response: LinearResponse
    precession: Precession
    estimates: tuple[Estimate, ...]
    frame_gains: Mapping[str, Doubles]
    notes: tuple[str, ...]


def from_touches(
    touches: Sequence[tuple[Source, Source]],
    *,
    calibration: Calibration | None = None,
    stated: Mapping[str, Stated | tuple[float, float]] | None = None,
    forget: float | None = None,
    zenith_gain: float | None = None,
    zenith_offset: float | None = None,
    device: str | Device | None = None,
) -> TouchFit:
    """Estimate response and movement of a sensor from touches of unknown objects.

    Each touch is a press and a turn of the same object at the same place. The heights of the
    object at each pixel are unknown, and so are the gain and the offset of each frame; all are eliminated
    from one least-squares fit. The samples of a turn follow ::

        y = dark + (1 + g_t) (1 + u) R (l / R)^gamma + o_t,    l = offset + gain angle(n, t) - dark

    with gains g and offsets o of the frames, uneven light u, and the angle between the normal n, by the
    slopes of the heights, and the body's axis. The press ties heights to travel, so slopes are absolute.

    Parameters
    ----------
    touches : sequence of (Source, Source)
        Presses and turns. All turns have one half-angle, and an approximate zenith gain.
    calibration : Calibration, optional
        What is already calibrated. If it has a response of touches, these touches are added to it.
    stated : mapping of str to (float, float), optional
        Numbers with standard deviations, such as of a data sheet: ``gamma``, ``zenith_gain`` (counts/rad),
        ``zenith_offset`` (counts), ``tilt`` (rad), ``phase_offset`` (rad), ``pivot_z`` (mm), ``pixel_size``
        (mm). The pixel size is estimated only if it is given here: it is nearly degenerate with the gain.
    forget : float, optional
        Time constant, seconds, after which the information of a touch counts 1/e; by default it is kept.
    zenith_gain, zenith_offset : float, optional
        Approximate response to start with, counts/rad and counts; by default that of the recordings.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    TouchFit

    Raises
    ------
    mirrorskin.io.InputError
        No touch can be used; a recording has no zenith gain, tilt, pixel size or phases; a stated number is
        unknown; ``forget`` is given, but a recording has no start time.

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
        raise InputError("there are no touches: give presses and turns")
    before = None if calibration is None else calibration.response
    opened = [(calibrated(press, calibration), _upright(turn, calibration)) for press, turn in touches]
    for _, turn in opened:
        _check_same(turn, opened[0][1])
    precession = None if calibration is None else calibration.precession
    header = opened[0][1].header
    if zenith_gain is not None:
        header = replace(header, zenith_gain=np.asarray(zenith_gain, np.float64))
    if zenith_offset is not None:
        header = replace(header, zenith_offset=np.asarray(zenith_offset, np.float64))
    sensor = model_of(opened[0][1], header)
    readers = [TouchReader.of(press, turn, device) for press, turn in opened]
    movement = _Movement.of(sensor, precession)
    priors = _Priors.of(header, movement, before is not None, stated or {})
    reason = NOT_FOLLOWED
    try:
        attempt = _Attempt.of(readers, movement, priors, before, forget).registered()
        if precession is None and attempt.may_be_of_another_movement:
            movement = _search(readers[0], movement)
            priors = priors.relative_to(movement)
            attempt = _Attempt.of(readers, movement, priors, before, forget).registered()
        if not attempt.used:
            reason = attempt.read[0].reason
        used = attempt.following()
        if used and attempt.is_plausible:
            return _result(attempt.exact(used))
    except np.linalg.LinAlgError:  # surfaces that are nowhere near those of the touches
        pass
    raise InputError(f"no touch can be used: {reason}")


def _upright(turn: Source, calibration: Calibration | None) -> Source:
    """Return a turn with its calibration, but with phases on a circle: the ellipse is fitted."""
    source = calibrated(turn, calibration)
    if source.motion != "axial":
        raise InputError(f"{source.name} has {source.motion} motion: give presses and turns, in pairs")
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


# --- the movement and priors --------------------------------------------------------------------------------


class _Movement(NamedTuple):
    """The sensor and its movement as they are assumed in a fit: phases of files times sense plus ahead."""

    sensor: SensorModel
    before: Precession | None  # applied to the phases already
    sense: int
    ahead: float

    @classmethod
    def of(cls, sensor: SensorModel, precession: Precession | None) -> _Movement:
        """Return the movement that a recording and a calibration state."""
        return cls(sensor, precession, 1, 0.0)

    @property
    def direction(self) -> int:
        """Sense of rotation."""
        return self.sense * (1 if self.before is None else self.before.direction)

    @property
    def phase_offset(self) -> float:
        """Azimuth of the lean at phase zero, radians."""
        offset = 0.0 if self.before is None else self.before.phase_offset
        return self.sense * offset + self.ahead

    def read(self, reader: TouchReader) -> Touch:
        """Read a touch with this movement."""
        return reader.read(self.sensor, self.sense, self.ahead)

    def changed(self, values: Mapping[str, float]) -> _Movement:
        """Return the movement with estimated tilt, phase and pivot."""
        sensor = self.sensor
        pivot = sensor.pivot
        if pivot is not None:
            pivot = (pivot[0], pivot[1], pivot[2] + values["pivot_z"])
        sensor = sensor._replace(tilt=sensor.tilt * (1 + values["tilt"]), pivot=pivot)
        return self._replace(sensor=sensor, ahead=math.remainder(self.ahead + values["phase"], math.tau))


def _search(reader: TouchReader, movement: _Movement) -> _Movement:
    """Return the movement whose sense and phase zero give slopes that fit a surface best."""
    best = math.inf, movement
    for sense in (1, -1):
        for ahead in np.linspace(-math.pi, math.pi, _SEARCHED, endpoint=False):
            tried = movement._replace(sense=sense, ahead=float(ahead))
            touch = tried.read(reader)
            pixels = sum(int(np.count_nonzero(window.usable)) for window in touch.windows)
            turn = int(np.argmin(touch.misfits[0]))
            if pixels:
                found = tried._replace(ahead=math.remainder(float(ahead + TURNS[turn]), math.tau))
                best = min(best, (float(touch.misfits[0, turn]) / pixels**2, found), key=lambda each: each[0])
    return best[1]


@dataclass(frozen=True, slots=True)
class _Priors:
    """Priors of the numbers of a sensor, and how they follow from the parameters of a fit."""

    number: Doubles
    error: Doubles
    loose: Doubles  # error of a number about which nothing is stated
    stated: tuple[bool, ...]
    reference: Doubles  # number at a parameter of 0
    scale: Doubles  # change of the number by the parameter

    @classmethod
    def of(
        cls,
        header: Header,
        movement: _Movement,
        of_touches: bool,
        given: Mapping[str, Stated | tuple[float, float]],
    ) -> _Priors:
        """Return the priors from a recording with its calibration, and from numbers that are given."""
        sensor = movement.sensor
        count = max(1.0, float(np.nanmedian(np.abs(sensor.gain))) / 1000)  # a count of 8 bits
        size = min(header.pixel_size or (1.0,))
        gain, base = float(np.nanmedian(sensor.gain)), float(np.nanmedian(sensor.base))
        numbers = {
            "gamma": (1.0, 1.0),
            "zenith_gain": (gain, gain),
            "zenith_offset": (base, 1.0),
            "footprint": (FOOTPRINT, FOOTPRINT),
            "pixel_size": (size, -size),
        }
        reference, scale = np.zeros(len(SHARED)), np.ones(len(SHARED))
        error = np.full(len(SHARED), _NEGLIGIBLE)
        for at, name in enumerate(SHARED):
            reference[at], scale[at] = numbers.get(name, (0.0, 1.0))
            error[at] = _UNKNOWN.get(name, _UNKNOWN.get(name.partition("_")[0], _NEGLIGIBLE))
        scale[SHARED.index("tilt")] = sensor.tilt
        error[SHARED.index("lag")] = header.prior("lag_sigma")
        error[SHARED.index("zenith_offset")] *= count
        if header.pivot is not None:
            error[SHARED.index("pivot_z")] = _KNOWN_PIVOT
        if sensor.pivot is None:
            error[SHARED.index("pivot_z")] = _NEGLIGIBLE
        error *= np.abs(scale)
        number = reference.copy()
        number[SHARED.index("gamma")] = header.prior("gamma")
        free = (False,) * len(SHARED)
        priors = cls(number, error.copy(), error, free, reference, scale).relative_to(movement)
        for name in ("tilt", "phase", "pivot_z"):
            priors.number[SHARED.index(name)] = priors.reference[SHARED.index(name)]
        stated: dict[str, Stated] = {}
        if not of_touches:  # what touches have found is no prior of more touches, but their memory
            stated |= _stated_by(header, movement.before, priors)
        can_be_stated = ("gamma", "zenith_gain", "zenith_offset", "tilt", "phase", "pivot_z", "pixel_size")
        for name, value in given.items():
            title = next((title for title, shown in _TITLES.items() if shown == name), name)
            if title not in can_be_stated:
                names = ", ".join(_TITLES.get(each, each) for each in can_be_stated)
                raise InputError(f"{name} cannot be stated: give one of {names}")
            stated[title] = Stated(*value)
        return priors.stating(stated)

    @property
    def mean(self) -> Doubles:
        """Means of the parameters."""
        return np.asarray((self.number - self.reference) / self.scale)

    @property
    def sigma(self) -> Doubles:
        """Standard deviations of the parameters."""
        return np.asarray(np.maximum(np.abs(self.error / self.scale), _NEGLIGIBLE / 10))

    def number_of(self, name: str, value: float) -> float:
        """Return the number of the sensor for the value of a parameter."""
        at = SHARED.index(name)
        return float(self.reference[at] + self.scale[at] * value)

    def is_free(self, at: int) -> bool:
        """Return whether a parameter is estimated."""
        return bool(self.loose[at] > 2 * _NEGLIGIBLE * abs(self.scale[at]))

    def relative_to(self, movement: _Movement) -> _Priors:
        """Return the same priors for parameters that are relative to a movement."""
        reference, scale, number = self.reference.copy(), self.scale.copy(), self.number.copy()
        reference[SHARED.index("tilt")] = scale[SHARED.index("tilt")] = movement.sensor.tilt
        at = SHARED.index("phase")
        reference[at] = movement.phase_offset
        if abs(math.remainder(reference[at] - number[at], math.tau)) > _OTHER_PHASE and not self.stated[at]:
            number[at] = reference[at]  # it was searched for
        number[at] = reference[at] + math.remainder(number[at] - reference[at], math.tau)
        if movement.sensor.pivot is not None:
            reference[SHARED.index("pivot_z")] = movement.sensor.pivot[2]
        return replace(self, reference=reference, scale=scale, number=number)

    def stating(self, numbers: Mapping[str, Stated]) -> _Priors:
        """Return the priors with numbers of the sensor that are stated."""
        number, error, loose = self.number.copy(), self.error.copy(), self.loose.copy()
        is_stated = list(self.stated)
        for name, (value, sigma) in numbers.items():
            if not (math.isfinite(value) and 0 < sigma < math.inf):
                raise InputError(f"{name} {value} ± {sigma}: give a number and a standard deviation above 0")
            at = SHARED.index(name)
            if not self.is_free(at):
                loose[at] = _LOOSER * sigma
            number[at], error[at], is_stated[at] = value, sigma, True
        return replace(self, number=number, error=error, loose=loose, stated=tuple(is_stated))

    def start(self, before: LinearResponse | None, precession: Precession | None) -> Doubles:
        """Return parameters to start with."""
        start = np.zeros(len(SHARED))
        start[SHARED.index("gamma")] = self.mean[SHARED.index("gamma")]
        if before is not None:
            named = dict(zip(before.names, before.values.tolist(), strict=True))
            start = np.array([named.get(name, value) for name, value in zip(SHARED, start, strict=True)])
        elif precession is not None:
            turned = 2 * precession.major_axis
            for name, part in (("oval_x", math.cos(turned)), ("oval_y", math.sin(turned))):
                start[SHARED.index(name)] = precession.ellipticity * part
        return start

    def without(self, at: int) -> _Priors:
        """Return the priors without what is stated of a parameter."""
        error, is_stated = self.error.copy(), list(self.stated)
        error[at], is_stated[at] = self.loose[at], False
        return replace(self, error=error, stated=tuple(is_stated))


def _stated_by(header: Header, precession: Precession | None, priors: _Priors) -> dict[str, Stated]:
    """Return the numbers that a recording and a calibration state with standard deviations."""
    stated = {}
    for name in GLOBALS:
        sigma = getattr(header, f"{name}_sigma")
        if sigma and name != "lag":
            size = abs(priors.scale[SHARED.index(name)])
            stated[name] = Stated(float(priors.number[SHARED.index(name)]), sigma * size)
    if precession is not None:
        numbers = {
            "tilt": precession.tilt,
            "phase": precession.phase_offset,
            "pivot_z": precession.pivot[2],
        }
        for name, value in numbers.items():
            sigma = precession.sigma.get(_TITLES.get(name, name), 0.0)
            if sigma > 0 and math.isfinite(sigma) and math.isfinite(value):
                stated[name] = Stated(value, sigma)
    return stated


# --- the fit ------------------------------------------------------------------------------------------------


class _Memory(NamedTuple):
    """Information of earlier touches, and the weight of each of the new ones."""

    matrix: Doubles
    vector: Doubles  # matrix times the parameters that earlier touches alone would have
    weights: tuple[float, ...]
    time: float

    @classmethod
    def of(cls, before: LinearResponse | None, touches: Sequence[Touch], forget: float | None) -> _Memory:
        times = [touch.time for touch in touches] + ([] if before is None else [before.time])
        last = max((time for time in times if math.isfinite(time)), default=math.nan)
        weights = [1.0] * len(times)
        if forget is not None:
            if not forget > 0:
                raise InputError(f"forget {forget} s: give a time above 0")
            if not np.isfinite(times).all():
                raise InputError(
                    "old touches can only be forgotten if recordings have a start time: leave forget out"
                )
            weights = [math.exp((time - last) / forget) for time in times]
        matrix, vector = np.zeros((len(SHARED),) * 2), np.zeros(len(SHARED))
        if before is not None:
            at = np.array([SHARED.index(name) for name in before.names if name in SHARED])
            of = np.array([number for number, name in enumerate(before.names) if name in SHARED])
            matrix[np.ix_(at, at)] = weights[-1] * before.information[np.ix_(of, of)]
            vector[at] = weights[-1] * before.pull[of]
            vector += matrix[:, at] @ before.values[of]
        return cls(matrix, vector, tuple(weights[: len(touches)]), last)

    def moved(self, by: Doubles) -> _Memory:
        """Return the information about parameters that are smaller by some values."""
        return self._replace(vector=self.vector - self.matrix @ by)


@dataclass(frozen=True, slots=True)
class _Attempt:
    """A fit of all touches with frames that are registered with an assumed movement."""

    readers: Sequence[TouchReader]
    movement: _Movement
    priors: _Priors
    before: LinearResponse | None
    forget: float | None
    read: list[Touch]
    used: list[Touch]
    memory: _Memory
    fit: _Fitted
    dropped: list[_Dropped]
    moved: Doubles  # changes of the parameters that are in the movement

    @classmethod
    def of(
        cls,
        readers: Sequence[TouchReader],
        movement: _Movement,
        priors: _Priors,
        before: LinearResponse | None,
        forget: float | None,
        start: Doubles | None = None,
        moved: Doubles | None = None,
    ) -> _Attempt:
        """Read all touches, and fit the sensor to them."""
        read = [movement.read(reader) for reader in readers]
        if start is None:
            seen = float(np.median([touch.tilt_seen for touch in read])) / movement.sensor.tilt
            if abs(seen - 1) > _OTHER_TILT:
                movement = movement.changed({"tilt": seen - 1, "phase": 0.0, "pivot_z": 0.0})
                priors = priors.relative_to(movement)
                read = [movement.read(reader) for reader in readers]
        used = [touch for touch in read if touch.varied]
        if start is None:
            start = priors.start(before, movement.before)
        if moved is None:
            moved = np.zeros(len(SHARED))
        memory = _Memory.of(before, used, forget).moved(moved)
        fit, dropped = _fit_with_priors(used, start, priors, memory, exact=False)
        return cls(readers, movement, priors, before, forget, read, used, memory, fit, dropped, moved)

    def following(self) -> list[Touch]:
        """Return the touches whose samples follow the model."""
        return [touch for touch in self.used if touch.follows()]

    @property
    def may_be_of_another_movement(self) -> bool:
        """Whether touches that show a surface do not fit it."""
        fits = self.following() and self.is_plausible
        return not fits and any(touch.varied or not touch.windows for touch in self.read)

    @property
    def is_plausible(self) -> bool:
        """Whether the parameters are those of a sensor, and not of another movement."""
        priors = self.priors
        away = (self.fit.values - priors.mean) * priors.scale / np.maximum(priors.loose, 1e-12)
        names = ("gamma", "zenith_gain", "zenith_offset", "tilt", *SHARED[len(GLOBALS) :][:UNEVEN])
        return float(np.sum(away[[SHARED.index(name) for name in names]] ** 2)) < _IMPLAUSIBLE**2

    def exact(self, used: list[Touch]) -> _Attempt:
        """Return the exact fit of some of the touches."""
        memory = _Memory.of(self.before, used, self.forget).moved(self.moved)
        fit, dropped = _fit_with_priors(used, self.fit.values, self.priors, memory, exact=True)
        return replace(self, used=used, memory=memory, fit=fit, dropped=dropped)

    def registered(self) -> _Attempt:
        """Return the fit of frames that are registered with the estimated movement."""
        attempt = self
        for _ in range(_REGISTRATIONS):
            if attempt._misplaced < _MOVED or not all(reader.turn.rewindable for reader in self.readers):
                break
            attempt = attempt._again()
        return attempt

    @property
    def _misplaced(self) -> float:
        """Pixels by which points are registered wrongly, about."""
        sensor, values = self.movement.sensor, self.values
        if sensor.pivot is None or not self.used:
            return 0.0
        poses, size = self.used[0].poses, self.used[0].windows[0].pixel_size
        arm = abs(poses.arm or 0.0)
        heights = max(window.misplaced for touch in self.used for window in touch.windows)
        errors = arm * values["tilt"], arm * values["phase"], values["pivot_z"], heights
        return sensor.tilt * max(abs(error) for error in errors) / min(size)

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name."""
        return dict(zip(SHARED, self.fit.values.tolist(), strict=True))

    def _again(self) -> _Attempt:
        movement = self.movement.changed(self.values)
        start, moved = self.fit.values.copy(), self.moved.copy()
        at = [SHARED.index(name) for name in ("tilt", "phase", "pivot_z")]
        moved[at] += start[at]
        start[at] = 0.0
        pairs = zip(self.readers, self.read, strict=True)
        readers = [reader.with_heights(touch) for reader, touch in pairs]
        priors = self.priors.relative_to(movement)
        return _Attempt.of(readers, movement, priors, self.before, self.forget, start, moved)


class _Dropped(NamedTuple):
    """A stated number that the touches contradict."""

    at: int
    number: float
    error: float


class _Fitted(NamedTuple):
    values: Doubles
    matrix: Doubles  # information of all touches
    vector: Doubles  # matrix times the parameters that the touches alone would have
    covariance: Doubles
    contradiction: float  # of touches with each other, over what noise explains
    degrees: float  # of freedom of the contradiction

    @property
    def contradicts(self) -> bool:
        """Whether the touches contradict each other by more than chance."""
        return self.contradiction > 1 + _CLEAR * math.sqrt(2 / max(self.degrees, 1e-9))


def _fit_with_priors(
    touches: Sequence[Touch], start: Doubles, priors: _Priors, memory: _Memory, exact: bool
) -> tuple[_Fitted, list[_Dropped]]:
    """Return the fit without the stated numbers that the touches contradict, and these."""
    dropped: list[_Dropped] = []
    fit = _fit(touches, start, priors, memory, exact)
    while True:
        contradictions = []
        for number in np.flatnonzero(priors.stated):
            value, error = _without_prior(fit, priors, int(number))
            away = abs(value - priors.mean[number]) / math.hypot(error, priors.sigma[number])
            contradictions.append((away, int(number)))
        worst = max(contradictions, default=(0.0, 0))
        if worst[0] < _CONTRADICTION:
            break
        dropped.append(_Dropped(worst[1], float(priors.number[worst[1]]), float(priors.error[worst[1]])))
        priors = priors.without(worst[1])
        fit = _fit(touches, fit.values, priors, memory, exact)
    return fit, dropped


def _without_prior(fit: _Fitted, priors: _Priors, number: int) -> tuple[float, float]:
    """Return a parameter and its standard error by touches and the priors of the other parameters."""
    sigma = priors.sigma.copy()
    sigma[number] *= _WITHOUT
    precision = np.diag(sigma**-2.0)
    covariance = np.linalg.inv(fit.matrix + precision)
    return float(covariance[number] @ (fit.vector + precision @ priors.mean)), float(
        np.sqrt(covariance[number, number])
    )


def _fit(touches: Sequence[Touch], start: Doubles, priors: _Priors, memory: _Memory, exact: bool) -> _Fitted:
    """Return the Gauss-Newton fit of surfaces, frames and parameters.

    Pixels that do not follow the model are excluded on the way. An ``exact`` fit, which starts with surfaces
    near the true ones, takes heights of presses from their intervals.
    """
    values, precision = start.copy(), np.diag(priors.sigma**-2.0)
    roughly = 0 if not exact and all(touch.is_warm for touch in touches) else _ROUGHLY
    for number in range(_ITERATIONS):
        informations, pushes, steps = [], [], []
        for touch, weight in zip(touches, memory.weights, strict=False):
            information, push, step = _eliminate(touch, values, number == roughly, exact and number < roughly)
            weight = weight * _trust(information, priors)
            informations.append(weight * information)
            pushes.append(weight * push)
            steps.append(step)
        pulls = [each @ values + push for each, push in zip(informations, pushes, strict=True)]
        matrix = memory.matrix + np.sum(informations, axis=0)
        vector = memory.vector + np.sum(pulls, axis=0)
        covariance = np.linalg.inv(matrix + precision)
        step = covariance @ (vector + precision @ priors.mean) - values
        for of_touch in steps:
            of_touch(step)
        values = values + step
        settled = _SETTLED if exact else _NEARLY_SETTLED
        if number >= roughly and np.all(np.abs(step) < settled * np.sqrt(np.diag(covariance))):
            break
    pushes = [push - each @ step for push, each in zip(pushes, informations, strict=True)]
    contradiction, degrees = _contradiction_of(informations, pushes, covariance, precision)
    if exact and contradiction > 1:
        matrix, vector = (
            earlier + (each - earlier) / contradiction
            for earlier, each in ((memory.matrix, matrix), (memory.vector, vector))
        )
        covariance = np.linalg.inv(matrix + precision)
        values = covariance @ (vector + precision @ priors.mean)
    return _Fitted(values, matrix, vector, (covariance + covariance.T) / 2, contradiction, degrees)


def _contradiction_of(
    informations: Sequence[Doubles], pushes: Sequence[Doubles], covariance: Doubles, precision: Doubles
) -> tuple[float, float]:
    """Return by how much touches contradict each other, over what noise explains, and degrees of freedom.

    A touch with the information I pushes the parameters of the fit, whose covariance is C, by g. By noise
    alone the covariance of g is I - I C I. With the priors' precision P the contradiction is ::

        sum of g^T (I + P)^-1 g  /  sum of trace((I + P)^-1 (I - I C I))
    """
    squares = degrees = 0.0
    for information, push in zip(informations, pushes, strict=True):
        alone = np.linalg.inv(information + precision)
        squares += float(push @ alone @ push)
        degrees += float(np.trace(alone @ (information - information @ covariance @ information)))
    return (squares / degrees, degrees) if len(pushes) > 1 and degrees > 0 else (1.0, 0.0)


def _trust(information: Doubles, priors: _Priors) -> float:
    """Return the weight of a touch: 1 if it alone shows the gain and the half-angle well.

    An error of the model of a tenth of a count changes the parameters by their variance times its slope by
    them: the less a touch shows, the more the error exceeds the noise.
    """
    at = [SHARED.index("zenith_gain"), SHARED.index("tilt")]
    sigma = priors.sigma.copy()
    sigma[at] *= _WITHOUT
    covariance = np.linalg.inv(information + np.diag(sigma**-2.0))
    alone = math.sqrt(float(np.max(np.diag(covariance)[at])))
    return min(1.0, (_WELL_SHOWN / alone) ** 4)


def _eliminate(
    touch: Touch, values: Doubles, excludes: bool, uses_intervals: bool
) -> tuple[Doubles, Doubles, Any]:
    """Return a touch's information about the sensor, its push, and what a step of the sensor does to it."""
    frames = len(touch.phase)

    def look() -> list[Any]:
        gains, offsets = np.split(touch.frame_values, 2)
        return [window.look(touch.poses, gains, offsets, values) for window in touch.windows]

    sums = look()
    if excludes:
        for window in touch.windows:
            window.exclude_outliers()
        sums = look()
    # Neighbours of registered frames share their noise, so that of a sample is larger than the residuals.
    usual = float(np.mean([window.noise_gain**2 for window in touch.windows]))
    touch.noise = max(_noise_of(touch.windows, frames) / usual, touch.least_noise**2)
    if uses_intervals:
        _use_intervals(touch)
    parts = [window.eliminate(each, touch.noise) for window, each in zip(touch.windows, sums, strict=True)]
    own = np.sum([part.own for part in parts], axis=0)
    pull = np.sum([part.pull for part in parts], axis=0)
    of_frames, of_sensor = slice(0, 2 * frames), slice(2 * frames, None)
    stiff = np.linalg.inv(touch.frame_covariance)
    right = np.column_stack([own[of_frames, of_sensor], pull[of_frames] - stiff @ touch.frame_values])
    solved = np.linalg.solve(own[of_frames, of_frames] + stiff, right)
    reduced = own[of_sensor, of_frames] @ solved

    def step(of_parameters: Doubles) -> None:
        change = solved[:, -1] - solved[:, :-1] @ of_parameters
        touch.frame_values = touch.frame_values + change
        for window, part in zip(touch.windows, parts, strict=True):
            window.z = window.z + part.step(np.concatenate([change, of_parameters]))

    return own[of_sensor, of_sensor] - reduced[:, :-1], pull[of_sensor] - reduced[:, -1], step


def _noise_of(windows: Sequence[Window], frames: int) -> float:
    """Return the variance of residuals, by their median, as pixels of a wrong surface are no noise."""
    squares = np.concatenate([np.sum(window.left**2, axis=0) for window in windows])
    freedom = max(frames - 1 - 2 * frames / max(len(squares), 1), 1.0)
    return float(np.median(squares)) / (freedom * (1 - 2 / (9 * freedom)) ** 3)  # Wilson and Hilferty


def _use_intervals(touch: Touch) -> None:
    """Take the heights of a press from their intervals around the present surfaces."""
    known = [np.isfinite(window.middle) for window in touch.windows]
    if not any(part.any() for part in known):
        return
    pairs = list(zip(touch.windows, known, strict=True))
    error = np.concatenate([window.middle[part] - window.z[part] for window, part in pairs])
    half = np.concatenate([window.half[part] for window, part in pairs])
    spread = estimate_interval_scatter(error, half)
    for window, part in pairs:
        if part.any():
            window.use_intervals(spread)


# --- the result ---------------------------------------------------------------------------------------------


def _result(attempt: _Attempt) -> TouchFit:
    """Return the parts of a calibration, and notes."""
    fit, priors, sensor, used = attempt.fit, attempt.priors, attempt.movement.sensor, attempt.used
    before = attempt.before
    values, errors = dict(zip(SHARED, fit.values.tolist(), strict=True)), np.sqrt(np.diag(fit.covariance))
    sigma = dict(zip(SHARED, errors.tolist(), strict=True))
    x, y = np.meshgrid(*picture_axes((sensor.gain.shape[0], sensor.gain.shape[1])))
    uneven = sum(
        factor * term
        for factor, term in zip(fit.values[len(GLOBALS) :][:UNEVEN], uneven_terms(x, y), strict=True)
    )
    gain = sensor.gain * (1 + values["zenith_gain"]) * (1 + uneven)
    offset = sensor.dark + (1 + uneven) * (sensor.base + values["zenith_offset"] - sensor.dark)
    kept = fit.values.copy()  # others are in the numbers of the calibration from now on
    kept[[number for number, name in enumerate(SHARED) if _is_absorbed(name)]] = 0.0
    scale = abs(float(np.nanmedian(sensor.gain)))
    response = LinearResponse(
        gain=gain.astype(np.float32),
        offset=offset.astype(np.float32),
        gamma=1 + values["gamma"],
        sigma={
            "gain": sigma["zenith_gain"] * scale,
            "offset": sigma["zenith_offset"],
            "gamma": sigma["gamma"],
        },
        names=SHARED,
        values=kept,
        information=(fit.matrix + fit.matrix.T) / 2,
        pull=fit.vector - fit.matrix @ fit.values,
        touches=len(used) + (0 if before is None else before.touches),
        time=attempt.memory.time,
    )
    estimates, notes = [], []
    for number, name in enumerate(SHARED):
        if not priors.is_free(number) or name in ("lag", "footprint"):
            continue
        _, error = _without_prior(fit, priors, number)
        needed = _needed(name, priors)
        determined = bool(error <= needed)
        unit = _UNITS.get(name, "")
        size = abs(float(priors.scale[number]))
        estimates.append(
            Estimate(_TITLES.get(name, name), priors.number_of(name, values[name]), sigma[name] * size,
                     error * size, unit, determined)
        )  # fmt: skip
    notes += [_contradiction(each, priors, fit) for each in attempt.dropped]
    if fit.contradicts:
        notes.append(
            f"the touches contradict each other by {math.sqrt(fit.contradiction):.2g} times their errors,"
            " which the standard errors include: was a frame lost, did an object slip, is the travel exact,"
            " and is the lens in focus?"
        )
    notes += _undetermined(estimates)
    notes += [f"{touch.name} is not used: {touch.reason}" for touch in attempt.read if touch not in used]
    if priors.is_free(SHARED.index("pixel_size")):
        at = SHARED.index("pixel_size"), SHARED.index("zenith_gain")
        common = fit.covariance[at] / (errors[at[0]] * errors[at[1]])
        notes.append(
            "pixel size and zenith gain are nearly degenerate: their errors have a correlation of"
            f" {common:.2f}"
        )
    gains = {touch.name: 1 + np.split(touch.frame_values, 2)[0] for touch in used}
    precession = _precession(attempt, values, sigma)
    return TouchFit(response, precession, tuple(estimates), gains, tuple(notes))


_TITLES = {"phase": "phase_offset"}
_UNITS = {
    "zenith_gain": "counts/rad",
    "zenith_offset": "counts",
    "tilt": "rad",
    "phase": "rad",
    "pivot_z": "mm",
    "pixel_size": "mm",
}


def _is_absorbed(name: str) -> bool:
    return name.startswith(("zenith", "uneven")) or name in ("tilt", "phase", "pivot_z", "pixel_size")


def _needed(name: str, priors: _Priors) -> float:
    """Return the standard error of a parameter that counts as determined: that of a usual sensor."""
    kind = name.partition("_")[0]
    if name in _NEEDED or kind in _NEEDED:
        return _NEEDED.get(name, _NEEDED.get(kind, 0.0))
    usual = PROPERTIES["uneven_light_sigma" if kind == "uneven" else f"{name}_sigma"].default
    assert usual is not None
    return float(usual) * (
        priors.loose[SHARED.index(name)] / _UNKNOWN["zenith_offset"] if name == "zenith_offset" else 1.0
    )


def _contradiction(dropped: _Dropped, priors: _Priors, fit: _Fitted) -> str:
    """Return the sentence about a stated number that the touches contradict."""
    name = SHARED[dropped.at]
    title, unit, factor = _TITLES.get(name, name).replace("_", " "), _UNITS.get(name, ""), 1.0
    if unit == "rad":
        unit, factor = "deg", math.degrees(1)
    value = priors.number_of(name, fit.values[dropped.at])
    error = math.sqrt(fit.covariance[dropped.at, dropped.at]) * abs(priors.scale[dropped.at])
    by_touches, by_statement = (
        f"{each * factor:.4g} ± {spread * factor:.2g} {unit}".rstrip()
        for each, spread in ((value, error), (dropped.number, dropped.error))
    )
    return f"{title}: the touches say {by_touches}, but {by_statement} is stated, which was not used"


def _undetermined(estimates: Sequence[Estimate]) -> list[str]:
    """Return sentences about parameters that the touches do not determine, those of one remedy together."""
    groups: dict[str, list[str]] = {}
    for estimate in estimates:
        if not estimate.determined:
            name = "phase" if estimate.name == "phase_offset" else estimate.name
            remedy = _REMEDIES.get(name, _REMEDIES.get(name.partition("_")[0], ""))
            groups.setdefault(remedy, []).append(_with_error(estimate))
    return [f"not determined: {', '.join(names)}. Remedy: {remedy}" for remedy, names in groups.items()]


def _with_error(estimate: Estimate) -> str:
    """Return the name of a parameter with the standard error that touches alone give it."""
    name, error = estimate.name.replace("_", " "), estimate.of_touches
    if estimate.name in ("zenith_gain", "tilt", "pixel_size"):
        return f"{name} (± {100 * error / abs(estimate.value):.2g} %)"
    if estimate.unit == "rad":
        return f"{name} (± {math.degrees(error):.2g} deg)"
    return f"{name} (± {error:.2g} {estimate.unit})".replace(" )", ")")


def _precession(attempt: _Attempt, values: Mapping[str, float], sigma: Mapping[str, float]) -> Precession:
    """Return the movement of the body."""
    fit, priors, sensor = attempt.fit, attempt.priors, attempt.movement.sensor
    before = attempt.movement.before
    oval = np.array([values["oval_x"], values["oval_y"]])
    size = float(np.hypot(*oval))
    along = oval / size if size > 0 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    at = [SHARED.index("oval_x"), SHARED.index("oval_y")]
    covariance = fit.covariance[np.ix_(at, at)]
    axis = math.sqrt(across @ covariance @ across) / (2 * size) if size > 0 else math.inf
    x, y, z = (math.nan,) * 3 if sensor.pivot is None else sensor.pivot
    errors = {
        "tilt": sigma["tilt"] * sensor.tilt,
        "phase_offset": sigma["phase"],
        "ellipticity": math.sqrt(along @ covariance @ along),
        "major_axis": min(axis, math.pi / math.sqrt(12)),
        "pivot_z": sigma["pivot_z"],
    }
    if before is not None:
        kept = ("pivot_x", "pivot_y", "centre_x", "centre_y")
        errors |= {name: before.sigma[name] for name in kept if name in before.sigma}
    return Precession(
        tilt=priors.number_of("tilt", values["tilt"]),
        phase_offset=math.remainder(priors.number_of("phase", values["phase"]), math.tau),
        direction=attempt.movement.direction,
        ellipticity=size,
        major_axis=math.atan2(oval[1], oval[0]) / 2,
        centre=(0.0, 0.0) if before is None else before.centre,
        pivot=(x, y, z + values["pivot_z"]),
        sigma=errors,
    )
