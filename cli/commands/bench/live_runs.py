"""Live runs with frames from memory: on simulated time, to compare their results, and in real time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from mirrorskin.cli.commands.bench import scenes
from mirrorskin.cli.commands.bench.paced import Pace, Paced, shared_memory
from mirrorskin.cli.commands.bench.records import PERCENTILES, LiveRow
from mirrorskin.engine import Press, Rotation, Run
from mirrorskin.engine.base.running import plan_of
from mirrorskin.engine.force import ForceTracker
from mirrorskin.engine.live import LiveRun, Loop, Status, Update
from mirrorskin.engine.live.loop import LATENCY
from mirrorskin.engine.live.stream import WAITING
from mirrorskin.engine.live.tracking import Tracker, Trackers
from mirrorskin.engine.pose import PoseTracker
from mirrorskin.engine.slip import SlipTracker
from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device
from mirrorskin.twin import SimulatedClock

NAMES = "press", "turn", "pose", "slip", "force"
_LOOPED = NAMES[:2]
_ROUNDS = 10  # of a tracker's inputs on simulated time
_ROUNDING = 1e-5  # of float32, over the largest number of a map
_MODULUS, _TRAVEL = 0.1, 0.3  # MPa and mm, of the forces


class Ran(NamedTuple):
    """A run: seconds, processor time in it, lost frames, seconds of latency, and the last result."""

    seconds: float
    processor: float
    lost: int
    latency: Sequence[float]
    result: Any
    status: Status | None = None
    last: Update | None = None


class Looped:
    """A press or turns in the live loop; the press lasts for all of a run, turns are repeated."""

    def __init__(self, name: str, shape: scenes.Shape, device: Device) -> None:
        self._turns = name == "turn"
        self._twin = (scenes.turns_on_ball if self._turns else scenes.press_of_ball)(shape, device)
        self._method: Press | Rotation = (
            Rotation(window_frames=scenes.STEPS, noise=scenes.NOISE, device=device)
            if self._turns
            else Press(device=device)
        )
        self._frames = shared_memory(self._twin.shape, self._twin.dtype)
        self._twin.read(self._frames)
        self.count: int = len(self._frames)

    def run(self, pace: Pace) -> Ran:
        """Push frames at a pace."""
        count, positions = self.count, self._twin.movement.positions
        step = positions[0] * (count / pace.count)

        def order(number: Any) -> Any:
            return number % count if self._turns else number * count // pace.count

        def places(number: Any) -> Any:
            return positions[number % count] if self._turns else step * (number + 1)

        source = Paced(self._frames, order, self._twin.header, places, pace)
        live = LiveRun(source, self._method)
        live.precompile()
        latency: list[float] = []
        last: list[Update] = []

        def keep(update: Update, status: Status) -> None:
            latency.append(update.latency)
            last[:] = [update]

        used = time.process_time()
        status = Loop(source, live, on_update=keep).run()
        used = time.process_time() - used
        lost = status.skipped + status.dropped
        return Ran(pace.now(), used, lost, latency, live.result(), status, *last)

    def offline(self) -> Any:
        """Return the result of the same frames without a loop; of turns, that of the last one."""
        plan = plan_of(self._method, self._twin)
        if self._turns:
            plan = replace(plan, frames=range(self.count - scenes.STEPS, self.count))
        return Run(plan, self._twin).complete()


class Tracked:
    """Trackers of a live loop that take the same maps and frames again and again."""

    def __init__(self, names: Sequence[str], shape: scenes.Shape, device: Device) -> None:
        self._names, self._shape, self._device = names, shape, device
        maps = (scenes.moving_domes if "pose" in names else scenes.loaded_domes)(shape)
        if "force" in names:
            maps = [result.with_fitted(travel=_TRAVEL) for result in maps]
        frames = scenes.sliding_texture(shape)
        self._updates = [
            Update(0, math.nan, "vertical", math.nan, frame, result)
            for frame, result in zip(frames, maps, strict=True)
        ]
        self.count: int = _ROUNDS * len(self._updates)

    def run(self, pace: Pace) -> Ran:
        """Push inputs when they are due, in order; those are lost that a `Stream` would not use either.

        As in a `Loop`, trackers start their work for an input that waits before the one before is complete.
        """
        push = self._warm()
        latency: list[float] = []
        result: Any = None
        number = lost = 0
        started: int | None = None

        def oldest(number: int, due: int) -> int:
            return max(number, due - WAITING, math.ceil((pace.now() - LATENCY) * pace.rate))

        used = time.process_time()
        while number < pace.count:
            due = pace.wait(number)
            first = min(oldest(number, due), due - 1) if started is None else started
            following = oldest(first + 1, due)
            started = following if following < due else None
            result = push(first, started)
            latency.append(pace.now() - first / pace.rate)
            number, lost = first + 1, lost + first - number
        return Ran(pace.now(), time.process_time() - used, lost, latency, result)

    def offline(self) -> Any:
        """Return the last result of the same inputs without a pace."""
        push = self._warm()
        return [push(number) for number in range(self.count)][-1]

    def _warm(self) -> Callable[..., Any]:
        """Return new trackers that have taken each input once, as a function of the numbers of inputs.

        They are those of an input, and of the next one if that waits already.
        """
        trackers = Trackers(
            {name: _tracker(name, self._shape, self._device) for name in self._names}, "vertical"
        )

        def update_of(number: int) -> Update:
            return replace(self._updates[number % len(self._updates)], tracked={}, lost={})

        def push(number: int, following: int | None = None) -> dict[str, Any]:
            update = update_of(number)
            trackers.track(update, None, lambda: None if following is None else update_of(following))
            for name, reason in update.lost.items():
                raise InputError(f"{name}: {reason}")
            return dict(update.tracked)

        for number in range(len(self._updates)):
            push(number)
        return push


def _tracker(name: str, shape: scenes.Shape, device: Device) -> Tracker:
    if name == "pose":
        return PoseTracker(device=device)
    if name == "slip":
        return SlipTracker(scenes.round_contact(shape), scenes.FIELD / shape[1], device=device)
    return ForceTracker(modulus=_MODULUS, device=device)


def check_name(name: str) -> str:
    """Return a name of `measure_live`; InputError if there is no such run."""
    parts = name.split("+")
    if unknown := [part for part in parts if part not in NAMES]:
        raise InputError(f"{unknown[0]!r} does not run live: name {', '.join(NAMES)}")
    if len(parts) > 1 and {*parts} & {*_LOOPED}:
        raise InputError(f"{name}: {' and '.join(_LOOPED)} run alone; join {', '.join(NAMES[2:])} only")
    return name


def measure_live(
    name: str, shape: scenes.Shape, rate: float, seconds: float, device: Device
) -> tuple[LiveRow, Ran]:
    """Run live work on simulated time, and then in real time.

    Parameters
    ----------
    name : str
        One of `NAMES`, or trackers joined by +, which run together.
    shape : (int, int)
        Rows and columns of a frame.
    rate, seconds : float
        Frames a second, and how long they come in real time.
    device : Device

    Returns
    -------
    row : LiveRow
    ran : Ran
        The run in real time.
    """
    work = Looped(name, shape, device) if name in _LOOPED else Tracked(name.split("+"), shape, device)
    expected = work.offline()
    simulated = work.run(Pace(rate, work.count, SimulatedClock()))
    pace = Pace(rate, max(1, round(rate * seconds)))
    ran = work.run(pace)
    values = np.percentile(ran.latency, [float(percent) for percent in PERCENTILES]) if ran.latency else ()
    row = LiveRow(
        name=name,
        size=f"{shape[1]}x{shape[0]}",
        rate=rate,
        seconds=ran.seconds,
        frames=pace.count,
        lost=ran.lost,
        updates=len(ran.latency),
        latency=dict(zip(PERCENTILES, map(float, values), strict=False)),
        processor=simulated.processor / work.count,
        as_offline=simulated.lost == 0 and _is_same(simulated.result, expected),
    )
    return row, ran


def _is_same(value: Any, other: Any) -> bool:
    """Return whether live results, or a list of them, have the numbers of offline ones, but for rounding.

    A live result may have further maps.
    """
    if isinstance(other, Mapping):
        return {*other} <= {*value} and all(_is_same(value[name], other[name]) for name in other)
    if isinstance(other, list | tuple):
        return len(value) == len(other) and all(map(_is_same, value, other))
    if is_dataclass(other):
        names = [field.name for field in fields(other) if field.compare]
        return all(_is_same(getattr(value, name), getattr(other, name)) for name in names)
    if isinstance(other, np.ndarray | np.generic | float) and np.asarray(other).dtype.kind == "f":
        numbers = np.asarray(other)
        largest = float(np.max(np.abs(numbers), initial=0.0, where=np.isfinite(numbers)))
        if np.shape(value) != numbers.shape:
            return False
        return np.allclose(value, numbers, _ROUNDING, _ROUNDING * largest, equal_nan=True)
    return bool(np.array_equal(value, other))
