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
    lost : ndarray, (T,), int32, or None
        Frames lost before each frame.
    positions : mapping
        The positions in the file; names as in `Block`.
    header : mapping
        The properties in the file; names as in `Header`.
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
    lost: NDArray[np.int32] | None = None
    positions: Mapping[str, Floats] = MappingProxyType({})
    header: Mapping[str, Any] = MappingProxyType({})
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
    return (Finding("lost frames", text),)


def lossy(how: str) -> Finding:
    """Return the finding for frames with lossy compression."""
    return Finding(
        LOSSY,
        f"the frames are compressed with a loss ({how}): brightness and noise are not those of the camera,"
        " and standard deviations are too small; record without compression, or with a lossless one",
    )


CONVERTED_COLOUR = Finding(
    "colour",
    "colours are read as grey (luma); --channel 0, 1 or 2 takes red, green or blue",
    warning=False,
)
"""Finding for colours that were converted to grey."""
