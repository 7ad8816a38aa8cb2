"""Trackers and events of a live loop: what a controller needs of each frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.operation import Operation, Plan
from mirrorskin.engine.live.status import Event, Update
from mirrorskin.io import InputError, Motion, Result, Source

Tracker = Any
"""An object with ``push(maps)``, or of the parts of an update that it ``takes``, or a function of it.

If it also has ``submit``, which takes the same, starts the work on a device, and returns a function that
waits for the answer, then other trackers work at the same time.
"""

_REFUSALS = InputError, NotConverged  # of a frame, after which a tracker goes on


class Frames(Operation):
    """Frames without an operation, for a stream or a loop of trackers alone; it applies to any motion.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> tracked = []
    >>> brightness = {"brightness": lambda update: float(update.picture.mean())}
    >>> with engine.live.Stream(
    ...     engine.live.Frames(),
    ...     (2, 3),
    ...     latency=math.inf,
    ...     trackers=brightness,
    ...     on_update=lambda update, status: tracked.append(update.tracked["brightness"]),
    ... ) as stream:
    ...     for counts in (10, 20):
    ...         stream.push(np.full((2, 3), counts, np.uint8))
    >>> tracked
    [10.0, 20.0]
    """

    updates_per_second = math.inf

    def plan(self, source: Source) -> Plan:
        """Return the plan for a source, without checks of its frames."""
        return replace(super().plan(source), checked=False)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Make room for a frame."""
        self._newest = np.zeros(shape, dtype)

    def push(self, frames: NDArray[Any]) -> None:
        """Keep the newest frame."""
        np.copyto(self._newest, frames[-1])

    def result(self) -> Mapping[str, Any]:
        """Return the newest frame."""
        return {"newest": self._newest}

    def preview(self, seconds: float) -> Result:
        """Return no maps: an update has its picture."""
        return Result()


