"""Whole paths from a file to a result in a file: a press, turns, what a lab would write, and memory.

Aims: contiguous frames in 1.25 times what the kernel takes in memory, packed ones in 1.15 times what
decoding takes, turns at 70 % of what binds, ten times as fast as h5py and NumPy, and within the memory that
is allowed.
"""

from __future__ import annotations

import functools
import gc
import json
import math
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.files import (
    MAPS,
    PATH,
    ROUNDS,
    Frames,
    make_press,
    make_turns,
    new_folder,
    record,
    shared_memory,
    sync,
    to_new_results,
    to_result,
)
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
    missing,
    pusher,
    ratio_target,
)
from mirrorskin.bench.limits import beside_limits
from mirrorskin.bench.object_store import object_store
from mirrorskin.bench.onset import numba_onsets
from mirrorskin.bench.scenes import SCALES, STEPS, TILT, Floats, references
from mirrorskin.engine import Correlator, NormalEstimator, Onset, OnsetSearch
from mirrorskin.engine.streaming import push_block
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io.url import path_of
from mirrorskin.kernels.device import Device, list_devices, open_device

Shape = tuple[int, int, int]

KERNEL, IN_MEMORY = f"{OURS}, onset kernel in memory", f"{OURS}, onset kernel and maps in memory"
READ, H5PY = f"{OURS}, frames read", "h5py, frames read"
PLAIN = f"{PATH}, equation 4"
_ZARR_PATH, _OBJECTS = f"{PATH}, from Zarr", "s3fs, objects fetched"

_QUICK, _QUICK_TURNS = (12, 48, 64), (64, 48, 64)
_PRESS, _TURNS, _LAB, _BUDGET = (1907, 1024, 1024), (16_000, 240, 320), (256, 1080, 1920), (6_500, 480, 640)
_ZARR = (480, 480, 640)
_PAGE = 4096
_CACHED, _REPEATS = 4 * STEPS, 16  # frames that stay in the cache, and how often they are taken
_LIMIT_SHARE = 0.7
_ROUNDING = 1e-6  # mm
_TIMES, _MORE = 10, 1.1  # by which a file is larger than the budget, and of that what may be taken
_FEW = 8  # frames that are reconstructed before memory is watched


def onset_maps(onset: Onset) -> dict[str, NDArray[Any]]:
    """Return the maps of a search under their names in a result."""
    return {"height": onset.height, "height_sigma": onset.sigma, "status": onset.status}


def search_of(source: Frames, device: Device) -> OnsetSearch:
    """Return the search that `reconstruct` makes for a press, by default."""
    header = source.header
    return OnsetSearch(source.shape[1:], source.dtype, dark=header.dark, bright=header.bright, device=device)


def run_press(name: str, compression: Literal["raw", "bitshuffle"], device: Device, quick: bool) -> Case:
    """Time the path of a press and its parts beside the kernel in memory; maps must be the same first."""
    shape = _QUICK if quick else _PRESS
    size, extra, rounds = math.prod(shape), MAPS * math.prod(shape[1:]), 1 if quick else ROUNDS
    check_memory(name, 3 * size + MEMORY_LIMIT + extra)
    with new_folder(name, size + rounds * extra) as folder:
        press, path = make_press(shape), folder / "press.h5"
        record(press, path, compression)
        search, block = search_of(press, device), press.block
        push, find = (
            pusher(search, block.frames, maps=maps, travel=block.travel, lent=True) for maps in (False, True)
        )
        with io.open_recording(path) as recording:
            works: dict[str, Work] = {
                KERNEL: push,
                IN_MEMORY: find,
                PATH: to_new_results(path, folder / "result.h5", device),
                READ: partial(_fetch, recording, _room(recording)),
                H5PY: partial(_read_with_h5py, path, recording.dataset),
            }

            def check(results: dict[str, Any]) -> None:
                expected = onset_maps(results[IN_MEMORY])
                agree(PATH, results[PATH].maps(), expected, whose=IN_MEMORY)
                agree(
                    f"{PATH}, saved", io.open_result(folder / "result.h5").maps(), expected, whose=IN_MEMORY
                )

            limits, measured = beside_limits(works, size, device, quick, check, rounds=ROUNDS)
            notes = (f"frames: {recording.storage}; {recording.how}",)
    rows = {work: Row(work, measured[work], size, shape[0]) for work in works}
    if compression == "raw":
        bound, other, than = 1.25, KERNEL, "the onset kernel on the same frames in memory"
    else:
        bound, other, than = 1.15, READ, "decoding alone with the same threads"
    target = ratio_target(PATH, bound, rows[PATH], rows[other], than, faster=False)
    stored = "contiguous" if compression == "raw" else "bitshuffle-LZ4, one chunk a frame"
    title = f"full default, references of each pixel; {_size(shape)}, {stored}"
    return Case(name, title, limits + list(rows.values()), {}, notes, () if quick else (target,))


