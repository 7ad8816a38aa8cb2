"""Recordings for the cases: sources in memory, files, and the path from a file to a result."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin import io
from mirrorskin.cli.commands.bench.paced import shared_memory
from mirrorskin.cli.commands.bench.timing import OURS
from mirrorskin.engine import reconstruct
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.scenes.inputs import STEPS, TILT, fill_press, fill_turns, phases, references
from mirrorskin.io.files.recorder import Compression
from mirrorskin.kernels.device import Device

PATH = f"{OURS}, file to result"
ROUNDS = 7
MAPS = 128  # bytes per pixel for all maps, in memory or in files

_LEANS = 7.0  # distance from the centre of the picture at which the pressed ball has a zenith of 45°, mm
_DIFFERENT = 64  # number of turns after which the frames repeat


def make_press(shape: tuple[int, int, int]) -> Frames:
    """Return a press of a ball, uint8, with reference levels of each pixel."""
    frames = shared_memory(shape)
    fill_press(frames)
    dark, bright = references(shape[1:], frames.dtype)
    step = _LEANS * (2**0.5 - 1) / (0.9 * shape[0])
    header = io.Header("vertical", dark=dark, bright=bright)
    return Frames(frames, header, travel=np.arange(shape[0], dtype=np.float64) * step)


def make_turns(shape: tuple[int, int, int]) -> Frames:
    """Return a rotation, uint8, whose turns repeat, without zenith gain and pixel size."""
    frames = shared_memory(shape)
    different = min(shape[0], _DIFFERENT * STEPS)
    fill_turns(frames[:different])
    for start in range(different, shape[0], different):
        part = frames[start : start + different]
        part[:] = frames[: len(part)]
    return Frames(frames, io.Header("axial", tilt=TILT), phase=phases(shape[0]))


@contextmanager
def new_folder(name: str, needed: int) -> Iterator[Path]:
    """Make a temporary folder, and remove it with its content afterwards.

    Raises InputError if less than `needed` bytes are free.
    """
    with tempfile.TemporaryDirectory(prefix="mirrorskin-bench-") as folder:
        free = shutil.disk_usage(folder).free
        if free < needed:
            raise io.InputError(
                f"case {name}: {needed / 1e9:.1f} GB are needed in {tempfile.gettempdir()} and"
                f" {free / 1e9:.1f} GB are free. Choose another folder with --folder, or name other cases"
            )
        yield Path(folder)


def record(source: Frames, path: Path, compression: Compression = "raw") -> None:
    """Write a recording and wait for the disk, so that no write is pending during timing."""
    source.rewind()
    with io.Recorder(source, path, compression, overwrite=True) as recorder:
        recorder.drain()
    sync(path)


def sync(path: Path) -> None:
    """Wait until a file is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def to_result(
    source: Path, target: Path, device: Device, opening: Mapping[str, Any] | None = None, **options: Any
) -> io.Result:
    """Open a recording, reconstruct it, and save the result."""
    with io.open_recording(source, **(opening or {})) as recording:
        result = reconstruct(recording, device=device, **options)
    io.save_result(result, target, overwrite=True)
    return result


def to_new_results(source: Path, target: Path, device: Device, **options: Any) -> Callable[[], io.Result]:
    """Return a function that does the same with a new file each time, because replacing one takes longer."""
    numbers = count()

    def work() -> io.Result:
        number = next(numbers)
        name = target.with_stem(f"{target.stem}-{number}") if number else target
        return to_result(source, name, device, **options)

    return work
