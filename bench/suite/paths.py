"""Whole paths from a file to a result in a file: a press, turns, a typical script of a lab, and memory.

Targets: contiguous frames in 1.25 times the time of the computation in memory; compressed frames in 1.15
times the time of decoding; turns at 70 % of the memory bandwidth; ten times as fast as h5py and NumPy; memory
within the limit.
"""

from __future__ import annotations

import gc
import json
import math
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.suite.files import (
    MAPS,
    PATH,
    ROUNDS,
    make_press,
    make_turns,
    new_folder,
    record,
    sync,
    to_new_results,
    to_result,
)
from mirrorskin.bench.suite.harness import (
    Cases,
    DisagreementError,
    agree,
    check_memory,
    missing,
    ratio_target,
)
from mirrorskin.cli.commands.bench.limits import time_works
from mirrorskin.cli.commands.bench.paced import shared_memory
from mirrorskin.cli.commands.bench.records import Case, Target
from mirrorskin.cli.commands.bench.timing import OURS, Work
from mirrorskin.engine import reconstruct
from mirrorskin.engine.base.tiling import MEMORY_LIMIT
from mirrorskin.evaluation.base.object_store import object_store
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.scenes.inputs import SCALES, STEPS, Floats, references
from mirrorskin.io.base.url import path_of
from mirrorskin.kernels.device import Device, list_devices, open_device

Shape = tuple[int, int, int]

IN_MEMORY = f"{OURS}, frames in memory"
READ, H5PY = f"{OURS}, frames read", "h5py, frames read"
PLAIN = f"{PATH}, equation 4"
_ZARR_PATH, _OBJECTS = f"{PATH}, from Zarr", "s3fs, objects fetched"
_ARGMAX = "h5py and NumPy argmax, file to result"

_QUICK, _QUICK_TURNS = (12, 48, 64), (64, 48, 64)
_PRESS, _TURNS, _LAB, _BUDGET = (1907, 1024, 1024), (16_000, 240, 320), (256, 1080, 1920), (6_500, 480, 640)
_ZARR = (480, 480, 640)
_PAGE = 4096
_LIMIT_SHARE = 0.7
_ROUNDING = 1e-6  # mm
_TIMES, _MORE = 10, 1.1  # size of a file, and tolerated memory, divided by the budget
_FEW = 8  # frames that are reconstructed before memory is measured


def run_press(name: str, compression: Literal["raw", "bitshuffle"], device: Device, quick: bool) -> Case:
    """Time the path of a press and its parts, after checking that results equal those from memory."""
    shape = _QUICK if quick else _PRESS
    stored = "contiguous" if compression == "raw" else "bitshuffle-LZ4, one chunk a frame"
    title = f"full default, references of each pixel; {_size(shape)}, {stored}"
    return _beside_memory(name, title, make_press, shape, compression, {}, device, quick)


def run_turns(device: Device, quick: bool) -> Case:
    """Time the path of many turns to normals, and its parts."""
    shape = _QUICK_TURNS if quick else _TURNS
    title = (
        f"exact method to normals, mean of {shape[0] // STEPS} turns, no heights; {_size(shape)}, contiguous"
    )
    scale = {"zenith_gain": SCALES["uint8"].gain, "zenith_offset": SCALES["uint8"].offset}
    return _beside_memory("file-turns", title, make_turns, shape, "raw", scale, device, quick)