def run_zarr(device: Device, quick: bool) -> Case:
    """Time the path of a press in Zarr beside that in HDF5, packed alike; results must be the same bits."""
    return _beside_hdf5("file-zarr", "a local folder", missing("zarr"), device, quick)


def run_s3(device: Device, quick: bool) -> Case:
    """Time the path of a press in an S3-compatible server beside its objects alone, and beside HDF5."""
    return _beside_hdf5("file-s3", "a server on this machine", missing("zarr", "s3fs", "moto"), device, quick)


def _beside_hdf5(name: str, place: str, absent: dict[str, str], device: Device, quick: bool) -> Case:
    shape = _QUICK if quick else _ZARR
    title = f"full default, references of each pixel; {_size(shape)}, bitshuffle-LZ4 in {place}"
    if absent:
        return Case(name, title, [], absent)
    size, extra, rounds = math.prod(shape), MAPS * math.prod(shape[1:]), 1 if quick else ROUNDS
    check_memory(name, 3 * size + MEMORY_LIMIT + extra)
    with ExitStack() as stack:
        folder = stack.enter_context(new_folder(name, 3 * size + 2 * rounds * extra))
        path, copy = folder / "press.h5", folder / "press.zarr"
        works: dict[str, Work] = {}
        if name == "file-s3":
            files, copy = stack.enter_context(object_store("bench")), path_of("s3://bench/press.zarr")
            works[_OBJECTS] = lambda: files.cat(files.find("bench/press.zarr"))
        record(make_press(shape), path, "bitshuffle")
        storage = io.save_zarr(path, copy)
        first, second = (stack.enter_context(io.open_recording(one)) for one in (path, copy))
        works |= {
            PATH: to_new_results(path, folder / "hdf5.h5", device),
            _ZARR_PATH: to_new_results(copy, folder / "zarr.h5", device),
            READ: partial(_fetch, first, _room(first)),
            f"{READ} from Zarr": partial(_fetch, second, _room(second)),
        }

        def check(results: dict[str, Any]) -> None:
            maps = results[PATH].maps()
            if any(maps[one].tobytes() != got.tobytes() for one, got in results[_ZARR_PATH].maps().items()):
                raise DisagreementError(f"{_ZARR_PATH}: not the bits of HDF5")

        limits, measured = beside_limits(works, size, device, quick, check, rounds=rounds)
        notes = (f"HDF5: {first.storage}; {first.how}", f"Zarr: {storage}; {second.how}")
    rows = {work: Row(work, measured[work], size, shape[0]) for work in works}
    other, than = (_OBJECTS, "its objects alone") if _OBJECTS in rows else (PATH, "HDF5, packed alike")
    target = ratio_target(_ZARR_PATH, 1.5, rows[_ZARR_PATH], rows[other], than, faster=False)
    return Case(name, title, limits + list(rows.values()), {}, notes, () if quick else (target,))


