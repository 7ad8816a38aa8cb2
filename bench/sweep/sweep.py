"""How a kernel file is swept over sizes and types: against its reference first, then beside the limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Arithmetic, Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.same import DisagreementError
from mirrorskin.kernels.device import Device

Shape = tuple[int, int]

FRAME_TYPES = "uint8", "uint16", "float32"
MAPS_ONLY = ("float32",)
SIZES: dict[str, Shape] = {"VGA": (480, 640), "1080p": (1080, 1920), "20 Mpx": (3648, 5472)}

_SMALL = (37, 61)
_QUICK: dict[str, Shape] = {"37 x 61": _SMALL}
_FEW, _LEAST, _MOST = 24, 8, 256  # frames: of a check and a quick run, and the fewest and most of others
_TURN = 96_000_000  # bytes of frames that a turn is to have
_ROUNDS = 5
_LONG = 2.0  # seconds in kernels, from which on a work is not done once more for what it says of itself
_CHAINS = 2_000_000  # size of the picture, at most, that arithmetic's limit is to be as long as
_ROOM = 1_000_000_000  # bytes for what a case takes beside its maps: frames that are made, and limits


@dataclass(frozen=True, slots=True)
class Job:
    """One work on one size and type.

    Attributes
    ----------
    work : callable
        Does it and waits for it.
    bytes : int
        That it must move: what is asked and what is answered, each once, and sums once read and once written.
    check : callable
        Raises DisagreementError where device and reference differ. It is only called on a small picture.
    frames : int
        That it handles.
    operations : int
        Multiply-adds, and what takes as long: a comparison, an addition; 0 where nobody counted.
    """

    work: Work
    bytes: int
    check: Callable[[], None]
    frames: int = 0
    operations: int = 0


@dataclass(frozen=True, slots=True)
class Family:
    """The works of a kernel file.

    Attributes
    ----------
    name, title : str
    make : callable
        Device, rows and columns, type of a sample and number of frames to works by their names.
    types : tuple of str
        Of samples; one of them where no frames come in.
    limit : {"read", "triad"}
        Which of the memory's limits stands above the works.
    room : int
        Bytes of a pixel for all maps.
    counted : str
        How bytes and multiply-adds are counted.
    """

    name: str
    title: str
    make: Callable[[Device, Shape, str, int], dict[str, Job]]
    types: tuple[str, ...]
    limit: Literal["read", "triad"]
    room: int
    counted: str


@dataclass(frozen=True, slots=True)
class Sweep(Case):
    """A case whose rows stand in groups of one size and type, each below its own limit."""

    def share(self, row: Row) -> float:
        """Return a work's bandwidth as a share of its own group's limit, both by the host's clock."""
        return row.bandwidth / self._limit_of(row).bandwidth

    def kernel_share(self, row: Row) -> float:
        """Return the same share by the device's account of its kernels; NaN where none ran."""
        return row.kernel_bandwidth / self._limit_of(row).kernel_bandwidth

    def _limit_of(self, row: Row) -> Row:
        before = self.rows[: next(n for n, one in enumerate(self.rows) if one is row) + 1]
        return next(one for one in reversed(before) if "limit" in one.name and one.bytes)


def run_sweep(family: Family, device: Device, quick: bool) -> Case:
    """Check each work on a small picture, then time it and the limit in all sizes and types.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    DisagreementError
        The device's answer is not that of the reference.
    """
    for kind in family.types:
        for job in family.make(device, _SMALL, kind, _FEW).values():
            job.check()
    rows: list[Row] = []
    notes = [f"shares are of the {family.limit} limit above a row, of as many bytes; {family.counted}"]
    groups = [(size, kind) for size in (_QUICK if quick else SIZES) for kind in family.types]
    for size, kind in groups:
        shape = (_QUICK | SIZES)[size]
        frames = _FEW if quick else count_frames(shape, kind)
        pixels = shape[0] * shape[1]
        check_memory(family.name, _ROOM + pixels * (family.room + 2 * frames * np.dtype(kind).itemsize))
        label = f"{size} {kind}" if len(family.types) > 1 else size
        group = _Group(label, shape, kind, frames)
        found, said = group.run(family, device, 1 if quick else _ROUNDS, last=(size, kind) == groups[-1])
        rows += found
    notes += [*said, *_arithmetic(rows)]
    return Sweep(family.name, family.title, rows, {}, tuple(notes))