def _beside_memory(
    name: str,
    title: str,
    make: Callable[[Shape], Frames],
    shape: Shape,
    compression: Literal["raw", "bitshuffle"],
    options: dict[str, Any],
    device: Device,
    quick: bool,
) -> Case:
    size, extra = math.prod(shape), MAPS * math.prod(shape[1:])
    check_memory(name, 3 * size + MEMORY_LIMIT + extra)
    with new_folder(name, size + ROUNDS * extra) as folder:
        source, path, target = make(shape), folder / "frames.h5", folder / "result.h5"
        record(source, path, compression)
        with io.open_recording(path) as recording:
            calls: dict[str, Callable[[], object]] = {
                IN_MEMORY: partial(_reconstruct, source, device, options),
                PATH: to_new_results(path, target, device, **options),
                READ: partial(_fetch, recording, _buffer(recording)),
                H5PY: partial(_read_with_h5py, path, recording.dataset),
            }
            works = {work: Work(call, size, shape[0]) for work, call in calls.items()}

            def check(results: dict[str, Any]) -> None:
                expected = results[IN_MEMORY].maps()
                agree(PATH, results[PATH].maps(), expected, whose=IN_MEMORY)
                agree(f"{PATH}, saved", io.open_result(target).maps(), expected, whose=IN_MEMORY)

            rows = time_works(works, size, device, quick, check, rounds=ROUNDS)
            notes = (f"frames: {recording.storage}; {recording.how}",)
    if name == "file-turns":
        ratio = rows[PATH].bandwidth / rows["read limit"].bandwidth
        bound = f"at least {100 * _LIMIT_SHARE:.0f} % of read bandwidth"
        target_ = Target(PATH, bound, f"{100 * ratio:.0f} %", bool(ratio >= _LIMIT_SHARE))
    elif compression == "raw":
        target_ = ratio_target(PATH, 1.25, rows[PATH], rows[IN_MEMORY], "the same in memory", faster=False)
    else:
        target_ = ratio_target(PATH, 1.15, rows[PATH], rows[READ], "decoding alone", faster=False)
    return Case(name, title, list(rows.values()), {}, notes, () if quick else (target_,))


def run_zarr(name: str, place: str, device: Device, quick: bool) -> Case:
    """Time the path of a press in Zarr and in HDF5; for an object store, also reading its objects alone."""
    in_store = name == "file-s3"
    absent = missing("zarr", "s3fs", "moto") if in_store else missing("zarr")
    shape = _QUICK if quick else _ZARR
    title = f"full default, references of each pixel; {_size(shape)}, bitshuffle-LZ4 in {place}"
    if absent:
        return Case(name, title, [], absent)
    size, extra, rounds = math.prod(shape), MAPS * math.prod(shape[1:]), 1 if quick else ROUNDS
    check_memory(name, 3 * size + MEMORY_LIMIT + extra)
    with ExitStack() as stack:
        folder = stack.enter_context(new_folder(name, 3 * size + 2 * rounds * extra))
        path, copy = folder / "press.h5", folder / "press.zarr"
        calls: dict[str, Callable[[], object]] = {}
        if in_store:
            files, copy = stack.enter_context(object_store("bench")), path_of("s3://bench/press.zarr")
            calls[_OBJECTS] = lambda: files.cat(files.find("bench/press.zarr"))
        record(make_press(shape), path, "bitshuffle")
        storage = io.save_zarr(path, copy)
        first, second = (stack.enter_context(io.open_recording(source)) for source in (path, copy))
        calls |= {
            PATH: to_new_results(path, folder / "hdf5.h5", device),
            _ZARR_PATH: to_new_results(copy, folder / "zarr.h5", device),
            READ: partial(_fetch, first, _buffer(first)),
            f"{READ} from Zarr": partial(_fetch, second, _buffer(second)),
        }
        works = {work: Work(call, size, shape[0]) for work, call in calls.items()}

        def check(results: dict[str, Any]) -> None:
            agree(_ZARR_PATH, results[_ZARR_PATH].maps(), results[PATH].maps(), whose=PATH)

        rows = time_works(works, size, device, quick, check, rounds=rounds)
        notes = (f"HDF5: {first.storage}; {first.how}", f"Zarr: {storage}; {second.how}")
    other, than = (_OBJECTS, "its objects alone") if in_store else (PATH, "HDF5, compressed in the same way")
    target = ratio_target(_ZARR_PATH, 1.5, rows[_ZARR_PATH], rows[other], than, faster=False)
    return Case(name, title, list(rows.values()), {}, notes, () if quick else (target,))


def _reconstruct(source: Frames, device: Device, options: dict[str, Any]) -> io.Result:
    source.rewind()
    return reconstruct(source, device=device, **options)


def _size(shape: Shape) -> str:
    return f"{' x '.join(map(str, shape))} uint8"


def _buffer(recording: io.Recording) -> NDArray[Any]:
    """Return a buffer for as many frames as a reconstruction reads at once."""
    length = MEMORY_LIMIT // (2 * math.prod(recording.shape[1:]) * recording.dtype.itemsize)
    return shared_memory((min(max(1, length), recording.shape[0]), *recording.shape[1:]), recording.dtype)