def run_turns(name: str, wanted: Literal["normals", "wave"], device: Device, quick: bool) -> Case:
    """Time the path of very many turns, to normals or the wave, beside limits and kernels in memory."""
    shape = _QUICK_TURNS if quick else _TURNS
    size, extra, rounds = math.prod(shape), MAPS * math.prod(shape[1:]), 1 if quick else ROUNDS
    check_memory(name, 3 * size + MEMORY_LIMIT + extra)
    offset, gain, _ = SCALES["uint8"]
    options: dict[str, Any] = {"gain": gain, "offset": offset} if wanted == "normals" else {}
    kernels, cached = f"{OURS}, kernels and maps in memory", f"{OURS}, kernels in memory, frames in the cache"

    def estimator() -> Correlator | NormalEstimator:
        if wanted == "wave":
            return Correlator(shape[1:], np.uint8, device=device)
        return NormalEstimator(shape[1:], np.uint8, tilt=TILT, longest=STEPS, device=device, **options)

    def answer(one: Correlator | NormalEstimator, block: io.Block, times: int) -> Any:
        one.reset()
        for _ in range(times):
            push_block(one, block)
        return one.result()

    with new_folder(name, size + rounds * extra) as folder:
        turns, path = make_turns(shape), folder / "turns.h5"
        record(turns, path)
        with io.open_recording(path) as recording:
            works: dict[str, Work] = {
                kernels: partial(answer, estimator(), turns.block, 1),
                PATH: to_new_results(path, folder / "result.h5", device, **options),
                READ: partial(_fetch, recording, _room(recording)),
                H5PY: partial(_read_with_h5py, path, recording.dataset),
            }
            beside = {cached: partial(answer, estimator(), turns.first(_CACHED).block, _REPEATS)}

            def check(results: dict[str, Any]) -> None:
                found = results[kernels]
                words = {"normals": "vectors", "normals_sigma": "sigma", "contact": "contact"}
                words = words if wanted == "normals" else {"cosine": "cosine", "sine": "sine"}
                words |= {"mean": "mean", "residual": "residual"}
                expected = {word: getattr(found, mine) for word, mine in words.items()}
                agree(PATH, results[PATH].maps(), expected, whose=kernels)
                agree(f"{PATH}, saved", io.open_result(folder / "result.h5").maps(), expected, whose=kernels)

            limit, measured = beside_limits({**works, **beside}, size, device, quick, check, rounds=ROUNDS)
    rows = {work: Row(work, measured[work], size, shape[0]) for work in works}
    # By the device's account: of short runs, the host's clock measures what calls cost.
    alone = replace(measured[cached], wall=measured[cached].device["kernel"])
    frames = _REPEATS * min(_CACHED, shape[0])
    rows[cached] = Row(cached, alone, frames * math.prod(shape[1:]), frames)
    known = {"read": limit[0].bandwidth, "arithmetic": rows[cached].bandwidth}
    binds = min(known, key=lambda one: known[one])
    share, rate = rows[PATH].bandwidth / known[binds], rows[PATH].bandwidth / 1e9
    least = "of read bandwidth, or of the arithmetic limit where that is less"
    bound = f"at least {100 * _LIMIT_SHARE:.0f} % {least}"
    limits_said = ", ".join(f"{one} {bandwidth / 1e9:.2f} GB/s" for one, bandwidth in known.items())
    value = f"{100 * share:.0f} % of {binds} ({rate:.2f} GB/s; limits: {limits_said})"
    target = Target(PATH, bound, value, share >= _LIMIT_SHARE)
    what = "exact method to normals" if wanted == "normals" else "mean, cosine, sine and residual"
    title = f"{what}, mean of {shape[0] // STEPS} turns, no heights; {_size(shape)}, contiguous"
    return Case(name, title, limit + list(rows.values()), {}, (), () if quick else (target,))


def _size(shape: Shape) -> str:
    return f"{' x '.join(map(str, shape))} uint8"


def _room(recording: io.Recording) -> NDArray[Any]:
    """Return as much room for frames as a reconstruction has, and keeps for the next one."""
    length = MEMORY_LIMIT // (2 * math.prod(recording.shape[1:]) * recording.dtype.itemsize)
    return shared_memory((min(max(1, length), recording.shape[0]), *recording.shape[1:]), recording.dtype)


