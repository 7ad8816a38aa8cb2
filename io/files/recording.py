"""Recordings: frame stacks in HDF5 or Zarr, written by mirrorskin or other programs; heights from a file."""

from __future__ import annotations

import bisect
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.checksums import checksums
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.selection import Region, Selection
from mirrorskin.io.base.types import (
    Block,
    Closing,
    Floats,
    Header,
    InputError,
    Truth,
    block_memory,
)
from mirrorskin.io.model.calibration import Calibration
from mirrorskin.io.model.frames import is_blank
from mirrorskin.io.storage.calibration_file import carried_by
from mirrorskin.io.storage.fingerprint import check_unchanged, fingerprint, modified, origins
from mirrorskin.io.storage.hdf5 import Hdf5File
from mirrorskin.io.storage.layout import (
    CHECKSUM,
    SERIES,
    Layout,
    RecordingState,
    read_checksums,
)
from mirrorskin.io.storage.stack import Stack
from mirrorskin.io.storage.zarr import ZarrFile


class Recording(Closing):
    """A stack in a file, as a source that can be rewound; see ``open_recording``.

    Attributes
    ----------
    path : Path
    dataset : str
        Name of the stack in the file.
    name, header, shape, dtype, motion, rewindable
        As for every ``Source``.
    time, travel, phase, twist, tilt : ndarray, (T,), float64, or None
        Seconds, millimetres and radians.
    displacement : ndarray, (T, 2), float64, or None
        Millimetres.
    truth_maps : list of str
        Names of the values in the truth.
    region : Region
        The part of the picture.
    origin : (int, int)
        Row and column of the first pixel in the full picture.
    first_frame : int
        Number of the first frame in the whole stack.
    full_shape : (int, int, int)
        Frames, rows and columns of the whole stack.
    state : str
        "under way", "complete", or "cut short: " and the reason.
    used, dropped : ndarray, (T,), bool and int, or None
        Whether a live run used a frame, and the number of frames lost before it.
    which : str
        The selected frames of the whole stack, as text.
    used_live : bool
        Whether only the frames used by a live run were selected.
    storage : str
        How the frames are stored, as text.
    findings : tuple of Finding
        Doubts from the metadata of the file, and conversions.
    read_ahead : bool
        Whether reading in a separate thread is faster, as for Zarr.
    """

    path: Path
    name: str
    dataset: str
    header: Header
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    region: Region
    origin: tuple[int, int]
    first_frame: int
    full_shape: tuple[int, int, int]
    state: str
    used: NDArray[np.bool_] | None
    dropped: NDArray[np.int32] | None
    time: Floats | None
    travel: Floats | None
    phase: Floats | None
    displacement: Floats | None
    twist: Floats | None
    storage: str

    rewindable = True
    read_ahead = used_live = False
    left_out: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    def __init__(
        self,
        file: Hdf5File,
        dataset: h5py.Dataset,
        stack: Stack,
        selection: Selection,
        header: Header,
        positions: Mapping[str, Floats | None],
        layout: Layout,
        state: RecordingState,
        full_shape: tuple[int, int, int],
        live: bool = False,
    ) -> None:
        self.path, self.name, self.dataset = file.path, str(file.path), str(dataset.name)
        self.header, self.motion, self._layout = header, header.motion, layout
        self.shape, self.dtype = stack.shape, stack.dtype
        self.region, self.origin, self.first_frame = (
            selection.region,
            selection.region.origin,
            selection.frames[0],
        )
        self.full_shape = full_shape
        self.state, self.used, self.dropped = state.state, state.used, state.dropped
        self.time, self.travel, self.phase = (positions.get(name) for name in ("time", "travel", "phase"))
        self.displacement, self.twist = positions.get("displacement"), positions.get("twist")
        self.tilt: Floats | None = positions.get("tilt")
        self.which: str = f"{selection.frames[0]}:{selection.frames[1]}{', used live' if live else ''}"
        self.used_live = live
        self.storage, self._file, self._dataset = file.storage(dataset), file, dataset
        self._origins = file.origins() if isinstance(file, ZarrFile) else origins(file, dataset)
        self.read_ahead = isinstance(file, ZarrFile)
        self._stack, self._next = stack, 0
        self._closed = False
        self.truth_maps: list[str] = list(layout.truth_nodes())
        self.findings = layout.findings()

    def __repr__(self) -> str:
        from mirrorskin.io.model.notebook import recording_as_text

        return recording_as_text(self)

    def _repr_html_(self) -> str:
        from mirrorskin.io.model.notebook import recording_as_html

        return recording_as_html(self)

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames, at most ``len(out)``, into ``out``; see ``Source.read``."""
        out = block_memory(out, self.shape, self.dtype)
        start = self._next
        if start >= self.shape[0]:
            return None
        return self._block(self._stack.read(start, out))

    def _block(self, frames: NDArray[Any]) -> Block:
        """Advance past the next frames, and return them as a block."""
        here = slice(self._next, self._next + len(frames))
        self._next = here.stop
        series = {name: getattr(self, name) for name in SERIES}
        positions = {name: values[here] for name, values in series.items() if values is not None}
        return Block(frames, here.start, **positions, origin=self.origin)

    def frame(self, number: int) -> NDArray[Any]:
        """Return one frame, (H, W); the position of reading does not change."""
        frame: NDArray[Any] = self._stack.read(number, np.empty((1, *self.shape[1:]), self.dtype))[0]
        return frame

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def fingerprint(self) -> str:
        """Return a hash that identifies the unchanged file; see ``mirrorskin.io.storage.fingerprint``."""
        if not self._file.root.swmr_mode:
            check_unchanged(self._origins)
        return self._fingerprint

    @functools.cached_property
    def _fingerprint(self) -> str:
        if isinstance(self._file, ZarrFile):
            return self._file.fingerprint(self._dataset)
        return fingerprint(self._file, self._dataset, self._origins, self.full_shape[0])

    def find_damage(self) -> NDArray[np.intp] | None:
        """Return the frames whose checksums do not match; None if the recording has no checksums.

        The recording must have been opened as a whole, and is rewound. Its frames are not verified again.
        """
        if self.shape != self.full_shape:
            raise InputError(
                f"{self.name}: only whole recordings can be verified: open it without frames and region"
            )
        node = self._file.find(CHECKSUM)
        if node is None:
            return None
        expected = read_checksums(self._file, node, RecordingState(self.full_shape[0]))
        self._stack.verifier = None
        buffer = np.empty((1, *self.shape[1:]), self.dtype)
        self.rewind()
        sums = [checksums(block.frames) for block in iter(lambda: self.read(buffer), None)]
        self.rewind()
        return np.flatnonzero(np.concatenate(sums) != expected)

    @functools.cached_property
    def truth(self) -> Truth | None:
        """Ground truth of a simulation; it is read when it is first used, before the recording is closed."""
        self._check_open("truth")
        return self._layout.truth()

    @functools.cached_property
    def carried(self) -> Calibration | None:
        """The copy of a calibration in the recording, for the whole picture; it is not applied here."""
        self._check_open("calibration")
        return carried_by(self._file)

    @property
    def how(self) -> str:
        """How the frames are read."""
        return self._stack.how

    @property
    def modified(self) -> str:
        """Time of the last change of the files, as ISO 8601; empty for an address."""
        return modified(self._origins) if self._origins else ""

    @property
    def random_access(self) -> bool:
        """Whether a frame is read without others."""
        return self._stack.random_access

    def close(self) -> None:
        """Close the file; frames that were returned without a copy remain valid."""
        self._closed = True
        self._stack.close()
        self._file.close()

    def _check_open(self, what: str) -> None:
        if self._closed:
            raise InputError(f"{self.name}: the recording is closed: use its {what} before, or open it again")


def cut_out(
    name: str, shape: tuple[int, int, int], frames: tuple[int, int | None] | None, region: Region | None
) -> Selection:
    """Return the selected part of a stack; InputError if the stack does not contain it."""
    start, end = frames or (0, None)
    stop = shape[0] if end is None else end
    if not 0 <= start <= stop - 2 <= shape[0] - 2:
        raise InputError(
            f"{name}: frames {start} to {stop} of {shape[0]}: give a start from 0, and an end up to "
            f"{shape[0]} with at least 2 frames between"
        )
    region = region or Region.whole(shape[1:])
    region.check(shape[1:], name)
    return Selection((start, stop), region)


def unwritten_frames(recording: Recording) -> tuple[Finding, ...]:
    """Return the finding for the last frames of a recording if they are blank, and the first is not."""
    count = recording.shape[0]
    if (
        not recording.random_access
        or is_blank(recording.frame(0))  # before the last: an error names the first frame that has it
        or not is_blank(recording.frame(count - 1))
    ):
        return ()
    first = bisect.bisect_left(range(count), True, key=lambda number: is_blank(recording.frame(number)))
    start = recording.first_frame
    text = (
        f"the last {count - first} frames contain only zeros, as if they had never been written: --frames"
        f" {start}:{start + first} leaves them out"
    )
    return (Finding("number of frames", text),)
