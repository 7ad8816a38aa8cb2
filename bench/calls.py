"""Whole calls as users make them: arrays in and maps out; commands and imports in processes of their own.

Each row has the seconds of its kernels beside those of the call: the rest is copies and host work.
Sizes: ``call-NAME`` is that of the paper's cameras, ``call-NAME-small`` 480 x 640 or less.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine
from mirrorskin.bench.files import make_press, make_turns, new_folder, record
from mirrorskin.bench.harness import OURS, Case, Cases, Measured, Row, Timing, check_memory
from mirrorskin.bench.limits import beside_limits
from mirrorskin.bench.scenes import (
    PIXEL,
    SCALES,
    STEPS,
    TILT,
    blob_mask,
    fill_press,
    fill_turns,
    noisy_slopes,
    phases,
    references,
    travel_of,
    turn_noise,
)
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.errors import DeviceError

Shape = tuple[int, int, int]
Run = Callable[[Device, bool], Case]

_HD, _VGA, _TINY = (1080, 1920), (480, 640), (8, 48, 64)
_PRESS = 30  # frames of a press that is reconstructed
_ROUNDS = 7
_ROOM = 200  # bytes of a pixel for maps and what is kept
_BYTE = np.dtype(np.uint8)


def run_onset(name: str, shape: Shape, device: Device, quick: bool) -> Case:
    """Time `find_onset` with references of each pixel."""
    frames = _frames(name, shape, fill_press)
    dark, bright = references(shape[1:], _BYTE)
    call = partial(engine.find_onset, frames, travel_of(shape[0]), dark=dark, bright=bright, device=device)
    title = f"onset of {_size(shape)}, references"
    return _run(name, title, {"find_onset": call}, frames.nbytes, device, quick)


def run_normals(name: str, shape: Shape, device: Device, quick: bool) -> Case:
    """Time `estimate_normals` of one turn."""
    frames = _frames(name, shape, fill_turns)
    offset, gain, _ = SCALES["uint8"]
    known: dict[str, Any] = {"tilt": TILT, "gain": gain, "offset": offset, "noise": turn_noise(_BYTE)}
    call = partial(engine.estimate_normals, frames, phases(shape[0]), device=device, **known)
    title = f"normals of {_size(shape)}"
    return _run(name, title, {"estimate_normals": call}, frames.nbytes, device, quick)


def run_correlate(name: str, shape: Shape, device: Device, quick: bool) -> Case:
    """Time `correlate`."""
    frames = _frames(name, shape, fill_turns)
    call = partial(engine.correlate, frames, phases(shape[0]), device=device)
    return _run(name, f"wave of {_size(shape)}", {"correlate": call}, frames.nbytes, device, quick)


def run_integrate(name: str, shape: Shape, device: Device, quick: bool) -> Case:
    """Time `integrate` of a full picture and within a mask, with standard deviations and without."""
    picture = shape[1:]
    dz_dx, dz_dy = noisy_slopes(picture)
    mask = blob_mask(picture)
    call = partial(engine.integrate, dz_dx, dz_dy, PIXEL, device=device)
    works = {
        "integrate": partial(call, sigma=False),
        "integrate, sigma": partial(call, sigma=True),
        "integrate within a mask": partial(call, mask=mask, sigma=False),
        "integrate within a mask, sigma": partial(call, mask=mask, sigma=True),
    }
    title = f"heights of slopes of {picture[0]} x {picture[1]}"
    return _run(name, title, works, 3 * dz_dx.nbytes, device, quick)


def _frames(name: str, shape: Shape, fill: Callable[[NDArray[Any]], None]) -> NDArray[np.uint8]:
    check_memory(name, (4 * shape[0] + _ROOM) * math.prod(shape[1:]))
    frames = np.empty(shape, np.uint8)
    fill(frames)
    return frames


def _run(
    name: str, title: str, works: Mapping[str, Callable[[], object]], moved: int, device: Device, quick: bool
) -> Case:
    limits, measured = beside_limits(works, moved, device, quick, rounds=_ROUNDS)
    rows = [Row(f"{OURS}, {work}", measured[work], moved) for work in works]
    return Case(name, title, [*limits, *rows], {}, tuple(map(_parts, rows)))


def run_reconstruct(name: str, shape: Shape, device: Device, quick: bool) -> Case:
    """Time the command ``mirrorskin reconstruct`` of a press and of a turn, from process start to end."""
    offset, gain, _ = SCALES["uint8"]
    known = {"zenith_gain": np.asarray(gain), "zenith_offset": np.asarray(offset), "pixel_size": (0.03, 0.03)}
    sources = {
        f"press of {_PRESS}": make_press((_PRESS, *shape[1:]), pixels=True),
        f"turn of {STEPS}": make_turns((STEPS, *shape[1:]), **known),
    }
    rows = []
    with new_folder(name, 4 * (_PRESS + STEPS) * math.prod(shape[1:])) as folder:
        for number, (what, source) in enumerate(sources.items()):
            path = folder / f"{number}.h5"
            record(source, path)
            words = ["reconstruct", str(path), "-o", str(folder / f"{number}-result.h5"), "--json"]
            words += ["--device", device.info.title]
            command = [sys.executable, "-m", "mirrorskin.cli.main", *words]
            measured = _time_process(command, 1 if quick else _ROUNDS, Path(words[3]))
            rows.append(
                Row(f"{OURS}, reconstruct, {what}", measured, math.prod(source.shape), source.shape[0])
            )
    title = f"the command reconstruct on {shape[1]} x {shape[2]} uint8, caches of kernels full"
    return Case(name, title, rows, {}, tuple(map(_parts, rows)))


def run_import(_: Device, quick: bool) -> Case:
    """Time processes that import the engine, what a press or a turn needs of it, and NumPy alone."""
    rows = []
    for line in ("import mirrorskin.engine", "from mirrorskin.engine import reconstruct", "import numpy"):
        measured = _time_process([sys.executable, "-c", line], 1 if quick else _ROUNDS)
        rows.append(Row(line, measured))
    return Case("call-import", "a process that imports, from start to end", rows, {})


def _time_process(command: list[str], rounds: int, made: Path | None = None) -> Measured:
    """Time a process, the first of which does not count; its device's account is the profile in its JSON.

    What it `made` is removed before each, since to replace a file takes longer.
    """
    seconds: list[float] = []
    profiles: list[list[dict[str, Any]]] = []
    for _ in range(rounds + 1):
        if made is not None:
            made.unlink(missing_ok=True)
        begun = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True)
        seconds.append(time.perf_counter() - begun)
        if done.returncode:
            last = (done.stderr.strip() or "it said nothing").splitlines()[-1]
            raise DeviceError(f"{' '.join(command[1:4])} ended with {done.returncode}: {last}")
        profiles.append(json.loads(done.stdout)["profile"] if done.stdout else [])

    def total(profile: list[dict[str, Any]], kind: str) -> float:
        return float(sum(record["seconds"] for record in profile if record["kind"] == kind))

    kinds: tuple[Any, ...] = ("upload", "kernel", "download")
    device = {kind: [total(profile, kind) for profile in profiles[1:]] for kind in kinds}
    last_records = [record for record in profiles[-1] if record["kind"] == "kernel"]
    return Measured(
        Timing.of(seconds[1:]),
        {kind: Timing.of(values) for kind, values in device.items() if any(values)},
        {record["name"]: record["seconds"] for record in last_records},
        {record["name"]: record["bytes"] for record in last_records},
        seconds[0],
        total(profiles[0], "compile"),
    )


def _parts(row: Row) -> str:
    """Say which share of a call is in kernels, and which in copies."""
    wall, device = row.measured.wall.median, row.measured.device
    copies = sum(device[kind].median for kind in device if kind != "kernel")
    kernel = device["kernel"].median if "kernel" in device else 0.0
    shares = f"{100 * kernel / wall:.0f} % in kernels, {100 * copies / wall:.0f} % in copies"
    return f"{row.name}: {1e3 * wall:.1f} ms, {shares}"


def _size(shape: tuple[int, ...]) -> str:
    return f"{' x '.join(map(str, shape))} uint8"


def _case(name: str, run: Callable[[str, Shape, Device, bool], Case], shape: Shape) -> Run:
    return lambda device, quick: run(name, _TINY if quick else shape, device, quick)


_CALLS: tuple[tuple[str, Callable[[str, Shape, Device, bool], Case], Shape, Shape], ...] = (
    ("call-onset", run_onset, (64, *_HD), (16, *_VGA)),
    ("call-normals", run_normals, (8, *_HD), (8, *_VGA)),
    ("call-correlate-8", run_correlate, (8, *_HD), (8, *_VGA)),
    ("call-correlate-64", run_correlate, (64, *_HD), (64, *_VGA)),
    ("call-integrate", run_integrate, (1, 1024, 1024), (1, 256, 256)),
    ("call-reconstruct", run_reconstruct, (1, 480, 480), (1, 120, 120)),
)
CASES: Cases = {
    name + size: _case(name + size, run, shape)
    for name, run, *shapes in _CALLS
    for size, shape in zip(("", "-small"), shapes, strict=True)
}
CASES["call-import"] = run_import