def _fetch(recording: io.Recording, buffer: NDArray[Any]) -> None:
    """Read all frames; if they are mapped, one byte per page."""
    recording.rewind()
    while (block := recording.read(buffer)) is not None:
        if block.stays_valid:
            block.frames.reshape(-1).view(np.uint8)[::_PAGE].max()


def _read_with_h5py(path: Path, dataset: str) -> None:
    import h5py
    import hdf5plugin  # noqa: F401  the filters that it brings

    with h5py.File(path) as file:
        stack = file[dataset]
        frame = np.empty(stack.shape[1:], stack.dtype)
        for number in range(len(stack)):
            stack.read_direct(frame, np.s_[number])


def run_lab(device: Device, quick: bool) -> Case:
    """Time a typical script of a lab, the full default and equation 4, after checking that heights agree."""
    shape = _QUICK if quick else _LAB
    size, extra = math.prod(shape), MAPS * math.prod(shape[1:])
    check_memory("file-lab", 4 * size + extra)
    with new_folder("file-lab", size + 10 * extra) as folder:
        press, path = make_press(shape), folder / "press.h5"
        record(press, path)
        with io.open_recording(path) as recording:
            dataset = recording.dataset
        lab = partial(_lab_argmax, path, dataset, *references(shape[1:], press.dtype), folder / "heights.npy")
        calls: dict[str, Callable[[], Any]] = {
            PATH: partial(to_result, path, folder / "result.h5", device),
            PLAIN: partial(to_result, path, folder / "plain.h5", device, subframe=False),
            _ARGMAX: lab,
        }
        works = {name: Work(call, size, shape[0]) for name, call in calls.items()}

        def check(results: dict[str, Any]) -> None:
            full, plain = results[PATH].height, results[PLAIN].height
            agree(_ARGMAX, {"height": results[_ARGMAX]}, {"height": plain}, whose=PLAIN)
            assert press.block.travel is not None
            above, step = full - plain, press.block.travel[1] - press.block.travel[0]
            inside = (above > -_ROUNDING) & (above < step + _ROUNDING) | np.isnan(full) & np.isnan(plain)
            if not inside.all():
                off = f"{np.count_nonzero(~inside)} heights are outside of the step of equation 4"
                raise DisagreementError(f"{PATH}: {off}; nothing was timed")

        rows = time_works(works, size, device, quick, check, rounds=ROUNDS)
    target = ratio_target(PATH, 10.0, rows[PATH], rows[_ARGMAX], _ARGMAX, faster=True)
    what = "heights by equation 4 with hold 2, saved; ours the full default as well"
    title = f"{what}; {_size(shape)}, contiguous"
    return Case("file-lab", title, list(rows.values()), {}, (), () if quick else (target,))


def _lab_argmax(path: Path, dataset: str, dark: Floats, bright: Floats, target: Path) -> Floats:
    """Read with h5py, compare each frame as it is normalised, and find the first light one with NumPy."""
    import h5py

    span = bright - dark
    with h5py.File(path) as file:
        stack, travel = file[dataset], _travel_in(file)
        light = np.empty(stack.shape, bool)
        for number in range(len(stack)):
            light[number] = (stack[number] - dark) / span >= 0.5
    light[:-1] &= light[1:]  # two consecutive frames, so that a spike is not an onset
    onset = np.where(light.any(axis=0), light.argmax(axis=0), -1)
    return _save(onset, travel, target)


def _travel_in(file: Any) -> NDArray[np.float64]:
    return np.asarray(file["/entry/instrument/stage/travel"][()])


def _save(onset: NDArray[Any], travel: NDArray[np.float64], target: Path) -> Floats:
    height = np.where(onset > 0, -travel[onset], np.nan).astype(np.float32)
    np.save(target, height)
    return height


