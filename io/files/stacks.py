"""Stacks of frames in HDF5 and Zarr: which datasets they are, and which of their frames are there."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.samples import Decoding, frame_axes, frame_dtype
from mirrorskin.io.base.selection import Region
from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.base.types import InputError
from mirrorskin.io.model.frames import is_blank, part_of_several
from mirrorskin.io.storage.hdf5 import Hdf5File
from mirrorskin.io.storage.layout import RESULT_MARK, STACK, RecordingState, read_state
from mirrorskin.io.storage.stack import Stack
from mirrorskin.io.storage.zarr import ZarrFile

_NUMBERED = re.compile(r"(.*?)([0-9]+)")
_PART = "data_"  # what the names of parts of detectors' files end in, before their number (NeXus)
_DIGITS = 3  # least number of digits of such a name
_FILES = re.compile(rf"(.+_{_PART})([0-9]{{{_DIGITS},}})")


def names_of_stack(file: Hdf5File, dataset: str | None) -> list[str]:
    """Return the name of another program's stack, or the names of its parts, in order.

    InputError if there is none, or several and ``dataset`` chooses none of them.
    """
    if dataset is not None:
        return [dataset]
    if file.marked(RESULT_MARK):
        raise InputError(f"{file.path} is a result: give the recording that it was made from")
    stored = list(file.stacks())
    names = stored or list(file.linked_stacks())
    parts = numbered_parts(names, linked=not stored)
    if len(parts) > 1 and len(parts) == len(names):
        return parts
    if not names:
        raise InputError(
            f"{file.path} contains no stack of frames (T, H, W): if a link leads to one, name it with "
            "--dataset"
        )
    if len(names) > 1:
        raise InputError(
            f"{file.path} contains {len(names)} stacks, {', '.join(names[:5])}: choose with --dataset"
        )
    return names


def numbered_parts(names: Iterable[str], linked: bool = False) -> list[str]:
    """Return the names that are parts of one stack, such as data_000001, in the order of their numbers.

    Links may have any name with a number. InputError if a number between them is missing.
    """
    families: dict[str, dict[int, str]] = defaultdict(dict)
    for name in names:
        match = _NUMBERED.fullmatch(name)
        if match and (linked or (match[1].endswith(_PART) and len(match[2]) >= _DIGITS)):
            families[match[1]][int(match[2])] = name
    parts = max(families.values(), key=len, default={})
    numbers = sorted(parts)
    missing = sorted({*range(numbers[0], numbers[-1])} - {*numbers}) if numbers else []
    if missing:
        raise InputError(
            f"{parts[numbers[0]]} to {parts[numbers[-1]]} are parts of a stack, and number {missing[0]} is"
            " missing: copy it there, or name one part with --dataset"
        )
    return [parts[number] for number in numbers]


def part_findings(file: Hdf5File, name: str) -> tuple[Finding, ...]:
    """Return the finding for a dataset or a file that is one of several numbered parts of a stack."""
    group, _, last = f"/{name.lstrip('/')}".rpartition("/")
    found = []
    if last[-1:].isdecimal():
        linked = file.is_link(group or "/", last)
        alike = [other for other in file.names(group or "/") if file.is_link(group or "/", other) == linked]
        parts = numbered_parts(alike, linked)
        if len(parts) > 1 and last in parts:
            found.append(part_of_several(last, parts, f"{file.path} without --dataset"))
    match = _FILES.fullmatch(file.path.stem)
    if match and not isinstance(file, ZarrFile):
        siblings = file.path.parent.glob(f"{match[1]}*{file.path.suffix}")
        others = sorted(part.name for part in siblings if _FILES.fullmatch(part.stem))
        if len(others) > 1:
            found.append(part_of_several(file.path.name, others, "the file that links to all of them"))
    return tuple(found)


def find_stack(
    file: Hdf5File,
    dataset: str,
    ours: bool,
    channel: int | None = None,
    frames: tuple[int, int | None] | None = None,
    memory_limit: int | None = None,
    least: int = 2,
) -> tuple[h5py.Dataset, RecordingState, Decoding, tuple[Finding, ...]]:
    """Return the stack of frames, its state, its decoding and findings; InputError if it cannot be read.

    ``frames`` are those that are needed: others need not be stored.
    """
    stack = file.follow(dataset, "name the stack with --dataset")
    where = file.where(stack)
    if not isinstance(stack, h5py.Dataset):
        raise InputError(f"{where} is not a dataset: name one with --dataset")
    with translate_os_errors(where):
        shape = stack.shape
    ours = ours and stack == file.find(STACK)
    if shape is None or (ours and len(shape) != 3):
        raise InputError(f"{where} has shape {shape}: a stack of frames, (T, H, W), is needed")
    if ours and channel is not None:
        raise InputError(f"{where}: a recording has no channels: leave --channel out")
    decoding = _decoding(file, stack, ours, where, channel)
    count, *picture = decoding.shape(shape)
    if 0 in picture:
        raise InputError(f"{where} has shape {shape}: its frames have no pixels; record it again")
    state, findings, stored = read_state(file, ours, stack, count), tuple[Finding, ...](), 0
    if not ours and count >= least:
        written, stored, findings = _written(file, stack, decoding, frames, memory_limit)
        state = RecordingState(written)
    if state.count < least:
        number = f"{state.count} frame{'' if state.count == 1 else 's'}"
        raise InputError(f"{where} contains {number}: at least {least} are needed; record more")
    file.check_frames(stack, stored or state.count, decoding.order[0])
    return stack, state, decoding, findings


def _decoding(file: Hdf5File, stack: h5py.Dataset, ours: bool, where: str, channel: int | None) -> Decoding:
    """Return how frames are decoded from the stored values, according to attributes and axes of the stack."""
    with translate_os_errors(where):
        dtype = stack.dtype.newbyteorder("=")
    frame_dtype(dtype, where)
    packing = file.packing(stack)
    if ours:
        return Decoding(dtype, packing=packing, where=where)
    if file.attribute_values(stack, "MATLAB_class") is not None and stack.ndim == 3:
        # MATLAB stores the axes in the opposite order, and a stack of pictures is (H, W, T) there.
        return Decoding(dtype, (0, 2, 1), packing, where=where, matlab=True)
    names = file.dimensions(stack)
    order, fixed = frame_axes(stack.shape, names, channel, where)
    return Decoding(dtype, order, packing, names, where, fixed=fixed)


def _written(
    file: Hdf5File,
    stack: h5py.Dataset,
    decoding: Decoding,
    frames: tuple[int, int | None] | None,
    memory_limit: int | None,
) -> tuple[int, int, tuple[Finding, ...]]:
    """Return the end of the frames whose chunks were written, their number, and a finding if any are missing.

    InputError if some that are needed are missing.
    """
    axis, where = decoding.order[0], file.where(stack)
    count = int(stack.shape[axis])
    length, chunks, present = file.written(stack, axis)
    if len(present) == chunks:
        return count, count, ()
    if not present:
        raise InputError(
            f"{where} has {count} frames by its shape, and none of them was written: record it again"
        )
    end = min((present[-1] + 1) * length, count)
    start, stop = frames or (0, None)
    first, last = start // length, -(-(end if stop is None else min(stop, end)) // length)
    missing = _first_missing(present, first, last)
    if missing is not None:
        until = present[bisect_left(present, missing)]
        raise InputError(
            f"{where}: frames {missing * length} to {until * length - 1} of {count} were never written, or"
            " are missing in this copy: copy it again, or choose others with --frames"
        )
    stored = min(len(present) * length, count)
    if present[-1] + 1 < chunks:
        end -= _blank_frames(file, stack, decoding, (max(0, end - length), end), memory_limit)
    if stop is not None:  # the frames that are there were chosen
        return end, stored, ()
    text = f"{where} has {count} frames by its shape, and only the first {end} were written: these are read"
    return end, stored, (Finding("number of frames", text),)


def _first_missing(present: Sequence[int], first: int, last: int) -> int | None:
    """Return the first number from ``first`` to ``last - 1`` that is not among sorted ones, or None."""
    start = bisect_left(present, first)
    if bisect_left(present, last) - start == last - first:
        return None
    return next(number for number, other in enumerate(present[start:], first) if number != other)


def _blank_frames(
    file: Hdf5File, stack: h5py.Dataset, decoding: Decoding, span: tuple[int, int], memory_limit: int | None
) -> int:
    """Return how many of the last frames of a span are blank, as those that were never written."""
    numbers: NDArray[np.intp] = np.arange(*span)
    reader = file.frames(stack) if isinstance(file, ZarrFile) else None
    picture = Region.whole(decoding.shape(stack.shape)[1:])
    part = Stack(stack, str(file.path), span[1], numbers, picture, memory_limit, 1, decoding, reader)
    buffer = np.empty((1, *picture.shape), decoding.dtype)
    blank = 0
    while blank < len(numbers) - 1 and is_blank(part.read(len(numbers) - 1 - blank, buffer)[0]):
        blank += 1
    part.close()
    return blank
