"""A batch of small recordings: the overhead per file in addition to computation, reading and writing.

Target: at most 5 ms per file.
"""

from __future__ import annotations

import math
import mmap
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.suite.files import MAPS, make_press, new_folder, record, sync, to_result
from mirrorskin.bench.suite.harness import Cases, DisagreementError, agree, check_memory
from mirrorskin.cli.commands.bench.limits import time_works
from mirrorskin.cli.commands.bench.records import Case, Target
from mirrorskin.cli.commands.bench.timing import OURS, Work
from mirrorskin.engine import find_onset
from mirrorskin.engine.batch.jobs import Job, Plan, make_jobs
from mirrorskin.engine.batch.local import run_local
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.kernels.device import Device

BATCH, LOOP = f"{OURS}, batch", f"{OURS}, open, reconstruct and save in a loop"
LEAST = "kernels and plain reads and writes alone"

_COUNT, _SHAPE, _FEW, _QUICK = 200, (32, 480, 640), 3, (12, 48, 64)
_BOUND = 5.0  # ms per file
_ROUNDS = 5
_COPIES = 16  # of the frames of a file: the limits exceed the cache


def run_batch(device: Device, quick: bool) -> Case:
    """Time a batch and the minimum: mapping the frames into memory, the kernels, writing maps as bytes."""
    count, shape = (_FEW, _QUICK) if quick else (_COUNT, _SHAPE)
    size, extra = count * math.prod(shape), MAPS * math.prod(shape[1:])
    check_memory("batch-small", size + 2 * extra)
    with new_folder("batch-small", size + count * extra) as folder:
        press = make_press(shape)
        jobs = make_jobs(_record_all(press, count, folder), folder / "results")
        results = jobs[0].target.parent
        bare_work = partial(_do_least, jobs, press, _frames_offset(jobs[0].source), device)
        clear = partial(_clear, results)
        works = {
            LEAST: Work(bare_work, size, count * shape[0], before=clear),
            LOOP: Work(partial(_loop, jobs, device), size, count * shape[0], before=clear),
            BATCH: Work(partial(_run, jobs, device), size, count * shape[0], before=clear),
        }

        def check(results: dict[str, Any]) -> None:
            maps = {LOOP: results[LOOP]}
            maps |= {f"{BATCH}, {job.target.name}": io.open_result(job.target).maps() for job in jobs}
            for name, mine in maps.items():
                agree(name, mine, results[LEAST], whose=f"{OURS}, in memory")

        copies = min(count, _COPIES) * math.prod(shape)
        rows = time_works(works, copies, device, quick, check, rounds=_ROUNDS)
    each = {name: 1e3 * rows[name].wall.median / count for name in works}
    note = f"a file: {', '.join(f'{name} {ms:.2f} ms' for name, ms in each.items())}"
    over = each[BATCH] - each[LEAST]
    value = f"{over:.2f} ms ({each[BATCH]:.2f} of which {each[LEAST]:.2f} compute and I/O)"
    bound = f"at most {_BOUND:g} ms a file beyond compute and I/O"
    targets = () if quick else (Target(f"{BATCH}, overhead", bound, value, over <= _BOUND),)
    title = (
        f"{count} presses, full default, references of each pixel, no holes filled; "
        f"{' x '.join(map(str, shape))} uint8 each, contiguous"
    )
    return Case("batch-small", title, list(rows.values()), {}, (note,), targets)


CASES: Cases = {"batch-small": run_batch}


def _record_all(press: Frames, count: int, folder: Path) -> list[Path]:
    """Write recordings with the same frames of a press."""
    first, *others = [folder / f"press-{number:03}.h5" for number in range(count)]
    record(press, first)
    for path in others:
        shutil.copyfile(first, path)
        sync(path)
    return [first, *others]


def _frames_offset(path: Path) -> int:
    """Return the offset of the frames in a recording, bytes."""
    import h5py

    from mirrorskin.io.storage.layout import STACK

    with h5py.File(path) as file:
        return int(file[STACK].id.get_offset())


def _clear(results: Path) -> None:
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir()


def _do_least(jobs: list[Job], press: Frames, offset: int, device: Device) -> dict[str, NDArray[Any]]:
    """Map, search and write each file; return the maps of the last one."""
    block, header = press.block, press.header
    assert block.travel is not None
    maps: dict[str, NDArray[Any]] = {}
    for job in jobs:
        with job.source.open("rb") as file:
            memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        frames = np.frombuffer(memory, press.dtype, block.frames.size, offset).reshape(press.shape)
        onset = find_onset(frames, block.travel, dark=header.dark, bright=header.bright, device=device)
        maps = {"height": onset.height, "height_sigma": onset.height_sigma, "status": onset.status}
        with job.target.open("wb") as out:
            for values in maps.values():
                out.write(values.data)
    return maps


def _loop(jobs: list[Job], device: Device) -> dict[str, NDArray[Any]]:
    """Open, reconstruct and save each file; return the maps of the last one."""
    for job in jobs:
        result = to_result(job.source, job.target, device)
    return result.maps()


def _run(jobs: list[Job], device: Device) -> None:
    """Run the batch; no job may fail, or find an existing result."""
    for outcome in run_local(jobs, Plan(), [device]):
        if outcome.state != "done":
            raise DisagreementError(f"{BATCH}: {outcome.job.source.name} {outcome.state}: {outcome.message}")
