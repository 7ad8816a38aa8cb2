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
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.cli.commands.bench.timing import OURS
from mirrorskin.engine import reconstruct
from mirrorskin.io.base.types import Closing, Floats
from mirrorskin.io.files.recorder import Compression
from mirrorskin.kernels.device import Device
from suite.scenes import STEPS, TILT, fill_press, fill_turns, phases, references

PATH = f"{OURS}, file to result"
ROUNDS = 7
MAPS = 128  # bytes per pixel for all maps, in memory or in files

_PAGE, _PADDING = 4096, 64  # frames start on a page, and a kernel may load the last word as a whole
_LEANS = 7.0  # distance from the centre of the picture at which the pressed ball has a zenith of 45°, mm
_DIFFERENT = 64  # number of turns after which the frames repeat


class Frames(Closing):
    """Frames in memory, (T, H, W), as a source; positions, (T,), are travel in mm or phase in radians."""

    name, rewindable = "frames in memory", True

    def __init__(self, frames: NDArray[Any], header: io.Header, positions: Floats) -> None:
        self.header, self.motion = header, header.motion
        self.shape = (len(frames), frames.shape[1], frames.shape[2])
        self.dtype = frames.dtype
        self._frames, self._positions = frames, positions
        self._next = 0

    @property
    def block(self) -> io.Block:
        """All frames as one block, which a device can use in place."""
        return self._part(0, len(self._frames))

    def first(self, count: int) -> Frames:
        """Return a source of the first frames."""
        return Frames(self._frames[:count], self.header, self._positions[:count])

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> io.Block | None:
        """Return the next frames in place; see ``Source.read``."""
        start = self._next
        self._next = min(start + (1 if out is None else len(out)), len(self._frames))
        return self._part(start, self._next) if start < self._next else None

    def _part(self, start: int, stop: int) -> io.Block:
        axis = "travel" if self.motion == "vertical" else "phase"
        positions: dict[str, Any] = {axis: self._positions[start:stop]}
        return io.Block(self._frames[start:stop], start, stays_valid=True, **positions)


def shared_memory(shape: tuple[int, ...], dtype: Any = np.uint8) -> NDArray[Any]:
    """Allocate memory that a device can use in place; its pages are mapped before anything is timed."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    raw = np.full(size + _PAGE + _PADDING, 1, np.uint8)
    start = -raw.ctypes.data % _PAGE
    frames: NDArray[Any] = raw[start : start + size].view(dtype).reshape(shape)
    return frames


def make_press(shape: tuple[int, int, int]) -> Frames:
    """Return a press of a ball, uint8, with reference levels of each pixel."""
    frames = shared_memory(shape)
    fill_press(frames)
    dark, bright = references(shape[1:], frames.dtype)
    step = _LEANS * (2**0.5 - 1) / (0.9 * shape[0])
    header = io.Header("vertical", dark=dark, bright=bright)
    return Frames(frames, header, np.arange(shape[0], dtype=np.float64) * step)


def make_turns(shape: tuple[int, int, int]) -> Frames:
    """Return a rotation, uint8, whose turns repeat, without zenith gain and pixel size."""
    frames = shared_memory(shape)
    different = min(shape[0], _DIFFERENT * STEPS)
    fill_turns(frames[:different])
    for start in range(different, shape[0], different):
        part = frames[start : start + different]
        part[:] = frames[: len(part)]
    return Frames(frames, io.Header("axial", tilt=TILT), phases(shape[0]))


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
