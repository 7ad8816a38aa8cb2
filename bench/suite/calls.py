"""Whole calls: functions on arrays of several sizes, and commands and imports in new processes."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin import engine
from mirrorskin.bench.suite.files import new_folder
from mirrorskin.bench.suite.harness import Cases, check_memory
from mirrorskin.cli.commands.bench.records import Case, Row, Target, Timing
from mirrorskin.cli.commands.bench.timing import OURS, ROUNDS, Work, take_turns
from mirrorskin.evaluation.scenes.inputs import (
    LEVELS,
    SCALES,
    STEPS,
    TILT,
    Shape,
    fill_press,
    fill_turns,
    phases,
    travel_of,
)
from mirrorskin.io import MirrorskinWarning, Recorder
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.errors import DeviceError
from mirrorskin.twin import Axial, Twin, Vertical

_HD, _QUICK = (1080, 1920), (48, 64)
_PRESS = 16  # frames
_SIZES, _TRAVELS, _TURN = ((48, 64), (480, 640), (1024, 1024)), 64, 16  # pictures; frames of both motions
_WORKING = 400  # bytes per pixel for maps and cached memory
_BYTE = np.dtype(np.uint8)

_SCENE, _QUICK_SCENE = (480, 480), (96, 96)
_FRAMES = 30  # frames of the press that a command reconstructs
_FIELD = 12.0  # side of its picture, mm
_ROUNDS = 7
_WITHIN = {"reconstruct press": 0.5, "reconstruct turn": 0.5, "fuse": 1.5}  # limits of commands, seconds
_KINDS = "upload", "kernel", "download"


def run_sizes(device: Device, quick: bool) -> Case:
    """Time functions on arrays of several sizes, whose checks do not grow with them; also processor time."""
    works, used, largest = dict[str, Work](), dict[str, list[float]](), max(map(math.prod, _SIZES))
    check_memory("call-sizes", (_WORKING + 2 * (_TRAVELS + _TURN)) * largest)
    for shape in _SIZES[:1] if quick else _SIZES:
        for title, call in _of_size(shape, device):
            name = f"{OURS} {title}, {shape[0]} x {shape[1]}"
            works[name] = Work(partial(_add_processor_time, call, used.setdefault(name, [])))
    rows = take_turns(works, 1 if quick else ROUNDS, device.profile)
    notes = (
        f"{name}: {1e3 * row.wall.median:.2f} ms, {1e3 * np.median(used[name][1:]):.2f} of the processors,"
        f" {1e3 * row.kernel:.2f} in kernels"
        for name, row in rows.items()
    )
    title = f"functions on a press of {_TRAVELS} and a turn of {_TURN} uint8"
    return Case("call-sizes", title, list(rows.values()), {}, tuple(notes))


def _of_size(shape: Shape, device: Device) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield titles and calls of functions on arrays."""
    frames, turns = (np.empty((count, *shape), np.uint8) for count in (_TRAVELS, _TURN))
    fill_press(frames)
    fill_turns(turns)
    travel, (dark, bright), (offset, gain, _) = travel_of(_TRAVELS), LEVELS[_BYTE.name], SCALES[_BYTE.name]
    levels: dict[str, Any] = {"dark": dark, "bright": bright}
    sensor: dict[str, Any] = {"tilt": TILT, "zenith_gain": gain, "zenith_offset": offset}
    press = ArrayRecording(frames, {"travel": travel}, levels)
    yield "find_onset", partial(engine.find_onset, frames, travel, **levels, device=device)
    yield "find_onset, no levels", partial(engine.find_onset, frames, travel, device=device)
    yield "reconstruct a press", partial(engine.reconstruct, press, device=device)
    yield "estimate_normals", partial(engine.estimate_normals, turns, phases(_TURN), **sensor, device=device)
    yield "correlate", partial(engine.correlate, turns, phases(_TURN), device=device)


def _add_processor_time(call: Callable[[], object], seconds: list[float]) -> object:
    """Return what a call returns, and add its seconds on all processors to a list."""
    start = time.process_time()
    with warnings.catch_warnings(action="ignore", category=MirrorskinWarning):  # frames are made up
        result = call()
    seconds.append(time.process_time() - start)
    return result