def _fetch(recording: io.Recording, room: NDArray[Any]) -> None:
    """Read all frames, of those that are lent one byte a page."""
    recording.rewind()
    while (block := recording.read(room)) is not None:
        if block.lent:
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
    """Time what a lab would write beside the full default and equation 4; heights must be the same first."""
    shape = _QUICK if quick else _LAB
    size, extra = math.prod(shape), MAPS * math.prod(shape[1:])
    check_memory("file-lab", 4 * size + extra)
    absent, labs = missing("numba"), {"h5py and NumPy argmax": _lab_argmax}
    labs |= {} if absent else {"h5py and Numba": _lab_numba, "h5py and Numba in tiles": _lab_tiles}
    with new_folder("file-lab", size + 10 * extra) as folder:
        press, path = make_press(shape), folder / "press.h5"
        record(press, path)
        with io.open_recording(path) as recording:
            dataset = recording.dataset
        known = path, dataset, *references(shape[1:], press.dtype), folder / "heights.npy"
        works: dict[str, Work] = {
            PATH: partial(to_result, path, folder / "result.h5", device),
            PLAIN: partial(to_result, path, folder / "plain.h5", device, subframe=False),
        }
        works |= {f"{name}, file to result": partial(lab, *known) for name, lab in labs.items()}

        def check(results: dict[str, Any]) -> None:
            full, plain = results[PATH].height, results[PLAIN].height
            for name in list(works)[2:]:
                agree(name, {"height": results[name]}, {"height": plain}, whose=PLAIN)
            assert press.block.travel is not None
            above, step = full - plain, press.block.travel[1] - press.block.travel[0]
            inside = (above > -_ROUNDING) & (above < step + _ROUNDING) | np.isnan(full) & np.isnan(plain)
            if not inside.all():
                off = f"{np.count_nonzero(~inside)} heights lie outside of the step of equation 4"
                raise DisagreementError(f"{PATH}: {off}; nothing was timed")

        limits, measured = beside_limits(works, size, device, quick, check, rounds=ROUNDS)
    rows = {work: Row(work, measured[work], size, shape[0]) for work in works}
    targets = tuple(
        ratio_target(PATH, bound, rows[PATH], rows[name], name, faster=True)
        for name, bound in (
            ("h5py and NumPy argmax, file to result", 10.0),
            ("h5py and Numba, file to result", 2.0),
        )
        if name in rows and not quick
    )
    title = (
        f"heights by equation 4 with hold 2, saved; ours the full default as well; {_size(shape)}, contiguous"
    )
    return Case("file-lab", title, [*limits, *rows.values()], absent, (), targets)


def _lab_argmax(path: Path, dataset: str, dark: Floats, bright: Floats, target: Path) -> Floats:
    """Read with h5py, compare each frame as it is normalised, and look for the first light one with NumPy."""
    import h5py

    span = bright - dark
    with h5py.File(path) as file:
        stack, travel = file[dataset], _travel_in(file)
        light = np.empty(stack.shape, bool)
        for number in range(len(stack)):
            light[number] = (stack[number] - dark) / span >= 0.5
    light[:-1] &= light[1:]  # two in a row, so that a spike of noise makes no onset
    onset = np.where(light.any(axis=0), light.argmax(axis=0), -1)
    return _save(onset, travel, target)


def _lab_numba(path: Path, dataset: str, dark: Floats, bright: Floats, target: Path) -> Floats:
    """Do the same loop with a Numba kernel: in each frame, all pixels on all cores."""
    import h5py

    look, level = _numba_look(), _light_level(dark, bright)
    with h5py.File(path) as file:
        stack, travel = file[dataset], _travel_in(file)
        frame, was_light = np.empty(stack.shape[1:], stack.dtype), np.zeros(level.shape, bool)
        onset = np.full(level.shape, -1, np.int32)
        for number in range(len(stack)):
            stack.read_direct(frame, np.s_[number])
            look(frame.reshape(-1), level.reshape(-1), number, was_light.reshape(-1), onset.reshape(-1))
    onset[(onset < 0) & was_light] = len(travel) - 1
    return _save(onset, travel, target)


def _lab_tiles(path: Path, dataset: str, dark: Floats, bright: Floats, target: Path) -> Floats:
    """Do it as one who knows Numba well, with as much memory as the frames take."""
    import h5py

    with h5py.File(path) as file:
        frames, travel = file[dataset][()], _travel_in(file)
    return _save(numba_onsets(frames, _light_level(dark, bright), 2), travel, target)


def _travel_in(file: Any) -> NDArray[np.float64]:
    return np.asarray(file["/entry/instrument/stage/travel"][()])


def _light_level(dark: Floats, bright: Floats) -> NDArray[np.uint8]:
    """Return the least count that is light; a dead pixel is dark."""
    level = np.ceil(dark + (bright - dark) / 2)
    return np.where(np.isnan(level), 255, level).astype(np.uint8)


def _save(onset: NDArray[Any], travel: NDArray[np.float64], target: Path) -> Floats:
    height = np.where(onset > 0, -travel[onset], np.nan).astype(np.float32)
    np.save(target, height)
    return height


