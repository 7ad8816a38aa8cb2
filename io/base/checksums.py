"""Checksums of frames: the CRC-32 of the bytes of each, with which it is compared when it is read."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.samples import Reader
from mirrorskin.io.base.selection import Span
from mirrorskin.io.base.types import InputError
from mirrorskin.processors import usable_cores

try:  # eight times as fast as zlib, and the same numbers
    from isal.isal_zlib import crc32 as crc32
except ImportError:  # a processor for which it does not exist
    from zlib import crc32

REMEDY = "copy the file again, or use the frames as they are with --no-verify"
"""Remedy for frames that differ from their checksums."""

UNVERIFIED = Finding("unverified", "the frames were not compared with their checksums, as requested", False)
"""Finding for frames that are not verified."""
UNVERIFIED_PARTS = Finding(
    "unverified", "the frames were not verified, because checksums are those of whole pictures", False
)
"""Finding for parts of frames."""

_READ_BYTES = 32_000_000  # bytes of frames that are read while earlier ones are compared


def checksums(frames: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the CRC-32 of each frame's bytes."""
    return np.array([crc32(np.ascontiguousarray(frame).data) for frame in frames], np.uint32)


def describe_damage(frames: NDArray[np.intp]) -> str:
    """Return which frames differ from their checksums, for messages."""
    numbers = ", ".join(map(str, frames[:5])) + (", ..." if frames.size > 5 else "")
    which = f"frame {numbers} differs" if frames.size == 1 else f"frames {numbers} differ"
    return f"{which} from what was recorded"


class Verifier:
    """Comparison of the frames of a stack with their checksums, once, when they are first read.

    Parameters
    ----------
    expected : ndarray, (n,), uint32
        Checksums of the first frames; there may be fewer than frames.
    numbers : ndarray of int
        The frames that are used; others are not compared.
    name : str
        Name of the stack in messages.
    """

    def __init__(self, expected: NDArray[np.uint32], numbers: NDArray[np.intp], name: str) -> None:
        self._expected, self._name = expected, name
        self._left = np.zeros(len(expected), np.bool_)  # frames to compare
        self._left[numbers[numbers < len(expected)]] = True

    def fetch(self, reader: Reader, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Read whole frames, and compare them in other threads while the next ones are read.

        Raises
        ------
        InputError
            Frames differ from their checksums.
        """
        (first, stop), *part = spans
        expected = self._left[first:stop]
        if not expected.any():
            reader.fetch(spans, out)
            return
        cores, length, size = usable_cores(), reader.length, out[:1].nbytes
        # Chunks of a piece are decoded in parallel, so there are several for each core.
        step = max(2 * cores, _READ_BYTES // (length * size)) * length
        futures: list[Future[NDArray[np.uint32]]] = []
        with ThreadPoolExecutor(cores, "mirrorskin-checksums") as pool:
            for place in range(first // step * step, stop, step):
                start, end = max(place, first), min(place + step, stop)
                piece = out[start - first : end - first]
                reader.fetch([(start, end), *part], piece)
                futures += [pool.submit(checksums, part) for part in np.array_split(piece, cores)]
        values = np.concatenate([future.result() for future in futures])
        damaged = first + np.flatnonzero(expected & (values[: len(expected)] != self._expected[first:stop]))
        if damaged.size:
            raise InputError(f"{self._name}: {describe_damage(damaged)}: {REMEDY}")
        expected[...] = False
