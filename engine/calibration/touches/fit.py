"""The fit of touches of unknown objects: what they tell of a sensor, with what earlier ones told."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.touches.memory import Earlier, Memory, told_by
from mirrorskin.engine.calibration.touches.priors import (
    Movement,
    Priors,
)
from mirrorskin.engine.calibration.touches.reading import (
    Touch,
    TouchReader,
)
from mirrorskin.engine.calibration.touches.window import MOVEMENT, Window
from mirrorskin.engine.calibration.wall_model import STEP_NAMES
from mirrorskin.engine.press.intervals import estimate_interval_scatter
from mirrorskin.io import (
    LinearResponse,
    WallResponse,
)
from mirrorskin.kernels.array_types import Doubles

_BETTER = 0.9  # ratio of misfits up to which errors, which follow from the misfit, still shrink
_WORSE = 1.02  # ratio of misfits from which on a step was too long
_ITERATIONS = 16  # Gauss-Newton steps, at most
_SETTLED = 0.1  # largest last step, in standard errors
_NEARLY_SETTLED = 0.5  # the same, of a fit that is repeated
_ROUGHLY = 2  # steps, and registrations, before pixels are chosen; in an exact fit, heights then stay
_ROUGHLY_UNDER_WALL = 3  # the same under a wall, where the sensor stays as it is in a first fit
_FOLLOWED = 1.6  # variance of residuals of a touch under a wall that is used, times that of other touches
_EXCLUDING = 3  # steps in which outliers are excluded under a wall; otherwise in one
_CONTRADICTION = 3.0  # standard deviations between a prior and the touches
_LEAST_RELIEF = 30.0  # chi-square of a pixel by relief from which on a touch shows the pivot
_WELL_SHOWN = 0.02  # relative standard error of the gain by a touch, up to which noise prevails
_CLEAR = 4.0  # standard deviations of the contradiction of touches by chance, from which on it is a note
_MOVED = 0.02  # pixels that points move by an error of the pivot, from which frames are registered again
_REGISTERED = 0.3  # standard errors of a movement with which turns without a press are registered
_REGISTRATIONS = 5  # largest number of registrations with an estimated movement
_REGISTRATIONS_OF_TURNS = 12  # the same, of turns without a press once their pixels are chosen again
_OTHER_TILT = (
    0.05  # relative difference of the amplitude of the brightness from which the tilt starts with it
)
_IMPLAUSIBLE = 5.0  # standard deviations of what is usual: a fit that is so far off is of another movement


Response = LinearResponse | WallResponse


@dataclass(frozen=True, slots=True)
class Attempt:
    """A fit of all touches with frames that are registered with an assumed movement."""

    readers: Sequence[TouchReader]
    movement: Movement
    priors: Priors
    before: Earlier | None
    forget: float | None
    read: list[Touch]
    used: list[Touch]
    memory: Memory
    fit: Fitted
    dropped: list[Dropped]
    moved: Doubles  # changes of the parameters that are in the movement

    @classmethod
    def of(
        cls,
        readers: Sequence[TouchReader],
        movement: Movement,
        priors: Priors,
        before: Earlier | None,
        forget: float | None,
        start: Doubles | None = None,
        moved: Doubles | None = None,
    ) -> Attempt:
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
            named = None if before is None else dict(zip(before.names, before.values.tolist(), strict=True))
            start = priors.start(named, movement.before)
        if moved is None:
            moved = np.zeros(len(priors.names))
        memory = Memory.of(before, used, forget, priors.names).moved(moved)
        fit, dropped = _fit_with_priors(used, start, priors, memory, exact=False)
        return cls(readers, movement, priors, before, forget, read, used, memory, fit, dropped, moved)

    def following(self) -> list[Touch]:
        """Return the touches whose samples follow the model."""
        used = [touch for touch in self.used if touch.follows()]
        if self.movement.sensor.wall is None or not used:
            return used
        return [touch for touch, follows in zip(used, _follow(used), strict=True) if follows]

    @property
    def noise(self) -> float:
        """Usual variance of samples, relative to the least."""
        return float(np.median([touch.noise / touch.least_noise**2 for touch in self.used] or [math.inf]))

    @property
    def may_be_of_another_movement(self) -> bool:
        """Whether touches that show a surface do not fit it."""
        fits = self.following() and self.is_plausible and self.fit.is_settled
        return not fits and any(touch.varied or not touch.windows for touch in self.read)

    @property
    def is_plausible(self) -> bool:
        """Whether the parameters are those of a sensor, and not of another movement."""
        priors = self.priors
        away = (self.fit.values - priors.mean) * priors.scale / np.maximum(priors.loose, 1e-12)
        others = {"phase", "lag", *MOVEMENT, *STEP_NAMES} - {"tilt"}
        judged = [number for number, name in enumerate(priors.names) if name not in others]
        return float(np.sum(away[judged] ** 2)) < _IMPLAUSIBLE**2

    def exact(self, used: list[Touch]) -> Attempt:
        """Return the exact fit of some of the touches."""
        memory = Memory.of(self.before, used, self.forget, self.priors.names).moved(self.moved)
        fit, dropped = _fit_with_priors(used, self.fit.values, self.priors, memory, exact=True)
        return replace(self, used=used, memory=memory, fit=fit, dropped=dropped)

    def registered(self) -> Attempt:
        """Return the fit of frames that are registered with the estimated movement.

        Pixels and splines of turns without a press are then chosen again, if samples follow them better: the
        first ones were chosen where a wrong movement put the points.
        """
        if all(reader.has_press for reader in self.readers):
            return self._until_registered(_REGISTRATIONS)
        attempt = self._until_registered(_ROUGHLY)
        if not attempt.used:
            return attempt
        better = min(attempt._again(chooses=True), attempt, key=lambda each: each.noise)
        return better._until_registered(_REGISTRATIONS_OF_TURNS)

    def _until_registered(self, limit: int) -> Attempt:
        attempt = self
        for _ in range(limit):
            if attempt._is_registered or not all(reader.turn.rewindable for reader in self.readers):
                break
            attempt = attempt._again()
        return attempt

    @property
    def _is_registered(self) -> bool:
        """Whether points are hardly registered wrongly, and no estimate depends on it.

        Heights of a turn without a press follow from how its frames are registered.
        """
        if self._misplaced >= _MOVED:
            return False
        if all(reader.has_press for reader in self.readers):
            return True
        at = [self.priors.at(name) for name in ("tilt", "phase")]
        sigma = np.sqrt(np.diag(self.fit.covariance))
        return bool(np.all(np.abs(self.fit.values[at]) < _REGISTERED * sigma[at]))

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
        along = 0.0
        if sensor.wall is not None:
            half = math.hypot(
                *(side * pixel / 2 for side, pixel in zip(sensor.gain.shape, size, strict=True))
            )
            along = abs(values["sight_0"] - sensor.wall.sight[0]) * half * abs(self._press)
        return (sensor.tilt * max(abs(error) for error in errors) + along) / min(size)

    @property
    def _press(self) -> float:
        """Largest press of the turns, mm."""
        return max(reader.turn.header.press or 0.0 for reader in self.readers)

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name."""
        return dict(zip(self.priors.names, self.fit.values.tolist(), strict=True))

    @property
    def remembered(self) -> dict[str, Any]:
        """What a response keeps of the touches, and of what was stated, so that others can be added."""
        fit, values, priors = self.fit, self.fit.values.copy(), self.priors
        dropped = [each.at for each in self.dropped]
        kept = np.array(priors.kept) & ~np.isin(np.arange(len(values)), dropped)
        matrix = fit.matrix + np.diag(kept / priors.sigma**2)
        vector = fit.vector + kept / priors.sigma**2 * priors.mean
        # Others are in the numbers of the calibration from now on.
        values[[number for number, name in enumerate(self.priors.names) if _is_absorbed(name)]] = 0.0
        return {
            "names": self.priors.names,
            "values": values,
            "information": (matrix + matrix.T) / 2,
            "pull": vector - matrix @ fit.values,
            "touches": len(self.used) + (0 if self.before is None else self.before.touches),
            "time": self.memory.time,
        }

    def _again(self, chooses: bool = False) -> Attempt:
        movement = self.movement.changed(self.values)
        start, moved = self.fit.values.copy(), self.moved.copy()
        at = [self.priors.at(name) for name in ("tilt", "phase", "pivot_z")]
        moved[at] += start[at]
        start[at] = 0.0
        pairs = zip(self.readers, self.read, strict=True)
        readers = [reader.with_heights(touch, chooses and not reader.has_press) for reader, touch in pairs]
        priors = self.priors.relative_to(movement)
        return Attempt.of(readers, movement, priors, self.before, self.forget, start, moved)


