"""The limits of a device: memory bandwidth, multiply-adds, and the launch of a kernel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from mirrorskin.cli.commands.bench.records import Case, Row
from mirrorskin.cli.commands.bench.timing import FIRST, OURS, ROUNDS, Work, renamed, take_turns
from mirrorskin.engine import free_memory
from mirrorskin.kernels.device import Device

LAUNCHES = 1000
LAUNCH = f"{LAUNCHES} launches"
_RUNS = {"read": 1, "copy": 2, "triad": 3}  # runs of words that a kernel touches


class Shape(NamedTuple):
    """The macros of ``limits.cl``: how its kernels divide the work."""

    lanes: int
    words: int
    stride: int

    def items(self, count: int) -> int:
        """Return the work-items for ``count`` words."""
        return -(-count // (self.words * self.stride)) * self.stride

    @property
    def macros(self) -> dict[str, int]:
        """The shape as macros."""
        return {"LANES": self.lanes, "WORDS": self.words, "STRIDE": self.stride}


# Which shape a memory prefers differs between machines; the best one of a run counts.
CORES = (Shape(16, 256, 1), Shape(16, 1024, 1), Shape(16, 4096, 1))
LANES = (Shape(4, 16, 128), Shape(4, 64, 128), Shape(4, 256, 128))
CHAINS = (Shape(4, 8, 1), Shape(8, 8, 1), Shape(16, 8, 1)), (Shape(2, 8, 128), Shape(4, 8, 128))


class Limits:
    """Works that read, copy, or combine (triad) `size` bytes."""

    def __init__(self, device: Device, size: int) -> None:
        numbers = max(size // 4, 64 * 3)
        self._device = device
        self._shapes = CORES if device.info.kind == "cpu" else LANES
        # Distinct pages: the system would map a single page of zeros many times.
        self._data = device.from_host("limits", np.arange(numbers, dtype=np.uint32), np.uint32)
        largest = max(shape.lanes * shape.items(numbers // shape.lanes) for shape in self._shapes)
        self._sums = device.array("sums", (largest,), np.uint32)

    def works(self) -> dict[str, Work]:
        """Return the works to be timed."""
        return {
            _name(limit, shape): Work(
                partial(self._run, limit, shape), 4 * shape.lanes * self._count(limit, shape) * _RUNS[limit]
            )
            for limit in _RUNS
            for shape in self._shapes
        }

    def rows(self, measured: Mapping[str, Row], first: str = "read") -> list[Row]:
        """Return each limit in its fastest shape; the limit named `first` leads."""
        names = sorted(_RUNS, key=lambda limit: limit != first)
        return [_fastest(f"{name} limit", measured) for name in names]

    def _run(self, limit: str, shape: Shape) -> None:
        kernel = self._device.kernel("limits", f"{limit}_all", **shape.macros)
        count = self._count(limit, shape)
        every: dict[str, dict[str, Any]] = {"read": {"sums": self._sums}, "copy": {}, "triad": {"scale": 3}}
        moved = 4 * shape.lanes * count * _RUNS[limit]
        kernel(shape.items(count), words=self._data, count=count, **every[limit], moved=moved)
        self._device.finish()

    def _count(self, limit: str, shape: Shape) -> int:
        return self._data.shape[0] // shape.lanes // _RUNS[limit]


class Arithmetic:
    """Independent multiply-adds on numbers in registers, about 256 for each of `pixels` numbers."""

    def __init__(self, device: Device, pixels: int) -> None:
        on_cores = device.info.kind == "cpu"
        self._device = device
        self._shapes = CHAINS[0] if on_cores else CHAINS[1]
        self._steps = max(1, pixels // 256)
        numbers = 128 * max(1, pixels // 8192) if on_cores else 4096 * max(1, pixels // 2048)
        self._data = device.array("numbers", (numbers,), np.float32)
        self._data.fill()

    def works(self) -> dict[str, Work]:
        """Return the works to be timed."""
        operations = self._data.shape[0] * self._steps
        return {
            _name("multiply-add", shape): Work(partial(self._run, shape), operations=operations)
            for shape in self._shapes
        }

    def row(self, measured: Mapping[str, Row]) -> Row:
        """Return the limit in its fastest shape."""
        return _fastest("multiply-add limit", measured)

    def _run(self, shape: Shape) -> None:
        kernel = self._device.kernel("limits", "multiply_all", **shape.macros)
        count = self._data.shape[0] // shape.lanes
        numbers: dict[str, Any] = {"count": count, "steps": self._steps, "factor": 0.5, "summand": 1.0}
        kernel(shape.items(count), numbers=self._data, **numbers, moved=0)
        self._device.finish()


def measure_limits(device: Device, size: int, rounds: int = ROUNDS) -> Case:
    """Time reading, copying and combining `size` bytes, multiply-adds, and launches of an empty kernel."""
    memory, arithmetic = Limits(device, size), Arithmetic(device, size // 64)
    words = device.array("launches", (64,), np.uint32)

    def launch() -> None:
        kernel = device.kernel("limits", "copy_all", STRIDE=1, LANES=4, WORDS=1)
        for _ in range(LAUNCHES):
            kernel(1, words=words, count=1, moved=32)
        device.finish()

    works = {**memory.works(), **arithmetic.works(), LAUNCH: Work(launch)}
    measured = take_turns(works, rounds, device.profile)
    rows = [*memory.rows(measured), arithmetic.row(measured), measured[LAUNCH]]
    return Case("limits", f"the device alone; {size / 1e6:.0f} MB", rows)


def time_works(
    works: Mapping[str, Work],
    size: int,
    device: Device,
    quick: bool,
    check: Callable[[dict[str, Any]], None] = lambda results: None,
    *,
    first: str = "read",
    rounds: int = ROUNDS,
) -> dict[str, Row]:
    """Time works in turns with the limits of `size` bytes; return the rows by name, the limits first."""
    limits = Limits(device, size)
    measured = take_turns({**limits.works(), **works}, 1 if quick else rounds, device.profile, check)
    rows = {row.name: row for row in limits.rows(measured, first)}
    return rows | {name: measured[name] for name in works}


def call_works(call: Callable[[], object], moved: int, frames: int = 0) -> dict[str, Work]:
    """Return a public function as a work, and the same without memory kept from earlier calls."""
    return {OURS: Work(call, moved, frames), FIRST: Work(call, moved, frames, before=free_memory)}


def _fastest(limit: str, measured: Mapping[str, Row]) -> Row:
    rows = [row for name, row in measured.items() if name.startswith(f"{limit}, ")]
    return renamed(min(rows, key=lambda row: row.wall.median), limit)


def _name(limit: str, shape: Shape) -> str:
    return f"{limit} limit, {shape.words} words of {shape.lanes}"