@functools.cache
def _numba_look() -> Any:
    import numba

    def look(frame, level, number, was_light, onset):  # type: ignore[no-untyped-def]
        for p in numba.prange(len(frame)):
            light = frame[p] >= level[p]
            onset[p] = number - 1 if (onset[p] < 0) & light & was_light[p] else onset[p]
            was_light[p] = light

    return numba.njit(parallel=True)(look)


def run_budget(device: Device, quick: bool) -> Case:
    """Reconstruct files ten times as large as the memory that is allowed, in processes that watch theirs."""
    shape = _QUICK if quick else _BUDGET
    size, budget = math.prod(shape), math.prod(shape) // _TIMES
    title = f"peak memory of a process from file to result, file {_TIMES} times the budget; {_size(shape)}"
    if not Path("/proc/self/clear_refs").exists():
        return Case("file-budget", title, [], {OURS: "this system does not say how much memory is taken"})
    check_memory("file-budget", 2 * size)
    targets = []
    with new_folder("file-budget", 2 * size + MAPS * math.prod(shape[1:])) as folder:
        press = make_press(shape)
        search = search_of(press, device)
        push_block(search, press.block)
        expected = onset_maps(search.result())
        number = [one.title for one in list_devices()].index(device.info.title)
        for kind, write in _KINDS.items():
            few, source, target = (folder / f"{name}.h5" for name in ("few", "press", "result"))
            write(press.first(_FEW), few)
            write(press, source)
            words = [*map(str, (few, source, target, budget, number))]
            command = [sys.executable, "-m", "mirrorskin.bench.paths", *words]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            source.unlink()
            agree(f"{OURS}, {kind}", io.open_result(target).maps(), expected)
            peak, own = json.loads(done.stdout)
            bound = f"at most {_MORE * budget / 1e6:.0f} MB, the budget of {budget / 1e6:.0f} and 10 %"
            value = f"{own / 1e6:.0f} MB, and {max(0, peak - own) / 1e6:.0f} of the files' pages in the cache"
            targets.append(Target(f"{OURS}, peak memory, {kind}", bound, value, own <= _MORE * budget))
    return Case("file-budget", title, [], {}, (), () if quick else tuple(targets))


def _write_long(press: Frames, path: Path) -> None:
    """Write chunks of few pixels and many frames, packed, as programs do that look at pixels over time."""
    import h5py
    import hdf5plugin

    from mirrorskin.io.layout import SERIES, STACK

    record(press.first(2), path)
    block, travel = press.block, SERIES["travel"][0]
    chunk = tuple(max(1, length // 8) for length in press.shape)
    with h5py.File(path, "r+") as file:
        del file[STACK], file[travel]
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
    """Reconstruct what the command line names, and print how many bytes that took on top, as JSON.

    First all that is resident by the system's own count, pages of mapped files as well; then the most that
    was seen of the process's own alone. A recording of few frames goes before: what is loaded once is there.
    """
    few, source, target, budget, number = sys.argv[1:]
    device, limit = open_device(number), int(budget)
    within: dict[str, Any] = {"opening": {"memory_limit": limit}, "memory_limit": limit}
    to_result(Path(few), Path(target), device, **within)
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    before, own = _resident("VmRSS"), _resident("RssAnon", "RssShmem")
    most, done = own, threading.Event()

    def look() -> None:
        nonlocal most
        while not done.wait(0.001):
            most = max(most, _resident("RssAnon", "RssShmem"))

    watcher = threading.Thread(target=look)
    watcher.start()
    to_result(Path(source), Path(target), device, **within)
    done.set()
    watcher.join()
    json.dump([_resident("VmHWM") - before, most - own], sys.stdout)


def _resident(*names: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    known = dict(line.split(":", 1) for line in lines)
    return 1024 * sum(int(known[name].split()[0]) for name in names)


CASES: Cases = {
    "file-press": partial(run_press, "file-press", "raw"),
    "file-press-packed": partial(run_press, "file-press-packed", "bitshuffle"),
    "file-turns": partial(run_turns, "file-turns", "normals"),
    "file-turns-wave": partial(run_turns, "file-turns-wave", "wave"),
    "file-lab": run_lab,
    "file-budget": run_budget,
    "file-zarr": run_zarr,
    "file-s3": run_s3,
}

if __name__ == "__main__":
    _watch_memory()