def count_frames(shape: Shape, kind: str) -> int:
    """Return how many frames a turn has: whole eights, as many bytes in each size as there can be."""
    several = _TURN // (shape[0] * shape[1] * np.dtype(kind).itemsize) // 8 * 8
    return min(_MOST, max(_LEAST, several))


def run_kernel(device: Device, launch: Callable[[], object]) -> Work:
    """Return the work of putting kernels on the queue and waiting for them."""

    def work() -> None:
        launch()
        device.finish()

    return work


def agree(
    what: str, found: NDArray[Any], expected: NDArray[Any], tolerance: Any = 0.0, spared: int = 0
) -> None:
    """Raise DisagreementError unless a map is that of the reference, within a tolerance, NaN where it is NaN.

    Parameters
    ----------
    what : str
        Kernel and map.
    found, expected : ndarray
    tolerance : float or ndarray
        By which they may differ.
    spared : int
        Elements that may differ by more: where rounding decides between two answers.
    """
    with np.errstate(invalid="ignore"):
        apart = np.abs(found.astype(np.float64) - expected.astype(np.float64))
        same = (apart <= tolerance) | (np.isnan(found) & np.isnan(expected))
    wrong = np.argwhere(~same)
    if len(wrong) > spared:
        place = tuple(wrong[0].tolist())
        raise DisagreementError(
            f"{what}: {len(wrong)} of {same.size} differ from the reference, first at {place}: "
            f"{found[place]}, not {expected[place]}; nothing was timed"
        )


@dataclass(frozen=True, slots=True)
class _Group:
    """One size and type, and what its rows are called after."""

    label: str
    shape: Shape
    kind: str
    frames: int

    def run(self, family: Family, device: Device, rounds: int, *, last: bool) -> tuple[list[Row], list[str]]:
        """Time the works; return their rows below the memory's limit, and what is told of the last group.

        The last group ends with the limit of arithmetic.
        """
        jobs = family.make(device, self.shape, self.kind, self.frames)
        limits = Limits(device, np.zeros(max(job.bytes for job in jobs.values()), np.uint8))
        arithmetic = Arithmetic(device, min(self.shape[0] * self.shape[1], _CHAINS))
        works = {**limits.works(), **(arithmetic.works() if last else {})}
        works |= {name: job.work for name, job in jobs.items()}
        measured = take_turns(works, rounds, device.profile)
        limit = limits.rows(measured, first=family.limit)[0]
        rows = [Row(f"{limit.name}, {self.label}", limit.measured, limit.bytes)]
        for name, job in jobs.items():
            rows.append(Row(f"{name}, {self.label}", measured[name], job.bytes, job.frames, job.operations))
        if not last:
            return rows, []
        told = [
            _traffic(row, job.work, device, limit)
            for row, job in zip(rows[1:], jobs.values(), strict=True)
            if row.measured.kernel < _LONG
        ]
        return [*rows, arithmetic.row(measured)], told


def _traffic(row: Row, work: Work, device: Device, limit: Row) -> str:
    """Say how much a work's kernels move by their own account, and at which share of the limit."""
    device.profile.clear()
    work()
    kernels = [record for record in device.profile.records() if record.kind == "kernel"]
    moved = sum(record.bytes for record in kernels)
    share = moved / max(sum(record.seconds for record in kernels), 1e-9) / limit.kernel_bandwidth
    parts = ", ".join(f"{record.name} {1e3 * record.seconds:.2f} ms" for record in kernels[:4])
    told = f"{moved / 1e6:.1f} MB at {100 * share:.0f} % of the limit"
    return f"{row.name}: its kernels say that they move {told}: {parts}"


def _arithmetic(rows: list[Row]) -> list[str]:
    """Say which share of the multiply-adds that there can be each work does where it does most."""
    limit = rows[-1].operations / rows[-1].measured.kernel
    best: dict[str, float] = {}
    for row in rows[:-1]:
        if row.operations and "kernel" in row.measured.device:
            name, rate = row.name.partition(", ")[0], row.operations / row.measured.kernel
            best[name] = max(rate, best.get(name, 0.0))
    told = (f"{name} {rate / 1e9:.1f} ({100 * rate / limit:.0f} %)" for name, rate in best.items())
    return [f"G operations/s at most, and of {limit / 1e9:.1f} that there can be: {', '.join(told)}"]
