"""Recordings: frame stacks in HDF5 or Zarr, written by mirrorskin or other programs; heights from a file."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.arguments import (
    as_pixel_size,
    check_count,
    check_flag,
    check_number,
    check_path,
    checked,
    in_unit,
)
from mirrorskin.io.calibration.file import carried_by
from mirrorskin.io.calibration.types import Calibration
from mirrorskin.io.checksums import UNVERIFIED, UNVERIFIED_PARTS, checksums
from mirrorskin.io.coordinates import Coordinates, read_coordinates
from mirrorskin.io.findings import Finding
from mirrorskin.io.fingerprint import check_unchanged, fingerprint, modified, origins
from mirrorskin.io.foreign import kind_of_frames
from mirrorskin.io.hdf5 import Hdf5File
from mirrorskin.io.layout import (
    CHECKSUM,
    MARK,
    SERIES,
    STACK,
    Layout,
    RecordingState,
    as_series,
    read_checksums,
    read_state,
)
from mirrorskin.io.positions import Positions, along
from mirrorskin.io.result import absolute_heights
from mirrorskin.io.result_file import MARK as RESULT_MARK
from mirrorskin.io.result_file import open_result
from mirrorskin.io.samples import Decoding, frame_dtype, order_of
from mirrorskin.io.selection import Region, Selection
from mirrorskin.io.stack import Stack
from mirrorskin.io.system import as_input_error
from mirrorskin.io.types import (
    Block,
    Closing,
    Floats,
    Header,
    InputError,
    Motion,
    Truth,
    block_memory,
)
from mirrorskin.io.url import path_of
from mirrorskin.io.zarr import ZarrFile, open_file


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
        cut: Selection,
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
        self.region, self.origin, self.first_frame = cut.region, cut.region.origin, cut.frames[0]
        self.full_shape = full_shape
        self.state, self.used, self.dropped = state.state, state.used, state.dropped
        self.time, self.travel, self.phase = (positions.get(name) for name in ("time", "travel", "phase"))
        self.displacement, self.twist = positions.get("displacement"), positions.get("twist")
        self.tilt: Floats | None = positions.get("tilt")
        self.which: str = f"{cut.frames[0]}:{cut.frames[1]}{', used live' if live else ''}"
        self.used_live = live
        self.storage, self._file, self._dataset = file.storage(dataset), file, dataset
        self._origins = file.origins() if isinstance(file, ZarrFile) else origins(file, dataset)
        self.read_ahead = isinstance(file, ZarrFile)
        self._stack, self._next = stack, 0
        self._closed = False
        self.truth_maps: list[str] = list(layout.truth_nodes())
        self.findings = layout.findings()

    def __repr__(self) -> str:
        from mirrorskin.io.notebook import recording_as_text

        return recording_as_text(self)

    def _repr_html_(self) -> str:
        from mirrorskin.io.notebook import recording_as_html

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
        known = {name: values[here] for name, values in series.items() if values is not None}
        return Block(frames, here.start, **known, origin=self.origin)

    def frame(self, number: int) -> NDArray[Any]:
        """Return one frame, (H, W); the position of reading does not change."""
        frame: NDArray[Any] = self._stack.read(number, np.empty((1, *self.shape[1:]), self.dtype))[0]
        return frame

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def fingerprint(self) -> str:
        """Return a hash that identifies the unchanged file; see ``mirrorskin.io.fingerprint``."""
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
        room = np.empty((1, *self.shape[1:]), self.dtype)
        self.rewind()
        found = [checksums(block.frames) for block in iter(lambda: self.read(room), None)]
        self.rewind()
        return np.flatnonzero(np.concatenate(found) != expected)

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

    def close(self) -> None:
        """Close the file; frames that were returned without a copy remain valid."""
        self._closed = True
        self._stack.close()
        self._file.close()

    def _check_open(self, what: str) -> None:
        if self._closed:
            raise InputError(f"{self.name}: the recording is closed: use its {what} before, or open it again")


@checked(
    path=check_path,
    travel=as_series,
    phase=as_series,
    tilt=in_unit("rad", check_number),
    pixel_size=as_pixel_size,
    threads=check_count,
    memory_limit=check_count,
    live=check_flag,
    override_motion=check_flag,
    verify=check_flag,
)
def open_recording(
    path: str | Path,
    *,
    dataset: str | None = None,
    channel: int | None = None,
    motion: Motion | None = None,
    travel: ArrayLike | Positions | None = None,
    phase: ArrayLike | Positions | None = None,
    tilt: float | None = None,
    pixel_size: tuple[float, float] | None = None,
    region: Region | None = None,
    frames: tuple[int, int | None] | None = None,
    threads: int | None = None,
    memory_limit: int | None = None,
    live: bool = False,
    override_motion: bool = False,
    verify: bool = True,
) -> Recording:
    """Open a stack of frames: HDF5, Zarr, NPY, NPZ, TIFF, MCAP, a video, or a folder of numbered pictures.

    Parameters
    ----------
    path : str or Path
        For Zarr a folder ``NAME.zarr``, a zipped one, or an address such as ``s3://bucket/NAME.zarr``.
    dataset : str, optional
        Name of the stack, of an archive's array or of a topic, or number of a TIFF's series or a video's
        stream; required if the file was not written by mirrorskin and contains several.
    channel : int, optional
        Channel of a TIFF with several, or colour (0 red, 1 green, 2 blue); by default colours become luma.
    motion : str, optional
        Motion, if the file does not contain it; it must not contradict the file.
    travel, phase, tilt, pixel_size
        Values that are missing in the file, or replace them: positions in mm or radians, one per frame or as
        ``Steps``; half-angle in radians; pixel size in mm.
    region : Region, optional
        Part of the picture to read. Maps are cropped, and the pivot becomes relative to the centre of the
        region.
    frames : (int, int or None), optional
        First frame and end of the frames to read; None for the end of the stack. Positions are given for the
        whole stack, and are cropped.
    threads : int, optional
        Number of threads that unpack chunks; by default the number of cores.
    memory_limit : int, optional
        Limit of the memory for unpacked chunks of frames, or decoded frames of a video, in bytes.
    live : bool, optional
        Only the frames used by a live run, with the positions it used.
    override_motion : bool, optional
        Whether ``motion`` replaces the motion in the file, to correlate any stack with phases.
    verify : bool, optional
        Whether whole frames are compared with the checksums that were stored when they were recorded.

    Returns
    -------
    Recording
        Close it, or use it in a ``with``. For a file that is being written, it contains the present frames.

    Raises
    ------
    InputError
        The file, the stack, or one of its parameters cannot be used. Reading raises it for frames that differ
        from what was recorded.

    Examples
    --------
    >>> with open_recording("press.h5") as recording:  # doctest: +SKIP
    ...     print(recording.motion, recording.shape)
    vertical (240, 480, 640)
    """
    path = path_of(path)
    kind = kind_of_frames(path)
    if channel is not None and kind in ("", "array"):
        raise InputError(f"{path}: only pictures, videos and MCAP files have channels: leave --channel out")
    if kind:
        from mirrorskin.io.arrays import open_stack

        if live:
            raise InputError(f"{path} is not a recording of a live run: leave --live out")
        known = {"tilt": tilt, "pixel_size": pixel_size}
        where = {"travel": travel, "phase": phase}
        part = region, frames
        return open_stack(
            path, dataset, channel, where, known, motion, *part, memory_limit, override_motion, verify
        )
    with ExitStack() as opening:
        file = opening.enter_context(open_file(path, memory_limit))
        ours = file.marked(MARK)
        file.check_layout(MARK)
        stack, state, decoding = _find_stack(file, dataset, ours)
        shape = (state.count, *decoding.shape(stack.shape)[1:])
        cut = cut_out(str(path), shape, frames, region)
        coordinates = Coordinates() if ours else read_coordinates(file, stack, decoding)
        layout = Layout(file, ours, shape, cut, coordinates)
        header = layout.header(motion, tilt, pixel_size, override_motion)
        state, numbers = state.of(slice(*cut.frames)), np.arange(*cut.frames)
        if live:
            chosen = _used(str(path), state, travel, phase)
            state, positions = state.of(chosen), layout.live(header.motion, chosen)
            numbers = numbers[chosen]
        else:
            given = {"vertical": travel, "axial": phase}.get(header.motion)
            positions = layout.positions(header.motion, along(given, shape[0]))
        opened = file.frames(stack) if isinstance(file, ZarrFile) else None
        expected, notes = _expected(file, stack, state, cut.region, verify)
        frames_of = Stack(
            stack, str(path), shape[0], numbers, cut.region, memory_limit, threads, decoding, opened, expected
        )
        recording = Recording(file, stack, frames_of, cut, header, positions, layout, state, shape, live)
        recording.findings += (*decoding.findings, *coordinates.findings, *notes)
        opening.pop_all()  # the recording closes the file from now on
    return recording


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


def _used(
    path: str,
    state: RecordingState,
    travel: ArrayLike | Positions | None,
    phase: ArrayLike | Positions | None,
) -> NDArray[np.intp]:
    """Return the numbers of the frames used by a live run."""
    if travel is not None or phase is not None:
        raise InputError(f"{path}: a live run has its own positions: leave --live out, or those given")
    if state.used is None:
        raise InputError(f"{path} does not state which frames a live run used: leave --live out")
    used = np.flatnonzero(state.used)
    if len(used) < 2:
        raise InputError(
            f"{path}: a live run used {len(used)} frames: at least 2 are needed; leave --live out"
        )
    return used


def _expected(
    file: Hdf5File, stack: h5py.Dataset, state: RecordingState, region: Region, verify: bool
) -> tuple[NDArray[np.uint32] | None, tuple[Finding, ...]]:
    """Return the checksums of the frames if they can be compared, and a note if not."""
    node = file.find(CHECKSUM) if file.marked(MARK) and stack == file.find(STACK) else None
    if node is None:
        return None, ()
    if not verify:
        return None, (UNVERIFIED,)
    if region != Region.whole(stack.shape[1:]):
        return None, (UNVERIFIED_PARTS,)
    return read_checksums(file, node, state), ()


def _find_stack(
    file: Hdf5File, dataset: str | None, ours: bool
) -> tuple[h5py.Dataset, RecordingState, Decoding]:
    """Return the stack of frames, its state and its decoding; InputError if it cannot be read."""
    if dataset is None:
        dataset = STACK if ours else _only_stack(file)
    stack = file.follow(dataset, "name the stack with --dataset")
    where = file.where(stack)
    if not isinstance(stack, h5py.Dataset):
        raise InputError(f"{where} is not a dataset: name one with --dataset")
    with as_input_error(where):
        shape = stack.shape
    if shape is None or len(shape) != 3:
        raise InputError(f"{where} has shape {shape}: a stack of frames, (T, H, W), is needed")
    ours = ours and stack == file.find(STACK)
    decoding = _decoding(file, stack, ours, where)
    count, *picture = decoding.shape(shape)
    if 0 in picture:
        raise InputError(f"{where} has shape {shape}: its frames have no pixels; record it again")
    state = read_state(file, ours, stack, count)
    if state.count < 2:
        frames = f"{state.count} frame{'' if state.count == 1 else 's'}"
        raise InputError(f"{where} contains {frames}: at least 2 are needed; record more")
    file.check_frames(stack, state.count if decoding.order[0] == 0 else shape[0])
    return stack, state, decoding


def _decoding(file: Hdf5File, stack: h5py.Dataset, ours: bool, where: str) -> Decoding:
    """Return how frames are decoded from the stored values, according to attributes and axes of the stack."""
    with as_input_error(where):
        dtype = stack.dtype.newbyteorder("=")
    frame_dtype(dtype, where)
    packing = file.packing(stack)
    if ours:
        return Decoding(dtype, packing=packing, where=where)
    if file.attribute_values(stack, "MATLAB_class") is not None:
        # MATLAB stores the axes in the opposite order, and a stack of pictures is (H, W, T) there.
        return Decoding(dtype, (0, 2, 1), packing, where=where, matlab=True)
    names = file.dimensions(stack)
    order = order_of(names, where) if names else (0, 1, 2)
    return Decoding(dtype, order, packing, names, where)


def is_recording(path: str | Path) -> bool:
    """Return whether an HDF5 or Zarr file is a recording written by mirrorskin."""
    with open_file(path) as file:
        return file.marked(MARK)


def is_result(path: str | Path) -> bool:
    """Return whether an HDF5 or Zarr file is a result written by mirrorskin."""
    with open_file(path) as file:
        return file.marked(RESULT_MARK)


def _only_stack(file: Hdf5File) -> str:
    if file.marked(RESULT_MARK):
        raise InputError(f"{file.path} is a result: give the recording that it was made from")
    names = list(file.stacks())
    if not names:
        raise InputError(
            f"{file.path} contains no stack of frames (T, H, W): if a link leads to one, name it with "
            "--dataset"
        )
    if len(names) > 1:
        raise InputError(
            f"{file.path} contains {len(names)} stacks, {', '.join(names[:5])}: choose with --dataset"
        )
    return names[0]


def open_heights(path: str | Path, source: Recording | None = None) -> NDArray[np.float32]:
    """Read the heights of a result, or the true heights of a simulated recording.

    Parameters
    ----------
    path : str or Path
    source : Recording, optional
        Recording whose pixels are needed; heights of a larger part of the picture are cropped.

    Returns
    -------
    ndarray, (H, W), float32
        Millimetres; NaN where undefined.

    Raises
    ------
    InputError
        There is no such file, it contains no heights or heights of other pixels, or it is damaged.

    Examples
    --------
    >>> open_heights("press-result.h5").shape  # doctest: +SKIP
    (480, 640)
    """
    path = path_of(path)
    with open_file(path) as file:
        ours = file.marked(MARK)
    if ours:
        with open_recording(path) as recording:
            height, part = None if recording.truth is None else recording.truth.height, None
    else:
        result = open_result(path)
        if result.fitted.undistorted:
            remedy = "give one that was computed without a scale in its calibration"
            raise InputError(f"{path} contains undistorted heights, but frames are not undistorted: {remedy}")
        height = absolute_heights(result)
        part = result.fitted.region
    if height is None:
        raise InputError(f"{path} contains no heights: give a result of a press, or a simulation with truth")
    if source is not None:
        height = _cut_heights(height, part or Region.whole(height.shape), source, str(path))
    if not np.isfinite(height).any():
        raise InputError(
            f"{path} contains no heights whose offset is known: give a result of a press, or of 'fuse'"
        )
    return height


def _cut_heights(
    height: NDArray[np.float32], own: Region, source: Recording, name: str
) -> NDArray[np.float32]:
    """Crop heights to the pixels of a recording."""
    wanted = source.region
    if not (own.holds(wanted) and Region.whole(source.full_shape[1:]).holds(own)):
        raise InputError(
            f"{name} contains the heights of {own}, where {source.name} needs those of {wanted}: "
            "give some of all these pixels"
        )
    return np.ascontiguousarray(height[wanted.within(own)])
