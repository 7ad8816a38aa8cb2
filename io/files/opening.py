"""Opening recordings in files of any format."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.arguments import (
    as_pixel_size,
    check_count,
    check_flag,
    check_number,
    check_path,
    checked,
    in_unit,
)
from mirrorskin.io.base.checksums import UNVERIFIED, UNVERIFIED_PARTS
from mirrorskin.io.base.content import UnknownContentError
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.selection import Region
from mirrorskin.io.base.types import (
    InputError,
    Motion,
)
from mirrorskin.io.base.url import path_of
from mirrorskin.io.files.parts import PARTS
from mirrorskin.io.files.recording import Recording, cut_out, unwritten_frames
from mirrorskin.io.files.stacks import find_stack, names_of_stack, part_findings
from mirrorskin.io.formats.registry import (
    Format,
    format_of_frames,
    format_of_surface,
    holds_arrays,
    sources,
)
from mirrorskin.io.model.coordinates import Coordinates, read_coordinates
from mirrorskin.io.model.positions import Positions, along
from mirrorskin.io.storage.hdf5 import Hdf5File
from mirrorskin.io.storage.layout import (
    CHECKSUM,
    MARK,
    RESULT_MARK,
    STACK,
    Layout,
    RecordingState,
    as_series,
    read_checksums,
)
from mirrorskin.io.storage.stack import Stack
from mirrorskin.io.storage.zarr import ZarrFile, open_file


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
    """Open a stack of frames: a recording, or frames of any format that is read.

    Parameters
    ----------
    path : str or Path
        For Zarr a folder ``NAME.zarr``, a zipped one, or an address such as ``s3://bucket/NAME.zarr``.
    dataset : str, optional
        Name of the stack, of an archive's array or of a topic, or number of a TIFF's series or a video's
        stream; required if the file was not written by mirrorskin and contains several. In the recording of a
        touch, ``turn`` is the turn after the press.
    channel : int, optional
        Channel of a TIFF or an array with several, or colour (0 red, 1 green, 2 blue); by default colours
        become luma.
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
    form = format_of_frames(path)
    if channel is not None and holds_arrays(path):
        raise InputError(f"{path}: an array of NumPy has no channels: leave --channel out")

    def open_other(form: Format | None) -> Recording:
        from mirrorskin.io.files.arrays import open_stack

        if live:
            raise InputError(f"{path} is not a recording of a live run: leave --live out")
        properties = {"tilt": tilt, "pixel_size": pixel_size}
        where = {"travel": travel, "phase": phase}
        part = region, frames
        chosen = dataset, channel, where, properties, motion
        return open_stack(path, form, *chosen, *part, memory_limit, override_motion, verify)

    if form is not None or holds_arrays(path):
        return open_other(form)
    with ExitStack() as opening:
        try:
            file = opening.enter_context(open_file(path, memory_limit))
        except InputError as error:
            raise _explained(path, error) from None
        ours = file.marked(MARK)
        if ours and dataset is not None and file.marked(MARK, f"/{dataset.strip('/')}/entry"):
            file.enter(dataset.strip("/"))  # another recording in the same file, as the turn of a touch
            dataset = None
        file.check_layout(MARK)
        names = [dataset or STACK] if ours else names_of_stack(file, dataset)
        if len(names) > 1:
            return open_other(PARTS)
        stack, state, decoding, found = find_stack(file, names[0], ours, channel, frames, memory_limit)
        shape = (state.count, *decoding.shape(stack.shape)[1:])
        selection = cut_out(str(path), shape, frames, region)
        coordinates = Coordinates() if ours else read_coordinates(file, stack, decoding)
        layout = Layout(file, ours, shape, selection, coordinates)
        header = layout.header(motion, tilt, pixel_size, override_motion)
        state, numbers = state.of(slice(*selection.frames)), np.arange(*selection.frames)
        if live:
            chosen = _used(str(path), state, travel, phase)
            state, positions = state.of(chosen), layout.live(header.motion, chosen)
            numbers = numbers[chosen]
        else:
            series = {"vertical": travel, "axial": phase}.get(header.motion)
            positions = layout.positions(header.motion, along(series, shape[0]))
        opened = file.frames(stack) if isinstance(file, ZarrFile) else None
        expected, notes = _expected(file, stack, state, selection.region, verify)
        frames_of = Stack(
            stack,
            str(path),
            shape[0],
            numbers,
            selection.region,
            memory_limit,
            threads,
            decoding,
            opened,
            expected,
        )
        recording = Recording(
            file, stack, frames_of, selection, header, positions, layout, state, shape, live
        )
        if not ours:
            found += (*part_findings(file, names[0]), *unwritten_frames(recording))
        recording.findings += (*found, *decoding.findings, *coordinates.findings, *notes)
        opening.pop_all()  # the recording closes the file from now on
    return recording


def _explained(path: Path, error: InputError) -> InputError:
    """Return the error for a file that cannot be opened as HDF5 or Zarr, with what is read instead."""
    if format_of_surface(path) is not None:
        return InputError(f"{path} holds a surface, not frames: 'measure', 'view' and 'export' take it")
    if isinstance(error, UnknownContentError):
        return InputError(f"{error}; frames are read from {sources()}")
    return error


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


def is_recording(path: str | Path) -> bool:
    """Return whether an HDF5 or Zarr file is a recording written by mirrorskin."""
    with open_file(path) as file:
        return file.marked(MARK)


def is_result(path: str | Path) -> bool:
    """Return whether a file is a result written by mirrorskin, or a surface of another program."""
    if format_of_surface(path_of(path)) is not None:
        return True
    with open_file(path) as file:
        return file.marked(RESULT_MARK)