def _is_absorbed(name: str) -> bool:
    return name.startswith(("zenith", "uneven")) or name in ("tilt", "phase", "pivot_z", "pixel_size")


class Dropped(NamedTuple):
    """A stated number that the touches contradict."""

    at: int
    number: float
    error: float


class Fitted(NamedTuple):
    """Parameters of a sensor, and the information about them."""

    values: Doubles
    matrix: Doubles  # information of all touches
    vector: Doubles  # matrix times the parameters that the touches alone would have
    covariance: Doubles
    contradiction: float  # of touches with each other, over what noise explains
    degrees: float  # of freedom of the contradiction
    is_settled: bool  # whether the last step was small

    @property
    def contradicts(self) -> bool:
        """Whether the touches contradict each other by more than chance."""
        return self.contradiction > 1 + _CLEAR * math.sqrt(2 / max(self.degrees, 1e-9))


class _Stage(NamedTuple):
    """What a step of a fit does."""

    excludes: bool  # pixels that do not follow the model
    uses_intervals: bool  # of presses, around the present surfaces
    chooses: bool  # splines
    is_near: bool  # whether surfaces are near the true ones


def _fit_with_priors(
    touches: Sequence[Touch], start: Doubles, priors: Priors, memory: Memory, exact: bool
) -> tuple[Fitted, list[Dropped]]:
    """Return the fit without the stated numbers that the touches contradict, and these."""
    dropped: list[Dropped] = []
    fit = _fit(touches, start, priors, memory, exact)
    while True:
        contradictions = []
        for number in np.flatnonzero(priors.stated):
            value, error = without_prior(fit, priors, int(number))
            away = abs(value - priors.mean[number]) / math.hypot(error, priors.sigma[number])
            contradictions.append((away, int(number)))
        worst = max(contradictions, default=(0.0, 0))
        if worst[0] < _CONTRADICTION:
            break
        dropped.append(Dropped(worst[1], float(priors.number[worst[1]]), float(priors.error[worst[1]])))
        priors = priors.without(worst[1])
        fit = _fit(touches, fit.values, priors, memory, exact)
    return fit, dropped


