"""The limits of a device: as many bytes as a case's frames, read, copied and combined; multiply-adds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from mirrorskin.bench.harness import (
    FIRST,
    OURS,
    ROUNDS,
    Case,
    Measured,
    Row,
    Work,
    call_targets,
    take_turns,
)
from mirrorskin.engine import free_memory
from mirrorskin.kernels.device import Device

_RUNS = {"read": 1, "copy": 2, "triad": 3}  # runs of words that a kernel touches


class Shape(NamedTuple):
    """How a limit's kernel is cut; the macros of ``limits.cl``."""

    lanes: int
    words: int
    stride: int

    def items(self, count: int) -> int:
        """Return the work-items that ``count`` words take."""
        return -(-count // (self.words * self.stride)) * self.stride


# Several shapes, because which one a memory likes best differs between machines; the best of a run counts.
CORES = (Shape(16, 256, 1), Shape(16, 1024, 1), Shape(16, 4096, 1))
LANES = (Shape(4, 16, 128), Shape(4, 64, 128), Shape(4, 256, 128))
CHAINS = (Shape(4, 8, 1), Shape(8, 8, 1), Shape(16, 8, 1)), (Shape(2, 8, 128), Shape(4, 8, 128))


class Limits:
    """Read, copy and triad on as many bytes as a case moves."""

    def __init__(self, device: Device, size: int) -> None:
        numbers = max(size // 4, 64 * 3)
        self._device = device
        self._shapes = CORES if device.info.kind == "cpu" else LANES
        self._data = device.array("limits", (numbers,), np.uint32)
        # Not one page of zeros that the system maps again and again.
        self._data.host[:] = np.arange(numbers, dtype=np.uint32)
        self._data.upload()
        room = max(shape.lanes * shape.items(numbers // shape.lanes) for shape in self._shapes)
        self._sums = device.array("sums", (room,), np.uint32)
        self._sums.upload()

    def works(self) -> dict[str, Work]:
        """Return the works to be timed."""
        return {
            _name(limit, shape): partial(self._run, limit, shape) for limit in _RUNS for shape in self._shapes
        }

    def rows(self, measured: Mapping[str, Measured], first: str = "read") -> list[Row]:
        """Return read, copy and triad limit, each in the shape that was the quickest; `first` leads."""
        rows = []
        for limit in sorted(_RUNS, key=lambda limit: limit != first):
            best = min(self._shapes, key=lambda shape: measured[_name(limit, shape)].wall.median)
            moved = 4 * best.lanes * self._count(limit, best) * _RUNS[limit]
            rows.append(Row(f"{limit} limit", measured[_name(limit, best)], moved))
        return rows

    def _run(self, limit: str, shape: Shape) -> None:
        macros = {"LANES": shape.lanes, "WORDS": shape.words, "STRIDE": shape.stride}
        kernel = self._device.kernel("limits", f"{limit}_all", **macros)
        count = self._count(limit, shape)
        every: dict[str, dict[str, Any]] = {"read": {"sums": self._sums}, "copy": {}, "triad": {"scale": 3}}
        moved = 4 * shape.lanes * count * _RUNS[limit]
        kernel(shape.items(count), words=self._data, count=count, **every[limit], moved=moved)
        self._device.finish()

    def _count(self, limit: str, shape: Shape) -> int:
        return len(self._data.host) // shape.lanes // _RUNS[limit]


def beside_limits(
    works: Mapping[str, Work],
    size: int,
    device: Device,
    quick: bool,
    check: Callable[[dict[str, Any]], None] = lambda results: None,
    *,
    first: str = "read",
    rounds: int = ROUNDS,
    before: Mapping[str, Callable[[], object]] | None = None,
) -> tuple[list[Row], dict[str, Measured]]:
    """Time works in turns with the limits of `size` bytes; return the limits' rows, and what was measured."""
    limits = Limits(device, size)
    every = {**limits.works(), **works}
    measured = take_turns(every, 1 if quick else rounds, device.profile, check, before)
    return limits.rows(measured, first), measured


def time_call(
    name: str,
    title: str,
    call: Work,
    moved: int,
    device: Device,
    quick: bool,
    *,
    frames: int = 0,
    peers: Mapping[str, Work] | None = None,
    check: Callable[[dict[str, Any]], None] = lambda results: None,
    first: str = "read",
    absent: Mapping[str, str] | None = None,
) -> Case:
    """Time a public function, arrays in and maps out, with the limits and its peers; see `call_targets`."""
    works = {OURS: call, FIRST: call, **(peers or {})}
    limits, measured = beside_limits(
        works, moved, device, quick, check, first=first, before={FIRST: free_memory}
    )
    rows = [*limits, *(Row(work, measured[work], moved, frames) for work in works)]
    return Case(name, title, rows, dict(absent or {}), targets=() if quick else call_targets(rows))


class Arithmetic:
    """Multiply-adds that wait for nothing, on numbers that stay in registers; the best of several shapes.

    They take about as long as a case of so many pixels.
    """

    def __init__(self, device: Device, pixels: int) -> None:
        on_cores = device.info.kind == "cpu"
        self._device = device
        self._shapes = CHAINS[0] if on_cores else CHAINS[1]
        self._steps = max(1, pixels // 256)
        numbers = 128 * max(1, pixels // 8192) if on_cores else 4096 * max(1, pixels // 2048)
        self._data = device.array("numbers", (numbers,), np.float32)
        self._data.host[:] = 0
        self._data.upload()

    def works(self) -> dict[str, Work]:
        """Return the works to be timed."""
        return {_name("multiply-add", shape): partial(self._run, shape) for shape in self._shapes}

    def row(self, measured: Mapping[str, Measured]) -> Row:
        """Return the limit in the shape that was the quickest."""
        best = min((measured[name] for name in self.works()), key=lambda one: one.wall.median)
        return Row("multiply-add limit", best, operations=len(self._data.host) * self._steps)

    def _run(self, shape: Shape) -> None:
        macros = {"LANES": shape.lanes, "WORDS": shape.words, "STRIDE": shape.stride}
        kernel = self._device.kernel("limits", "multiply_all", **macros)
        count = len(self._data.host) // shape.lanes
        known: dict[str, Any] = {"count": count, "steps": self._steps, "factor": 0.5, "summand": 1.0}
        kernel(shape.items(count), numbers=self._data, **known, moved=0)
        self._device.finish()


def _name(limit: str, shape: Shape) -> str:
    return f"{limit} limit, {shape.words} words of {shape.lanes}"