def run_commands(device: Device, quick: bool) -> Case:
    """Time commands from process start to end: reconstruction of a press and of a turn, and fusion."""
    shape, name = _QUICK_SCENE if quick else _SCENE, "call-commands"
    movements = {"press": Vertical(np.linspace(0.1, 3.0, _FRAMES)), "turn": Axial(phases(STEPS), TILT, 1.0)}
    rows, notes, targets = [], [], []
    with new_folder(name, 4 * (_FRAMES + STEPS) * math.prod(shape)) as folder:
        recordings = {what: folder / f"{what}.h5" for what in movements}
        for what, movement in movements.items():
            sensor: dict[str, Any] = {"pixel_size": _FIELD / shape[0], "movement": movement, "device": device}
            twin = Twin(object="sphere", shape=shape, pattern="linear", **sensor)
            with Recorder(twin, recordings[what]) as recorder:
                recorder.drain()
        inputs = {f"reconstruct {what}": [str(path)] for what, path in recordings.items()}
        for what, words in {**inputs, "fuse": [str(path) for path in recordings.values()]}.items():
            output = folder / "result.h5"
            command = [sys.executable, "-m", "mirrorskin.cli.main", what.split()[0], *words]
            command += ["-o", str(output), "--json", "--device", device.info.title]
            row = _time_process(f"{OURS} {what}", command, 1 if quick else _ROUNDS, output)
            limit, took = _WITHIN[what], row.wall.median
            rows.append(row)
            notes.append(f"{row.name}: {1e3 * took:.0f} ms, {100 * row.kernel / took:.0f} % in kernels")
            targets.append(Target(row.name, f"at most {limit:g} s", f"{took:.2f} s", took <= limit))
    title = f"commands on a press of {_FRAMES} and a turn of {STEPS} x {shape[0]} x {shape[1]} uint8"
    return Case(name, title, rows, {}, tuple(notes), () if quick else tuple(targets))


def run_import(_: Device, quick: bool) -> Case:
    """Time processes that import the engine, only `reconstruct`, and only NumPy."""
    lines = "import mirrorskin.engine", "from mirrorskin.engine import reconstruct", "import numpy"
    rounds = 1 if quick else _ROUNDS
    rows = [_time_process(line, [sys.executable, "-c", line], rounds) for line in lines]
    return Case("call-import", "a process that imports, from start to end", rows)


def _time_process(name: str, command: list[str], rounds: int, output: Path | None = None) -> Row:
    """Time a process after one untimed run; device times are read from the profile in its JSON.

    The `output` is removed before each run, because replacing a file takes longer.
    """
    seconds: list[float] = []
    profiles: list[list[dict[str, Any]]] = []
    for _ in range(rounds + 1):
        if output is not None:
            output.unlink(missing_ok=True)
        start = time.perf_counter()
        process = subprocess.run(command, capture_output=True, text=True)
        seconds.append(time.perf_counter() - start)
        if process.returncode:
            last = (process.stderr.strip() or "no message").splitlines()[-1]
            raise DeviceError(f"{' '.join(command[1:4])} ended with {process.returncode}: {last}")
        profiles.append(json.loads(process.stdout)["profile"] if process.stdout else [])

    def total(profile: list[dict[str, Any]], kind: str) -> float:
        return float(sum(record["seconds"] for record in profile if record["kind"] == kind))

    device = {kind: [total(profile, kind) for profile in profiles[1:]] for kind in _KINDS}
    kernels = [record for record in profiles[-1] if record["kind"] == "kernel"]
    return Row(
        name=name,
        wall=Timing.of(seconds[1:]),
        device={kind: Timing.of(values) for kind, values in device.items() if any(values)},
        kernels={record["name"]: record["seconds"] for record in kernels},
        moved={record["name"]: record["bytes"] for record in kernels},
        first=seconds[0],
        compile=total(profiles[0], "compile"),
    )


CASES: Cases = {
    "call-sizes": run_sizes,
    "call-commands": run_commands,
    "call-import": run_import,
}