def without_prior(fit: Fitted, priors: Priors, number: int) -> tuple[float, float]:
    """Return a parameter and its standard error by touches and the priors of the other parameters."""
    precision = priors.precision(without=number)
    covariance = np.linalg.inv(fit.matrix + precision)
    return float(covariance[number] @ (fit.vector + precision @ priors.mean)), float(
        np.sqrt(covariance[number, number])
    )


def _fit(touches: Sequence[Touch], start: Doubles, priors: Priors, memory: Memory, exact: bool) -> Fitted:
    """Return the Gauss-Newton fit of surfaces, frames and parameters.

    Splines are chosen, and pixels that do not follow the model are excluded, on the way. An ``exact`` fit,
    which starts with surfaces near the true ones, takes heights of presses from their intervals. Surfaces
    under a wall start far from the true ones, as if there were none: they are fitted before the sensor.
    """
    values, precision = start.copy(), priors.precision()
    is_cold = not exact and not all(touch.is_warm for touch in touches)
    under_wall = "zenith_gain" not in priors.names
    roughly = 0 if not (exact or is_cold) else _ROUGHLY_UNDER_WALL if under_wall else _ROUGHLY
    excluding = range(roughly, roughly + (_EXCLUDING if under_wall else 1))
    last, before, is_settled, following = math.inf, values, False, np.ones(len(touches), np.bool_)
    for number in range(_ITERATIONS):
        early = number < roughly
        stage = _Stage(number in excluding, exact and early, early and (is_cold or exact), exact)
        found = [_eliminate(touch, values, stage) for touch in touches]
        follow = _follow(touches) if under_wall else following
        following = following & follow if number > excluding[-1] else follow
        informations, pushes = [], []
        for place, (touch, follows, (information, push, _)) in enumerate(
            zip(touches, following, found, strict=True)
        ):
            if max(window.relief_shown for window in touch.windows) < _LEAST_RELIEF:
                _forget_pivot(information, push, priors)
            weight = follows if under_wall else _trust(information, priors)
            information, push = memory.of_touch(place, information, push)
            informations.append(weight * information)
            pushes.append(weight * push)
        pulls = [each @ values + push for each, push in zip(informations, pushes, strict=True)]
        matrix = memory.matrix + np.sum(informations, axis=0)
        vector = memory.vector + np.sum(pulls, axis=0)
        covariance = np.linalg.inv(matrix + precision)
        change = covariance @ (vector + precision @ priors.mean) - values
        if under_wall and is_cold and early:
            change = np.zeros(len(values))
        misfit = float(np.sum([np.sum(window.left**2) for touch in touches for window in touch.windows]))
        if number > roughly and misfit > _WORSE * last:
            for touch in touches:
                touch.turn_back()
            values = (values + before) / 2
            continue
        is_level = misfit > _BETTER * last if number > roughly else not is_cold
        last, before = misfit, values
        for touch, (_, _, of_touch) in zip(touches, found, strict=True):
            touch.keep()
            of_touch(change)
        values = values + change
        settled = _SETTLED if exact else _NEARLY_SETTLED
        is_settled = is_level and bool(np.all(np.abs(change) < settled * np.sqrt(np.diag(covariance))))
        if number >= roughly and is_settled:
            break
    pushes = [push - each @ change for push, each in zip(pushes, informations, strict=True)]
    contradiction, degrees = _contradiction_of(informations, pushes, covariance, precision)
    if exact and contradiction > 1:
        matrix, vector = (
            earlier + (each - earlier) / contradiction
            for earlier, each in ((memory.matrix, matrix), (memory.vector, vector))
        )
        covariance = np.linalg.inv(matrix + precision)
        values = covariance @ (vector + precision @ priors.mean)
    return Fitted(values, matrix, vector, (covariance + covariance.T) / 2, contradiction, degrees, is_settled)


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


