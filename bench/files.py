"""Recordings to measure on, and what is done with them: frames in memory as a source, files, whole paths."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.harness import OURS, Work
from mirrorskin.bench.scenes import STEPS, TILT, fill_press, fill_turns, phases, references
from mirrorskin.engine import reconstruct
from mirrorskin.io.recorder import Compression
from mirrorskin.io.types import Closing, Floats
from mirrorskin.kernels.device import Device

PATH = f"{OURS}, file to result"
ROUNDS = 7
MAPS = 128  # bytes a pixel for all maps, in memory or in files

_PAGE, _SPARE = 4096, 64  # frames begin on a page, and a kernel may load the last word whole
_LEANS = 7.0  # mm from the picture's centre to where the pressed ball leans by 45 degrees
_SPAN = 2.1  # of that, from one side of the picture to the other
_UNLIKE = 64  # turns, after which the frames begin again


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
        """All frames at once, for a device to work in."""
        return self.part(0, len(self._frames))

    def part(self, start: int, stop: int) -> io.Block:
        """Return some of the frames where they lie."""
        axis = "travel" if self.motion == "vertical" else "phase"
        known: dict[str, Any] = {axis: self._positions[start:stop]}
        return io.Block(self._frames[start:stop], start, lent=True, **known)

    def first(self, count: int) -> Frames:
        """Return the first frames as a source of their own."""
        return Frames(self._frames[:count], self.header, self._positions[:count])

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> io.Block | None:
        """Return the next frames where they lie; see ``Source.read``."""
        start = self._next
        self._next = min(start + (1 if out is None else len(out)), len(self._frames))
        return self.part(start, self._next) if start < self._next else None


def shared_memory(shape: tuple[int, ...], dtype: Any = np.uint8) -> NDArray[Any]:
    """Make room for frames in which a device may work; touched, so that its pages are there when timed."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    raw = np.full(size + _PAGE + _SPARE, 1, np.uint8)
    start = -raw.ctypes.data % _PAGE
    frames: NDArray[Any] = raw[start : start + size].view(dtype).reshape(shape)
    return frames


def make_press(shape: tuple[int, int, int], *, pixels: bool = False) -> Frames:
    """Return a press of a ball, uint8, with references of each pixel, and with a pixel size if `pixels`."""
    frames = shared_memory(shape)
    fill_press(frames)
    dark, bright = references(shape[1:], frames.dtype)
    step = _LEANS * (2**0.5 - 1) / (0.9 * shape[0])
    size = (_SPAN * _LEANS / shape[2], _SPAN * _LEANS / shape[1]) if pixels else None
    header = io.Header("vertical", dark=dark, bright=bright, pixel_size=size)
    return Frames(frames, header, np.arange(shape[0], dtype=np.float64) * step)


def make_turns(shape: tuple[int, int, int], **header: Any) -> Frames:
    """Return a rotation, uint8, whose turns repeat; without zenith gain and pixel size unless given."""
    frames = shared_memory(shape)
    unlike = min(shape[0], _UNLIKE * STEPS)
    fill_turns(frames[:unlike])
    for start in range(unlike, shape[0], unlike):
        part = frames[start : start + unlike]
        part[:] = frames[: len(part)]
    return Frames(frames, io.Header("axial", tilt=TILT, **header), phases(shape[0]))


@contextmanager
def new_folder(name: str, needed: int) -> Iterator[Path]:
    """Make a folder where temporary files go, and remove it and what is in it afterwards.

    Raises InputError where there is no room for a case's files of `needed` bytes.
    """
    with tempfile.TemporaryDirectory(prefix="mirrorskin-bench-") as made:
        free = shutil.disk_usage(made).free
        if free < needed:
            raise io.InputError(
                f"case {name} needs {needed / 1e9:.1f} GB in {tempfile.gettempdir()} and {free / 1e9:.1f} GB "
                "are free: choose another folder with --folder, or name other cases with --case"
            )
        yield Path(made)


def record(source: Frames, path: Path, compression: Compression = "raw") -> None:
    """Write a recording, and wait until the disk has it: nothing is left to write while others are timed."""
    source.rewind()
    with io.Recorder(source, path, compression, overwrite=True) as recorder:
        recorder.drain(lambda count: None)
    sync(path)


def sync(path: Path) -> None:
    """Wait until the disk has all of a file."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def to_result(
    source: Path,
    target: Path | None,
    device: Device,
    opening: Mapping[str, Any] | None = None,
    **options: Any,
) -> io.Result:
    """Open a recording, reconstruct it, and save the result if it has a name: the whole path."""
    with io.open_recording(source, **(opening or {})) as recording:
        result = reconstruct(recording, device=device, **options)
    if target is not None:
        io.save_result(result, target)
    return result


def to_new_results(source: Path, target: Path, device: Device, **options: Any) -> Work:
    """Return a work that does the path and writes a new file each time, since to replace one takes longer."""
    numbers = count()

    def work() -> io.Result:
        number = next(numbers)
        name = target.with_stem(f"{target.stem}-{number}") if number else target
        return to_result(source, name, device, **options)

    return work
