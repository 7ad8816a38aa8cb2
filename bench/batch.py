"""A batch of small recordings: what each file costs beyond what is computed, read and written.

Aim: at most 5 ms a file.
"""

from __future__ import annotations

import math
import mmap
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.files import MAPS, Frames, make_press, new_folder, record, sync, to_result
from mirrorskin.bench.harness import (
    OURS,
    Case,
    Cases,
    DisagreementError,
    Row,
    Target,
    Work,
    agree,
    check_memory,
)
from mirrorskin.bench.limits import beside_limits
from mirrorskin.bench.paths import onset_maps, search_of
from mirrorskin.engine import OnsetSearch
from mirrorskin.engine.batch.jobs import Job, Plan, make_jobs
from mirrorskin.engine.batch.local import run_local
from mirrorskin.engine.streaming import push_block
from mirrorskin.kernels.device import Device

BATCH, LOOP = f"{OURS}, batch", f"{OURS}, open, reconstruct and save in a loop"
LEAST = "kernels and plain reads and writes alone"

_COUNT, _SHAPE, _FEW, _QUICK = 200, (32, 480, 640), 3, (12, 48, 64)
_BOUND = 5.0  # ms a file
_ROUNDS = 5
_COPIES = 16  # of a file's frames, that the limits do not run in the cache


def run_batch(device: Device, quick: bool) -> Case:
    """Time a batch beside the least that it has to do: frames read where they lie, kernels, maps written.

    The least maps each file's frames into memory, gives them to a search that is ready, and writes the maps'
    bytes to a file. It opens no recording, takes no fingerprint, makes no search, and knows no HDF5.
    """
    count, shape = (_FEW, _QUICK) if quick else (_COUNT, _SHAPE)
    size, extra = count * math.prod(shape), MAPS * math.prod(shape[1:])
    check_memory("batch-small", size + 2 * extra)
    with new_folder("batch-small", size + count * extra) as folder:
        press = make_press(shape)
        jobs = make_jobs(_record_all(press, count, folder), folder / "results")
        results, search = jobs[0].target.parent, search_of(press, device)
        offset = _frames_offset(jobs[0].source)
        push_block(search, press.block)
        expected = onset_maps(search.result())

        def check(found: dict[str, Any]) -> None:
            maps = {LEAST: found[LEAST], LOOP: found[LOOP]}
            maps |= {f"{BATCH}, {job.target.name}": io.open_result(job.target).maps() for job in jobs}
            for name, mine in maps.items():
                agree(name, mine, expected, whose=f"{OURS}, in memory")

        clear = partial(_clear, results)
        works: dict[str, Work] = {
            "clear the folder of results": clear,
            LEAST: partial(_do_least, jobs, offset, search, press.block),
            "clear the folder of results again": clear,
            LOOP: partial(_loop, jobs, device),
            "clear the folder of results once more": clear,
            BATCH: partial(_run, jobs, device),
        }
        copies = min(count, _COPIES) * math.prod(shape)
        limits, measured = beside_limits(works, copies, device, quick, check, rounds=_ROUNDS)
    rows = {name: Row(name, measured[name], size, count * shape[0]) for name in (LEAST, LOOP, BATCH)}
    each = {name: 1e3 * row.measured.wall.median / count for name, row in rows.items()}
    note = f"a file: {', '.join(f'{name} {ms:.2f} ms' for name, ms in each.items())}"
    over = each[BATCH] - each[LEAST]
    value = f"{over:.2f} ms ({each[BATCH]:.2f} of which {each[LEAST]:.2f} compute and I/O)"
    bound = f"at most {_BOUND:g} ms a file beyond compute and I/O"
    targets = () if quick else (Target(f"{BATCH}, overhead", bound, value, over <= _BOUND),)
    title = (
        f"{count} presses, full default, references of each pixel, no holes filled; "
        f"{' x '.join(map(str, shape))} uint8 each, contiguous"
    )
    return Case("batch-small", title, [*limits, *rows.values()], {}, (note,), targets)


CASES: Cases = {"batch-small": run_batch}


def _record_all(press: Frames, count: int, folder: Path) -> list[Path]:
    """Write recordings of one press: the file is what is small here, not what it shows."""
    first, *others = [folder / f"press-{number:03}.h5" for number in range(count)]
    record(press, first)
    for path in others:
        shutil.copyfile(first, path)
        sync(path)
    return [first, *others]


def _frames_offset(path: Path) -> int:
    """Return at which byte of a recording its frames begin."""
    import h5py

    from mirrorskin.io.layout import STACK

    with h5py.File(path) as file:
        return int(file[STACK].id.get_offset())


def _clear(results: Path) -> None:
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir()


def _do_least(jobs: list[Job], offset: int, search: OnsetSearch, block: io.Block) -> dict[str, NDArray[Any]]:
    """Map, search and write, for each file; return the last one's maps."""
    like = block.frames
    for job in jobs:
        with job.source.open("rb") as file:
            memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        frames = np.frombuffer(memory, like.dtype, like.size, offset).reshape(like.shape)
        search.reset()
        push_block(search, replace(block, frames=frames))
        maps = onset_maps(search.result())
        with job.target.open("wb") as out:
            for values in maps.values():
                out.write(values.data)
    return maps


def _loop(jobs: list[Job], device: Device) -> dict[str, NDArray[Any]]:
    """Do what a batch does by its parts, for each file; return the last one's maps."""
    for job in jobs:
        result = to_result(job.source, job.target, device)
    return result.maps()


def _run(jobs: list[Job], device: Device) -> None:
    """Run the batch; none may fail, or be there already."""
    for outcome in run_local(jobs, Plan(), [device]):
        if outcome.state != "done":
            raise DisagreementError(f"{BATCH}: {outcome.job.source.name} {outcome.state}: {outcome.message}")
