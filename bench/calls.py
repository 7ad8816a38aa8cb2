"""Whole calls: functions on arrays that no peer has, commands and imports in processes of their own.

The functions that peers have too are in the modules of their kernels.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin import engine
from mirrorskin.bench.files import new_folder
from mirrorskin.bench.harness import OURS, Case, Cases, Measured, Row, Target, Timing, check_memory
from mirrorskin.bench.limits import time_call
from mirrorskin.bench.scenes import (
    LEVELS,
    PIXEL,
    SCALES,
    STEPS,
    TILT,
    Shape,
    fill_press,
    fill_turns,
    phases,
    press_noise,
    roof,
    travel_of,
    turn_noise,
)
from mirrorskin.hw.twin import Axial, Twin, Vertical
from mirrorskin.io import Recorder
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.errors import DeviceError

_SIZES: dict[str, Shape] = {"": (1080, 1920), "-4k": (2160, 3840)}
_QUICK: Shape = (48, 64)
_PRESS = 16  # frames
_ROOM = 400  # bytes of a pixel for maps and what is kept
_BYTE = np.dtype(np.uint8)

_SCENE, _QUICK_SCENE = (480, 480), (96, 96)
_FRAMES = 30  # of a press that a command reconstructs
_FIELD = 12.0  # side of its picture, mm
_ROUNDS = 7
_WITHIN = {"reconstruct press": 0.5, "reconstruct turn": 0.5, "fuse": 1.5}  # seconds of a command


def _change_point(shape: Shape, device: Device) -> tuple[Callable[[], object], int, int]:
    frames = np.empty((_PRESS, *shape), np.uint8)
    fill_press(frames)
    dark, bright = LEVELS[_BYTE.name]
    known: dict[str, Any] = {"dark": dark, "bright": bright, "noise": press_noise(_BYTE), "device": device}
    call = partial(engine.find_change_point, frames, travel_of(_PRESS), **known)
    return call, frames.nbytes, _PRESS


def _edges(shape: Shape, device: Device) -> tuple[Callable[[], object], int, int]:
    maps = roof(shape)
    return partial(engine.find_edges, *maps, device=device), sum(one.nbytes for one in maps), 0


def _fuse(shape: Shape, device: Device) -> tuple[Callable[[], object], int, int]:
    frames, turns = (np.empty((count, *shape), np.uint8) for count in (_PRESS, STEPS))
    fill_press(frames)
    fill_turns(turns)
    offset, gain, _ = SCALES[_BYTE.name]
    dark, bright = LEVELS[_BYTE.name]
    onset = engine.find_onset(frames, travel_of(_PRESS), dark=dark, bright=bright, device=device)
    known: dict[str, Any] = {"tilt": TILT, "gain": gain, "offset": offset, "noise": turn_noise(_BYTE)}
    normals = engine.estimate_normals(turns, phases(STEPS), device=device, **known)
    moved = onset.height.nbytes + normals.vectors.nbytes
    return partial(engine.fuse, onset, normals, PIXEL, device=device), moved, 0


_FUNCTIONS = {
    "change-point": (f"change-points between known levels of {_PRESS} x {{}} uint8", _change_point),
    "edges": ("edges of normals of {}", _edges),
    "fuse": (f"one surface of a press of {_PRESS} and a turn of {STEPS} x {{}}", _fuse),
}


def _run_function(name: str, function: str, shape: Shape, device: Device, quick: bool) -> Case:
    shape = _QUICK if quick else shape
    check_memory(name, (_ROOM + 2 * _PRESS) * math.prod(shape))
    title, make = _FUNCTIONS[function]
    call, moved, frames = make(shape, device)
    return time_call(
        name, title.format(f"{shape[0]} x {shape[1]}"), call, moved, device, quick, frames=frames
    )


def _run_commands(device: Device, quick: bool) -> Case:
    """Time commands from process start to end: a press, a turn, and both fused."""
    shape, name = _QUICK_SCENE if quick else _SCENE, "call-commands"
    movements = {"press": Vertical(np.linspace(0.1, 3.0, _FRAMES)), "turn": Axial(phases(STEPS), TILT, 1.0)}
    rows, targets = [], []
    with new_folder(name, 4 * (_FRAMES + STEPS) * math.prod(shape)) as folder:
        recordings = {what: folder / f"{what}.h5" for what in movements}
        for what, movement in movements.items():
            known: dict[str, Any] = {"pixel_size": _FIELD / shape[0], "movement": movement, "device": device}
            twin = Twin(object="sphere", shape=shape, pattern="linear", **known)
            with Recorder(twin, recordings[what]) as recorder:
                recorder.drain(lambda count: None)
        inputs = {f"reconstruct {what}": [str(path)] for what, path in recordings.items()}
        for what, words in {**inputs, "fuse": [str(path) for path in recordings.values()]}.items():
            made = folder / "result.h5"
            command = [sys.executable, "-m", "mirrorskin.cli.main", what.split()[0], *words]
            command += ["-o", str(made), "--json", "--device", device.info.title]
            row = Row(f"{OURS} {what}", _time_process(command, 1 if quick else _ROUNDS, made))
            rows.append(row)
            most, took = _WITHIN[what], row.measured.wall.median
            targets.append(Target(row.name, f"at most {most:g} s", f"{took:.2f} s", took <= most))
    title = f"commands on a press of {_FRAMES} and a turn of {STEPS} x {shape[0]} x {shape[1]} uint8"
    return Case(name, title, rows, {}, tuple(map(_share, rows)), () if quick else tuple(targets))


def _run_import(_: Device, quick: bool) -> Case:
    """Time processes that import the engine, what a press or a turn needs of it, and NumPy alone."""
    lines = "import mirrorskin.engine", "from mirrorskin.engine import reconstruct", "import numpy"
    rounds = 1 if quick else _ROUNDS
    rows = [Row(line, _time_process([sys.executable, "-c", line], rounds)) for line in lines]
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


def _share(row: Row) -> str:
    """Say which share of a command is in kernels."""
    wall, kernel = row.measured.wall.median, row.measured.kernel
    return f"{row.name}: {1e3 * wall:.0f} ms, {100 * kernel / wall:.0f} % in kernels"


CASES: Cases = {
    **{
        f"call-{function}{size}": partial(_run_function, f"call-{function}{size}", function, shape)
        for function in _FUNCTIONS
        for size, shape in _SIZES.items()
    },
    "call-commands": _run_commands,
    "call-import": _run_import,
}