def run_budget(device: Device, quick: bool) -> Case:
    """Reconstruct files ten times as large as the memory limit, in processes that measure their memory."""
    shape = _QUICK if quick else _BUDGET
    size, budget = math.prod(shape), math.prod(shape) // _TIMES
    title = f"peak memory of a process from file to result, file {_TIMES} times the budget; {_size(shape)}"
    if not Path("/proc/self/clear_refs").exists():
        return Case("file-budget", title, [], {OURS: "this system does not report memory of processes"})
    check_memory("file-budget", 2 * size)
    targets = []
    with new_folder("file-budget", 2 * size + MAPS * math.prod(shape[1:])) as folder:
        press = make_press(shape)
        expected = _reconstruct(press, device, {}).maps()
        number = [info.title for info in list_devices()].index(device.info.title)
        for kind, write in _KINDS.items():
            few, source, target = (folder / f"{name}.h5" for name in ("few", "press", "result"))
            write(press.first(_FEW), few)
            write(press, source)
            words = [*map(str, (few, source, target, budget, number))]
            command = [sys.executable, "-m", "suite.paths", *words]
            process = subprocess.run(
                command, check=True, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1]
            )
            source.unlink()
            agree(f"{OURS}, {kind}", io.open_result(target).maps(), expected)
            peak, base = json.loads(process.stdout)
            bound = f"at most {_MORE * budget / 1e6:.0f} MB, the budget of {budget / 1e6:.0f} and 10 %"
            value = (
                f"{base / 1e6:.0f} MB, and {max(0, peak - base) / 1e6:.0f} of the files' pages in the cache"
            )
            targets.append(Target(f"{OURS}, peak memory, {kind}", bound, value, base <= _MORE * budget))
    return Case("file-budget", title, [], {}, (), () if quick else tuple(targets))


def _write_long(press: Frames, path: Path) -> None:
    """Write compressed chunks of few pixels and many frames, as used for access along time."""
    import h5py
    import hdf5plugin

    from mirrorskin.io.storage.layout import CHECKSUM, SERIES, STACK

    record(press.first(2), path)
    block, travel = press.block, SERIES["travel"][0]
    chunk = tuple(max(1, length // 8) for length in press.shape)
    with h5py.File(path, "r+") as file:
        del file[STACK], file[travel], file[CHECKSUM]
        file[travel] = block.travel
        file[travel].attrs["units"] = "mm"
        packing = hdf5plugin.Bitshuffle(cname="lz4")
        stack = file.create_dataset(STACK, press.shape, press.dtype, chunks=chunk, **packing)
        for start in range(0, press.shape[0], chunk[0]):
            stack[start : start + chunk[0]] = block.frames[start : start + chunk[0]]
    sync(path)


_KINDS: dict[str, Callable[[Frames, Path], None]] = {
    "contiguous": record,
    "bitshuffle-LZ4": partial(record, compression="bitshuffle"),
    "chunks long in time": _write_long,
}


def _watch_memory() -> None:
    """Reconstruct the files of the command line, and print as JSON the additional memory in bytes.

    The first number includes pages of mapped files; the second is the peak of private memory. A recording of
    few frames is reconstructed first, so that all code is loaded.
    """
    few, source, target, budget, number = sys.argv[1:]
    device, limit = open_device(number), int(budget)
    within: dict[str, Any] = {"opening": {"memory_limit": limit}, "memory_limit": limit}
    to_result(Path(few), Path(target), device, **within)
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    before, base = _resident("VmRSS"), _resident("RssAnon", "RssShmem")
    largest, finished = base, threading.Event()

    def look() -> None:
        nonlocal largest
        while not finished.wait(0.001):
            largest = max(largest, _resident("RssAnon", "RssShmem"))

    watcher = threading.Thread(target=look)
    watcher.start()
    to_result(Path(source), Path(target), device, **within)
    finished.set()
    watcher.join()
    json.dump([_resident("VmHWM") - before, largest - base], sys.stdout)


def _resident(*names: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    values = dict(line.split(":", 1) for line in lines)
    return 1024 * sum(int(values[name].split()[0]) for name in names)


CASES: Cases = {
    "file-press": partial(run_press, "file-press", "raw"),
    "file-press-packed": partial(run_press, "file-press-packed", "bitshuffle"),
    "file-turns": run_turns,
    "file-lab": run_lab,
    "file-budget": run_budget,
    "file-zarr": partial(run_zarr, "file-zarr", "a local folder"),
    "file-s3": partial(run_zarr, "file-s3", "a server on this machine"),
}

if __name__ == "__main__":
    _watch_memory()
