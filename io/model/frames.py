"""Base classes and findings of readers of frames in files of other programs."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.selection import Span
from mirrorskin.io.base.types import Closing, Floats, InputError

LOST = "lost frames"
"""Kind of the finding of `lost_frames`."""

LOSSY = "lossy compression"
"""Kind of the finding of `lossy`."""


class FrameReader(Closing, ABC):
    """Frames of a file, which are read when they are used.

    Attributes
    ----------
    shape : (int, int, int)
        Frames, rows and columns.
    dtype : dtype
        uint8, uint16 or float32, of any byte order.
    how : str
        How the frames are read, as text.
    time : ndarray, (T,), float64, or None
        Time stamps in seconds, relative to the first frame.
    start : int or None
        Time of the first frame in nanoseconds, of a clock that the parts of a recording share.
    lost : ndarray, (T,), int32, or None
        Frames lost before each frame.
    positions : mapping
        The positions in the file; names as in `Block`.
    header : mapping
        The properties in the file; names as in `Header`.
    random_access : bool
        Whether any frame is read without those before it.
    left_out : tuple of str
        Files of a folder that are not frames.
    findings : tuple of Finding
        Doubts about the frames, and conversions.
    files : tuple of Path
        The files that contain the frames.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    how: str
    length: int = 1  # frames that are read at once
    scratch_bytes: int = 0
    files: tuple[Path, ...] = ()
    time: Floats | None = None
    start: int | None = None
    lost: NDArray[np.int32] | None = None
    positions: Mapping[str, Floats] = MappingProxyType({})
    header: Mapping[str, Any] = MappingProxyType({})
    random_access: bool = False
    left_out: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    @property
    def chunk(self) -> tuple[int, int, int]:
        """Shape of one stored block."""
        return self.length, *self.shape[1:]

    @abstractmethod
    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Write frames, some rows and columns of each, into ``out``, a C-contiguous array."""


class WholeFrames(FrameReader):
    """Frames that can only be decoded whole, by one thread at a time."""

    _decoding: AbstractContextManager[Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Create an object with a lock, independently of ``__init__``."""
        reader = super().__new__(cls)
        reader._decoding = threading.Lock()
        return reader

    @abstractmethod
    def frames(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        """Decode frames ``start`` to ``stop - 1``, each with its name in messages."""

    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Decode frames, and copy some rows and columns of each into ``out``."""
        (start, stop), *part = spans
        region = tuple(slice(*span) for span in part)
        with self._decoding:
            decoded = self.frames(start, stop)
            for target in out:
                name, frame = next(decoded)
                if frame.shape != self.shape[1:] or frame.dtype != self.dtype:
                    first = kind_of(self.shape[1:], self.dtype)
                    raise InputError(
                        f"{name} is {kind_of(frame.shape, frame.dtype)}, but the first frame is {first}: "
                        "all frames must have the same size and depth"
                    )
                target[...] = frame[region]
                del frame  # before the next frame is decoded


class JoinedFrames(WholeFrames):
    """The frames of several readers, one after the other, as of a recording that was written in parts.

    Parameters
    ----------
    parts : sequence of WholeFrames
        They have frames of the same size and type, and are closed with this object.
    names : sequence of str
        The names of the parts, for messages.
    """

    def __init__(self, parts: Sequence[WholeFrames], names: Sequence[str]) -> None:
        self._parts, first = parts, parts[0]
        self.random_access = all(part.random_access for part in parts)
        self._ends = np.cumsum([part.shape[0] for part in parts])
        for part, name in zip(parts, names, strict=True):
            if part.shape[1:] != first.shape[1:] or part.dtype != first.dtype:
                raise InputError(
                    f"{name} has frames of {kind_of(part.shape[1:], part.dtype)}, but {names[0]} of"
                    f" {kind_of(first.shape[1:], first.dtype)}: read them one by one"
                )
        self.shape, self.dtype = (int(self._ends[-1]), *first.shape[1:]), first.dtype
        self.how, self.header = f"{first.how}, {len(parts)} parts", first.header
        self.files = tuple(dict.fromkeys(file for part in parts for file in part.files))
        self.time = _joined_times(parts)
        self.positions = {
            name: np.concatenate([part.positions[name] for part in parts])
            for name in first.positions
            if all(name in part.positions for part in parts)
        }
        lost = [np.zeros(part.shape[0], np.int32) if part.lost is None else part.lost for part in parts]
        self.lost = None if all(part.lost is None for part in parts) else np.concatenate(lost)
        found = dict.fromkeys(finding for part in parts for finding in part.findings)
        self.findings = tuple(finding for finding in found if finding.kind != LOST)
        self.findings += () if self.lost is None else lost_frames(self.lost)

    def frames(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        """Decode frames of the parts that contain them."""
        for part, end in zip(self._parts, self._ends.tolist(), strict=True):
            first = end - part.shape[0]
            if start < end and stop > first:
                yield from part.frames(max(start, first) - first, min(stop, end) - first)

    def close(self) -> None:
        """Close all parts."""
        for part in self._parts:
            part.close()


def _joined_times(parts: Sequence[FrameReader]) -> Floats | None:
    """Return the times of the frames of all parts; None if they are unknown, or do not rise."""
    times = []
    for part in parts:
        if part.time is None or part.start is None or parts[0].start is None:
            return None
        times.append(part.time + (part.start - parts[0].start) / 1e9)
    joined = np.concatenate(times)
    return joined if bool(np.all(np.diff(joined) > 0)) else None


def part_of_several(name: str, names: Sequence[str], whole: str) -> Finding:
    """Return the finding for a part of a recording that is read alone; ``whole`` is to be named instead."""
    return Finding(
        "part",
        f"{name} is one of {len(names)} parts, {names[0]} to {names[-1]}, and only its frames are read: name"
        f" {whole} to read all",
    )


def is_blank(frame: NDArray[Any]) -> bool:
    """Return whether a frame contains only zeros, or only NaN, as one that was never written."""
    return not np.any(frame) or (frame.dtype.kind == "f" and bool(np.isnan(frame).all()))


def kind_of(shape: Sequence[int], dtype: np.dtype[Any]) -> str:
    """Return the size and the type of a picture as text."""
    return f"{shape[1]} x {shape[0]} {dtype.name}"


def lost_frames(lost: NDArray[np.int32]) -> tuple[Finding, ...]:
    """Return findings about the numbers of frames lost before each frame."""
    if not lost.any():
        return ()
    count, gaps = int(lost.sum()), np.flatnonzero(lost)
    before = ", ".join(map(str, gaps[:5])) + (", ..." if len(gaps) > 5 else "")
    text = (
        f"{count} {'frame is' if count == 1 else 'frames are'} missing, before"
        f" {'frame' if len(gaps) == 1 else 'frames'} {before}; even steps of travel or phase count them"
    )
    return (Finding(LOST, text),)


def lossy(how: str) -> Finding:
    """Return the finding for frames with lossy compression."""
    return Finding(
        LOSSY,
        f"the frames are compressed with a loss ({how}): brightness and noise are not those of the camera,"
        " and standard deviations are too small; record without compression, or with a lossless one",
    )


def maybe_lossy(how: str, warning: bool) -> Finding:
    """Return the finding for a compression that may have a loss; a note if it is probably lossless."""
    return Finding(
        LOSSY,
        f"the frames may be compressed with a loss ({how}), which the file does not show: if they are,"
        " standard deviations are too small",
        warning,
    )


CONVERTED_COLOUR = Finding(
    "colour",
    "colours are read as grey (luma); --channel 0, 1 or 2 takes red, green or blue",
    warning=False,
)
"""Finding for colours that were converted to grey."""
