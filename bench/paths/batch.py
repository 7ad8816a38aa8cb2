"""A batch of small recordings: what each file costs beyond what is computed, read and written."""

from __future__ import annotations

import math
import mmap
import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS
from mirrorskin.bench.paths import files
from mirrorskin.bench.paths.equal import check_equal
from mirrorskin.bench.paths.press import make_press, maps_of, search_of
from mirrorskin.bench.paths.whole import to_result
from mirrorskin.bench.results import Case, Row, Target
from mirrorskin.bench.same import DisagreementError
from mirrorskin.engine import OnsetSearch
from mirrorskin.engine.batch.jobs import Job, Plan, make_jobs
from mirrorskin.engine.batch.local import run_local
from mirrorskin.engine.streaming import push_block
from mirrorskin.io.layout import STACK
from mirrorskin.kernels.device import Device

Maps = dict[str, NDArray[Any]]

BATCH, LOOP = f"{OURS}, batch", f"{OURS}, open, reconstruct and save in a loop"
LEAST = "kernels and plain reads and writes alone"

_BOUND = 5.0  # ms a file
_ROUNDS = 5
_COPIES = 16  # of a file's frames, that the limits do not run in the cache
_CLEAR = "clear the folder of results"
_MAPS = 64  # bytes a pixel for all maps, in memory or in files


@dataclass(frozen=True, slots=True)
class BatchCase:
    """Many small presses in files of their own, contiguous.

    Attributes
    ----------
    name : str
    count : int
        Of files.
    shape : (int, int, int)
        Frames, rows and columns of each, of uint8.
    """

    name: str
    count: int
    shape: tuple[int, int, int]

    @property
    def bytes(self) -> int:
        """Of all frames."""
        return self.count * math.prod(self.shape)

    @property
    def title(self) -> str:
        """What is measured, in one line."""
        size = " x ".join(map(str, self.shape))
        return (
            f"{self.count} presses, full default, references of each pixel, no holes filled; "
            f"{size} uint8 each, contiguous"
        )


def run_batch(case: BatchCase, device: Device, quick: bool) -> Case:
    """Time a batch beside the least that it has to do: frames read where they lie, kernels, maps written.

    The least maps each file's frames into memory, gives them to a search that is ready, and writes the maps'
    bytes to a file. It opens no recording, takes no fingerprint, makes no search, and knows no HDF5.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory, or room for files.
    DisagreementError
        A recording failed, or some path gave other maps than the same frames in memory.
    """
    extra = _MAPS * math.prod(case.shape[1:])
    check_memory(case.name, case.bytes + 2 * extra)
    with files.new_folder(case.name, case.bytes + case.count * extra) as folder:
        press = make_press(case.shape)
        jobs = make_jobs(_record_all(press, case.count, folder), folder / "results")
        search, copies = search_of(press, device), min(case.count, _COPIES)
        limits = Limits(device, np.concatenate([press.block.frames] * copies))
        push_block(search, press.block)
        check = partial(_check, jobs, maps_of(search.result()))
        works = {**limits.works(), **_works(jobs, search, press.block, device)}
        measured = take_turns(works, 1 if quick else _ROUNDS, device.profile, check)
    frames = case.count * case.shape[0]
    rows = {name: Row(name, measured[name], case.bytes, frames) for name in (LEAST, LOOP, BATCH)}
    each = {name: 1e3 * row.measured.wall.median / case.count for name, row in rows.items()}
    told = f"a file: {', '.join(f'{name} {ms:.2f} ms' for name, ms in each.items())}"
    targets = () if quick else (_judge(each[BATCH], each[LEAST]),)
    return Case(case.name, case.title, [*limits.rows(measured), *rows.values()], {}, (told,), targets)


@dataclass(frozen=True, slots=True)
class _Piece:
    """Where a file's frames lie.

    Attributes
    ----------
    path : Path
    offset : int
        Bytes.
    """

    path: Path
    offset: int

    @classmethod
    def of(cls, path: Path) -> _Piece:
        """Find the frames of a recording."""
        with h5py.File(path) as file:
            return cls(path, file[STACK].id.get_offset())

    def map(self, like: NDArray[Any]) -> NDArray[Any]:
        """Map the frames into memory; they are of a known shape and type."""
        with self.path.open("rb") as file:
            memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        return np.frombuffer(memory, like.dtype, like.size, self.offset).reshape(like.shape)


def _record_all(press: files.Frames, count: int, folder: Path) -> list[Path]:
    """Write recordings of one press: the file is what is small here, not what it shows."""
    first, *others = [folder / f"press-{number:03}.h5" for number in range(count)]
    files.record(press, first)
    for path in others:
        shutil.copyfile(first, path)
        files.settle(path)
    return [first, *others]


def _works(jobs: list[Job], search: OnsetSearch, block: io.Block, device: Device) -> dict[str, Work]:
    """Return the works, each after one that clears the folder of the results before."""
    pieces, results = [_Piece.of(job.source) for job in jobs], jobs[0].target.parent
    return {
        _CLEAR: partial(_clear, results),
        LEAST: partial(_do_least, pieces, search, block, results),
        f"{_CLEAR} again": partial(_clear, results),
        LOOP: partial(_loop, jobs, device),
        f"{_CLEAR} once more": partial(_clear, results),
        BATCH: partial(_run, jobs, device),
    }


def _clear(results: Path) -> None:
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir()


def _do_least(pieces: list[_Piece], search: OnsetSearch, known: io.Block, results: Path) -> Maps:
    """Map, search and write, for each file; return the last one's maps."""
    for piece in pieces:
        search.reset()
        push_block(search, replace(known, frames=piece.map(known.frames)))
        maps = maps_of(search.result())
        with (results / piece.path.name).open("wb") as file:
            for values in maps.values():
                file.write(values.data)
    return maps


def _loop(jobs: list[Job], device: Device) -> Maps:
    """Do what a batch does by its parts, for each file; return the last one's maps."""
    for job in jobs:
        result = to_result(job.source, job.target, device)
    return result.maps()


def _run(jobs: list[Job], device: Device) -> None:
    """Run the batch; none may fail, or be there already."""
    for outcome in run_local(jobs, Plan(), [device]):
        if outcome.state != "done":
            raise DisagreementError(f"{BATCH}: {outcome.job.source.name} {outcome.state}: {outcome.message}")


def _check(jobs: list[Job], expected: Maps, results: dict[str, Any]) -> None:
    """Compare what all came to, of the batch, the last to write, what it saved, with the frames in memory."""
    found = {LEAST: results[LEAST], LOOP: results[LOOP]}
    found |= {f"{BATCH}, {job.target.name}": io.open_result(job.target).maps() for job in jobs}
    for name, maps in found.items():
        check_equal(name, expected, maps, f"{OURS}, in memory")


def _judge(batch: float, least: float) -> Target:
    over = batch - least
    told = f"{over:.2f} ms ({batch:.2f} of which {least:.2f} compute and I/O)"
    bound = f"at most {_BOUND:g} ms a file beyond compute and I/O"
    return Target(f"{BATCH}, overhead", bound, told, over <= _BOUND)