class Trackers:
    """The trackers of a loop, each with its name; the mapping may be changed between updates."""

    def __init__(self, trackers: Mapping[str, Tracker], motion: Motion) -> None:
        self._trackers = trackers
        self._started: dict[str, _Started] = {}  # for the next update
        for name, tracker in trackers.items():
            _check(name, tracker, motion)

    def precompile(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Compile what the trackers need for frames of a shape and type."""
        for tracker in self._trackers.values():
            if hasattr(tracker, "precompile"):
                tracker.precompile(shape, dtype)

    def track(self, update: Update, press: float | None, following: Callable[[], Update | None]) -> None:
        """Write the answers into an update, and the reasons of those that are missing.

        The work of all trackers that can submit it is started before the first answer is waited for, so that
        devices and the host work at the same time. Answers are taken one after the other. As soon as one that
        was submitted is there, ``following`` is called once: it returns the next update if a frame waits, and
        each tracker that has answered starts its work for that. ``press`` is the travel of motions that are
        not vertical.
        """
        tracked, lost = cast("dict[str, Any]", update.tracked), cast("dict[str, str]", update.lost)
        before, self._started = self._started, {}
        update = _with_travel(update, press)
        started: dict[str, _Started] = {}
        for name, tracker in tuple(self._trackers.items()):
            is_started = name in before and before[name].tracker is tracker
            started[name] = before[name] if is_started else _Started.of(tracker, update)
        asked, upcoming = False, None
        for name, work in started.items():
            try:
                tracked[name] = work.answer()
            except _REFUSALS as error:
                tracked[name], lost[name] = None, str(error)
            if not hasattr(work.tracker, "submit"):
                continue
            if not asked:
                asked, upcoming = True, following()
                upcoming = None if upcoming is None else _with_travel(upcoming, press)
            if upcoming is not None:
                self._started[name] = _Started.of(work.tracker, upcoming)


class _Started(NamedTuple):
    """A tracker whose work has been started, if it can be, and a function that waits for the answer."""

    tracker: Tracker
    answer: Callable[[], Any]

    @classmethod
    def of(cls, tracker: Tracker, update: Update) -> _Started:
        """Start the work of a tracker on an update; the answer raises what the tracker refuses."""
        try:
            return cls(tracker, _submit(tracker, update))
        except _REFUSALS as error:
            return cls(tracker, partial(_refuse, error))


def _refuse(error: Exception) -> NoReturn:
    raise error


def _with_travel(update: Update, press: float | None) -> Update:
    """Return an update whose maps have the travel of the body."""
    travel = update.position if update.motion == "vertical" else press
    if update.maps and travel is not None and math.isfinite(travel) and update.maps.fitted.travel is None:
        return replace(update, maps=update.maps.with_fitted(travel=float(travel)))
    return update


def _submit(tracker: Tracker, update: Update) -> Callable[[], Any]:
    """Start the work of a tracker, if it can, and return a function that waits for the answer."""
    if not hasattr(tracker, "push"):
        return partial(tracker, update)
    taken = getattr(tracker, "takes", ("maps",))
    if "maps" in taken and not update.maps:
        raise InputError("the frames do not determine maps yet")
    parts = [getattr(update, part) for part in taken]
    return tracker.submit(*parts) if hasattr(tracker, "submit") else partial(tracker.push, *parts)


def _check(name: str, tracker: Tracker, motion: Motion) -> None:
    if not hasattr(tracker, "push") and not callable(tracker):
        raise InputError(
            f"trackers: {name} is a {type(tracker).__name__}. Give a tracker, such as a PoseTracker, or a"
            " function of the update"
        )
    motions: tuple[Motion, ...] = getattr(tracker, "motions", ())
    if motions and motion not in motions:
        raise InputError(
            f"trackers: {name} follows {' and '.join(motions)} motions, but the frames are of a {motion} one"
        )


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit of a quantity of updates, for events: one starts above it, and ends at a lower one.

    Parameters
    ----------
    quantity : callable
        Returns a number for an `Update`; None or NaN if it is unknown, which starts and ends nothing.
    above : float
        The event starts when the quantity exceeds this.
    until : float, optional
        It ends when the quantity is at most this; by default ``above``.

    Raises
    ------
    mirrorskin.io.InputError
        ``until`` is larger than ``above``, or one of them is NaN.

    Examples
    --------
    >>> limit = Limit(lambda update: update.position, above=0.5, until=0.4)
    >>> [limit.holds(position, False) for position in (0.45, 0.55)]
    [False, True]
    >>> limit.holds(0.45, True)
    True
    """

    quantity: Callable[[Update], float | None]
    above: float
    until: float | None = None

    def __post_init__(self) -> None:
        if not self.above >= (self.above if self.until is None else self.until):
            raise InputError(f"a limit of {self.above} until {self.until}: until must not be larger")

    @classmethod
    def contact(cls, area: float = 0.0) -> Limit:
        """Return the limit of an area of contact, mm², or pixels of it if the pixel size is unknown."""
        return cls(_contact, area)

    @classmethod
    def slip(cls, share: float = 0.02, tracker: str = "slip") -> Limit:
        """Return the limit of the share of the contact that slips, as a `SlipTracker` of this name finds it.

        The share is 1 if the tracker finds no part that sticks, as after a sudden slip, and 0 without a
        contact.
        """
        return cls(lambda update: _slipping(update.tracked.get(tracker)), share)

    @classmethod
    def force(cls, newtons: float, until: float | None = None, tracker: str = "force") -> Limit:
        """Return the limit of the normal force, N, as a `ForceTracker` of this name finds it."""
        return cls(lambda update: getattr(update.tracked.get(tracker), "force", None), newtons, until)

    def holds(self, value: float, before: bool) -> bool:
        """Return whether an event goes on or starts with a value; ``before`` says whether one is going on."""
        lower = self.above if self.until is None else self.until
        return value > (lower if before else self.above)


def _contact(update: Update) -> float | None:
    if update.contact_area is not None or update.maps.contact is None:
        return update.contact_area
    return float(np.count_nonzero(update.maps.contact))


def _slipping(found: Result | None) -> float | None:
    if found is None or found.stick_ratio is None:
        return None
    if math.isnan(found.stick_ratio[-1]):  # nothing touches
        return 0.0
    return 1.0 if math.isnan(found.shift_x) else 1 - float(found.stick_ratio[-1])


class Events:
    """The limits of a loop by name, and the events that go on."""

    def __init__(self, limits: Mapping[str, Limit]) -> None:
        self._limits = dict(limits)
        self._going_on = dict.fromkeys(limits, False)
        for name, limit in self._limits.items():
            if not isinstance(limit, Limit):
                raise InputError(
                    f"events: {name} is a {type(limit).__name__}. Give a Limit, such as Limit.contact()"
                )

    def of(self, update: Update) -> tuple[Event, ...]:
        """Return what starts or ends with an update."""
        changes = []
        for name, limit in self._limits.items():
            value = limit.quantity(update)
            if value is None or math.isnan(value):
                continue
            before = self._going_on[name]
            self._going_on[name] = now = limit.holds(value, before)
            if now != before:
                changes.append(Event(name, now, update.time, float(value)))
        return tuple(changes)