def _follow(touches: Sequence[Touch]) -> NDArray[np.bool_]:
    """Return which touches follow the model hardly less than the others."""
    misfits = np.array([touch.misfit for touch in touches])
    usual = float(np.median(misfits)) if touches else 1.0
    return np.asarray(misfits <= _FOLLOWED * max(1.0, usual))


def _trust(information: Doubles, priors: Priors) -> float:
    """Return the weight of a touch: 1 if it alone shows the gain well.

    An error of the model of a tenth of a count changes the parameters by their variance times its slope by
    them: the less a touch shows, the more the error exceeds the noise.
    """
    at = priors.at("zenith_gain")
    alone = math.sqrt(float(np.linalg.inv(information + priors.precision(without=at))[at, at]))
    return min(1.0, (_WELL_SHOWN / alone) ** 4)


def _eliminate(touch: Touch, values: Doubles, stage: _Stage) -> tuple[Doubles, Doubles, Any]:
    """Return a touch's information about the sensor, its push, and what a step of the sensor does to it."""
    frames, is_sharp = len(touch.phase), stage.is_near and touch.is_sharp

    def look() -> list[Any]:
        gains, offsets = np.split(touch.frame_values, 2)
        return [window.look(touch.poses, gains, offsets, values, is_sharp) for window in touch.windows]

    sums = look()
    if stage.excludes:
        for window in touch.windows:
            window.exclude_outliers()
        sums = look()
    # Neighbours of registered frames share their noise, so that of a sample is larger than the residuals.
    usual = float(np.mean([window.noise_gain**2 for window in touch.windows]))
    touch.noise = max(_noise_of(touch.windows, frames) / usual, touch.least_noise**2)
    if stage.uses_intervals:
        _use_intervals(touch)
    chooses = stage.chooses and (is_sharp or not stage.is_near)
    parts = [
        window.eliminate(each, touch.noise, chooses) for window, each in zip(touch.windows, sums, strict=True)
    ]
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
            window.z = part.heights(np.concatenate([change, of_parameters]))

    information, push = own[of_sensor, of_sensor] - reduced[:, :-1], pull[of_sensor] - reduced[:, -1]
    return information, push, step


def _forget_pivot(information: Doubles, push: Doubles, priors: Priors) -> None:
    """Leave of what a touch tells of the pivot only how the other estimated parameters depend on it."""
    at = priors.at("pivot_z")
    rest = np.array([number for number in range(len(push)) if number != at and priors.is_free(number)])
    pivot = np.array([at])
    information[np.ix_(pivot, pivot)], push[pivot] = told_by(information, push, pivot, rest)


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
    error = np.concatenate([window.of_press[part] - window.z[part] for window, part in pairs])
    half = np.concatenate([window.half[part] for window, part in pairs])
    spread = estimate_interval_scatter(error, half)
    for window, part in pairs:
        if part.any():
            window.use_intervals(spread)
