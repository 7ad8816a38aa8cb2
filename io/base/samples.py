"""Decoding of stored samples: packed and missing values (CF conventions), order of axes, integer types."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.selection import Span
from mirrorskin.io.base.types import FRAME_DTYPES, Closing, InputError

ATTRIBUTES = (
    "_Unsigned",
    "_FillValue",
    "missing_value",
    "valid_range",
    "valid_min",
    "valid_max",
    "scale_factor",
    "add_offset",
)
"""Attributes of the CF conventions, sections 2.5.1 and 8.1, that define the meaning of stored values."""

_EXACT = 1 << 24  # float32 is exact to half a count up to this number
_DECODED_BYTES = 8_000_000  # bytes of stored samples that are decoded at once
_MOST_NUMBERS = 100  # maximum number of values in an attribute
_TARGETS = {"b": np.uint8, "i": np.uint16, "u": np.uint16, "f": np.float32}  # by kind; int8 becomes uint8


class Packing(NamedTuple):
    """Encoding of stored values: ``value = stored * scale + offset``, unknown if missing or not valid.

    ``unsigned``: stored integers are unsigned, although their type is signed.
    """

    scale: float = 1.0
    offset: float = 0.0
    missing: tuple[float, ...] = ()
    valid: tuple[float, float] = (-math.inf, math.inf)
    unsigned: bool = False

    @property
    def names(self) -> str:
        """The attributes that have an effect, for messages."""
        used = {
            "scale_factor": self.scale != 1,
            "add_offset": self.offset != 0,
            "_FillValue": bool(self.missing),
            "valid_range": self.valid != (-math.inf, math.inf),
            "_Unsigned": self.unsigned,
        }
        *others, last = [name for name, effective in used.items() if effective]
        return f"{', '.join(others)} and {last}" if others else last

    def stored(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return stored values in their actual type, which may be unsigned."""
        return values.view(values.dtype.str.replace("i", "u")) if self.unsigned else values

    def unpack(self, values: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
        """Return the decoded values; NaN where they are unknown."""
        stored = self.stored(values)
        if not (self.missing or self.scale != 1 or self.offset != 0 or np.isfinite(self.valid).any()):
            return stored
        unpacked: NDArray[Any] = (stored * np.float64(self.scale) + self.offset).astype(dtype)
        unknown = np.zeros(stored.shape, np.bool_)
        for missing in self.missing:
            unknown |= stored == missing
        if np.isfinite(self.valid).any():
            unknown |= (stored < self.valid[0]) | (stored > self.valid[1])
        unpacked[unknown] = np.nan
        return unpacked


def packing_of(attributes: Mapping[str, Any], dtype: np.dtype[Any], where: str) -> Packing | None:
    """Return how values are packed, from the attributes of the CF conventions; None if they are not.

    Parameters
    ----------
    attributes : mapping
        Numbers, arrays of numbers and texts by name; names not in `ATTRIBUTES` are ignored.
    dtype : dtype
        Type of the stored values.
    where : str
        Begins messages.

    Raises
    ------
    InputError
        An attribute is not a number.
    """
    unsigned = dtype.kind == "i" and str(attributes.get("_Unsigned", "")).lower() in ("true", "1")
    stored = np.dtype(f"u{dtype.itemsize}") if unsigned else dtype

    def numbers(name: str, *default: float) -> tuple[float, ...]:
        if name not in attributes:
            return default
        values = np.asarray(attributes[name]).reshape(-1)
        if values.dtype.kind not in "iuf" or not len(default) <= len(values) <= _MOST_NUMBERS:
            raise InputError(f"{where}: its attribute {name} is not a number: correct it")
        return tuple(float(value) for value in values)

    def as_stored(values: tuple[float, ...]) -> tuple[float, ...]:
        """Return numbers in the type of the stored values, if the attribute has that type."""
        if unsigned:
            return tuple(value + 2.0 ** (8 * dtype.itemsize) if value < 0 else value for value in values)
        return tuple(float(dtype.type(value)) for value in values) if dtype.kind == "f" else values

    missing = {*as_stored(numbers("_FillValue")), *as_stored(numbers("missing_value"))}
    if stored.kind in "iu":
        limits = np.iinfo(stored)
        missing = {value for value in missing if limits.min <= value <= limits.max}
    low, high = numbers("valid_range", -math.inf, math.inf)[:2]
    packing = Packing(
        numbers("scale_factor", 1.0)[0],
        numbers("add_offset", 0.0)[0],
        tuple(sorted(value for value in missing if not math.isnan(value))),
        (
            as_stored(numbers("valid_min", low))[0],
            as_stored(numbers("valid_max", high))[0],
        ),
        unsigned,
    )
    if not (math.isfinite(packing.scale) and packing.scale != 0 and math.isfinite(packing.offset)):
        raise InputError(
            f"{where}: scale_factor {packing.scale:g} and add_offset {packing.offset:g}: correct them"
        )
    return None if packing == Packing() else packing


def frame_dtype(dtype: DTypeLike, where: str) -> np.dtype[Any]:
    """Return the type to which samples of a type are converted; InputError if there is none.

    Samples of uint8, uint16 and float32 are unchanged. Booleans and other integers of 8 bits become uint8,
    other integers uint16 if they are from 0 to 65535, and other floating-point numbers float32; see
    `convert_samples`.
    """
    stored = np.dtype(dtype).newbyteorder("=")
    if stored in FRAME_DTYPES:
        return stored
    if stored.kind not in "biuf":
        raise InputError(
            f"{where} is of type {stored}: frames are uint8, uint16 or float32; convert it first"
        )
    return np.dtype(np.uint8 if stored == np.int8 else _TARGETS[stored.kind])


def convert_samples(
    values: NDArray[Any], dtype: np.dtype[Any], where: str, first: int = 0, out: NDArray[Any] | None = None
) -> NDArray[Any]:
    """Return frames in the type of `frame_dtype`; InputError if that type cannot represent a sample.

    Parameters
    ----------
    values : ndarray, (n, ...)
    dtype : dtype
        Type of the result.
    where : str
        Begins messages.
    first : int
        Number of the first frame, for messages.
    out : ndarray, optional
        Array for the result.
    """
    if values.size and values.dtype.newbyteorder("=") != dtype:
        if dtype.kind == "u":
            low, high = values.min().item(), values.max().item()
            limits = 0, np.iinfo(dtype).max
            remedy = "divide them, or write them as float32"
        else:
            low, high = float(np.fmin.reduce(values, None)), float(np.fmax.reduce(values, None))
            if not (math.isfinite(low) and math.isfinite(high)):
                finite = values[np.isfinite(values)]
                low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
            limits, remedy = (-_EXACT, _EXACT), "divide them"
        if low < limits[0] or high > limits[1]:
            wrong = low if low < limits[0] else high
            place = np.argwhere(values == wrong)[0]
            which = f"frame {first + int(place[0])}" if values.ndim == 3 else "it"
            raise InputError(
                f"{where}: {which} has a sample of {wrong:g}; {values.dtype} is read as {dtype}, "
                f"{limits[0]} to {limits[1]}: {remedy}"
            )
    if out is None:
        return values.astype(dtype, copy=False)
    out[...] = values
    return out


class Reader(Protocol):
    """Reader of stored frames; ``chunk`` is the shape of one read, ``length`` its number of frames."""

    how: str
    length: int
    scratch_bytes: int

    @property
    def chunk(self) -> Sequence[int]:
        """Shape of one stored block."""

    def fetch(self, spans: Sequence[Span], out: NDArray[Any], /) -> None:
        """Write a part, one span for each axis, into ``out``."""

    def close(self) -> None:
        """Release the file."""


@dataclass(frozen=True)
class Decoding:
    """Conversion of a stored array of three axes or more to frames.

    Attributes
    ----------
    stored : dtype
        Type of the stored samples, in the byte order of this machine.
    order : (int, int, int)
        Numbers of the stored axes for frames, rows and columns.
    fixed : mapping
        The index along each of the other axes, by the number of the axis.
    packing : Packing or None
    names : tuple of str
        Names of the stored axes; empty if unknown.
    findings : tuple of Finding
        The conversions.
    where : str
        The stack, for messages.
    """

    stored: np.dtype[Any]
    order: tuple[int, int, int] = (0, 1, 2)
    packing: Packing | None = None
    names: tuple[str, ...] = ()
    where: str = "the stack"
    matlab: bool = False
    fixed: Mapping[int, int] = field(default_factory=dict)
    dtype: np.dtype[Any] = field(init=False)

    def __post_init__(self) -> None:
        unpacked = self.stored
        if self.packing is not None:
            unpacked = self.packing.unpack(np.zeros(1, self.stored), np.float32).dtype
        object.__setattr__(self, "dtype", frame_dtype(unpacked, self.where))

    @property
    def plain(self) -> bool:
        """Whether the stored array can be used as frames without conversion."""
        return (
            not self.fixed and self.order == (0, 1, 2) and self.packing is None and self.dtype == self.stored
        )

    @property
    def turned(self) -> tuple[int, ...]:
        """The order of frames, rows and columns among the stored axes that are not fixed."""
        kept = sorted(self.order)
        return tuple(kept.index(axis) for axis in self.order)

    def shape(self, stored: Sequence[int]) -> tuple[int, int, int]:
        """Return frames, rows and columns of a stored shape."""
        frames, rows, columns = (int(stored[axis]) for axis in self.order)
        return frames, rows, columns

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The conversions."""
        problems = []
        if self.fixed:
            places = [
                f"{self.names[axis] if self.names else f'axis {axis}'} = {index}"
                for axis, index in sorted(self.fixed.items())
            ]
            problems.append(
                Finding("order of axes", f"{self.where}: the frames at {', '.join(places)} are read", False)
            )
        if self.order != (0, 1, 2) and self.turned != (0, 1, 2):
            shown = "the order of MATLAB" if self.matlab else f"the dimensions ({', '.join(self.names)})"
            axes = (
                "third, first, second" if self.matlab else ", ".join(self.names[axis] for axis in self.order)
            )
            problems.append(
                Finding("order of axes", f"{self.where} has {shown}: frames, rows, columns are {axes}", False)
            )
        if self.packing is not None:
            unknown = ", NaN where unknown" if self.dtype.kind == "f" else ""
            text = f"{self.where}: {self.packing.names} applied; samples are {self.dtype}{unknown}"
            problems.append(Finding("packed samples", text, False))
        elif self.dtype != self.stored:
            text = f"{self.where} is of type {self.stored}; samples are converted to {self.dtype}"
            problems.append(Finding("converted samples", text, False))
        return tuple(problems)

    def decode(self, values: NDArray[Any], first: int = 0, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return frames, (n, H, W), from stored samples in this order of axes; see `convert_samples`."""
        if self.packing is not None:
            values = self.packing.unpack(values, np.float32)
        return convert_samples(values, self.dtype, self.where, first, out)


class DecodedFrames(Closing):
    """Frames of a stored array that are decoded when they are read."""

    def __init__(self, reader: Reader, decoding: Decoding, shape: tuple[int, ...]) -> None:
        self._reader, self._decoding = reader, decoding
        self.how: str = f"{reader.how}, converted"
        self.shape, self.dtype = decoding.shape(shape), decoding.dtype
        self.chunk = decoding.shape(reader.chunk)
        self.length = self.chunk[0]
        self._axis = min(decoding.order)  # the first one that is not fixed
        row = math.prod(decoding.shape(shape)) // shape[self._axis] * decoding.stored.itemsize
        rows = int(reader.chunk[self._axis])
        self._rows = max(1, _DECODED_BYTES // (row * rows)) * rows
        self.scratch_bytes: int = reader.scratch_bytes + self._rows * row

    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Write frames, some rows and columns of each, into ``out``."""
        order, fixed, axis = self._decoding.order, self._decoding.fixed, self._axis
        stored: dict[int, Span] = {number: (index, index + 1) for number, index in fixed.items()}
        stored |= dict(zip(order, spans, strict=True))
        along = order.index(axis)
        start, stop = stored[axis]
        at = start
        while at < stop:
            end = min(stop, (at // self._rows + 1) * self._rows)
            here = stored | {axis: (at, end)}
            spans_here = [here[number] for number in sorted(here)]
            values = np.empty([last - first for first, last in spans_here], self._decoding.stored)
            self._reader.fetch(spans_here, values)
            part = [slice(None)] * 3
            part[along] = slice(at - start, end - start)
            first = at if along == 0 else spans[0][0]
            frames = values.squeeze(tuple(fixed)).transpose(self._decoding.turned)
            self._decoding.decode(frames, first, out[*part])
            at = end

    def close(self) -> None:
        """Release the file."""
        self._reader.close()


_ROWS = {"y", "row", "rows", "height", "lat", "latitude", "v"}
_COLUMNS = {"x", "col", "cols", "column", "columns", "width", "lon", "longitude", "u"}
_FRAMES = {
    *("t", "time", "frame", "frames", "image", "images", "shot", "n", "step", "steps"),
    *("travel", "phase", "displacement", "twist"),
}
_COLOURS = {"c", "channel", "channels", "band", "bands", "rgb", "colour", "color"}


def frame_axes(
    shape: Sequence[int], names: Sequence[str], channel: int | None, where: str
) -> tuple[tuple[int, int, int], dict[int, int]]:
    """Return the axes that are frames, rows and columns, and the index along each of the others.

    An axis of channels is read at ``channel``; other axes are left out if their length is 1.

    Parameters
    ----------
    shape : sequence of int
    names : sequence of str
        Names of the axes; empty if they are unknown.
    channel : int, optional
    where : str
        Begins messages.

    Raises
    ------
    InputError
        The axes are no stack of frames, or the channel is missing or does not exist.

    Examples
    --------
    >>> frame_axes((40, 2, 48, 64), ("t", "c", "y", "x"), 1, "stack")
    ((0, 2, 3), {1: 1})
    >>> frame_axes((1, 40, 48, 64), (), None, "stack")
    ((1, 2, 3), {0: 0})
    """
    kinds = [_kind_of(name) for name in names] if names else [""] * len(shape)
    fixed: dict[int, int] = {}
    colours = [axis for axis, kind in enumerate(kinds) if kind == "colours"] if len(shape) > 3 else []
    if len(colours) == 1 and (shape[colours[0]] > 1 or channel is not None):
        fixed[colours[0]] = _checked_channel(channel, shape[colours[0]], where)
    elif channel is not None:
        raise InputError(f"{where} has no axis of channels: leave --channel out")
    spare = [
        axis
        for axis, length in enumerate(shape)
        if length == 1 and kinds[axis] not in ("rows", "columns") and axis not in fixed
    ]
    excess = len(shape) - len(fixed) - 3
    # An axis of frames is left out last.
    spare.sort(key=lambda axis: (kinds[axis] == "frames", -axis))
    if excess < 0 or len(spare) < excess or (not names and len(spare) > excess > 0):
        shown = f" and the dimensions ({', '.join(names)})" if names else ""
        if not names and is_coloured_shape(shape):
            raise InputError(f"{where} has shape {tuple(shape)}: {COLOURED}")
        raise InputError(
            f"{where} has shape {tuple(shape)}{shown}: a stack of frames, (T, H, W), is needed, and other"
            " axes of length 1"
        )
    fixed |= dict.fromkeys(spare[:excess], 0)
    kept = [axis for axis in range(len(shape)) if axis not in fixed]
    order = order_of([names[axis] for axis in kept], where) if names else (0, 1, 2)
    frames, rows, columns = (kept[number] for number in order)
    return (frames, rows, columns), fixed


COLOURED = "the last axis is one of colours. Convert the frames to grey, or take one colour, frames[..., 1]"
"""What to do with an array of coloured frames."""


def is_coloured_shape(shape: Sequence[int]) -> bool:
    """Return whether a shape is that of frames, (T, H, W, 3), with red, green and blue, or also alpha.

    Examples
    --------
    >>> is_coloured_shape((8, 48, 64, 3)), is_coloured_shape((8, 48, 64))
    (True, False)
    """
    return len(shape) > 3 and shape[-1] in (3, 4)


def _checked_channel(channel: int | None, count: int, where: str) -> int:
    """Return the channel; InputError if there are several and none is chosen, or the one does not exist."""
    if channel is None or not 0 <= channel < count:
        chosen = "" if channel is None else f", and none is number {channel}"
        raise InputError(
            f"{where} has {count} channels{chosen}: --channel 0 to {count - 1} takes one of them"
        )
    return channel


def order_of(names: Sequence[str], where: str) -> tuple[int, int, int]:
    """Return the axes that are frames, rows and columns, from the names of three axes.

    Unknown names are accepted if the known names determine the order, or agree with (T, H, W).

    Raises
    ------
    InputError
        The names contradict a stack of frames, or leave its order open.

    Examples
    --------
    >>> order_of(("y", "x", "t"), "stack.nc")
    (2, 0, 1)
    """
    kinds = [_kind_of(name) for name in names]
    shown = f"{where} has the dimensions ({', '.join(names)})"
    if "colours" in kinds:
        raise InputError(f"{shown}: give one channel, as a stack (t, y, x)")
    stated = [kind for kind in kinds if kind]
    if len({*stated}) != len(stated):
        raise InputError(f"{shown}: name frames, rows and columns differently, such as (t, y, x)")
    if len(stated) == 2:
        kinds[kinds.index("")] = next(iter({"frames", "rows", "columns"} - {*stated}))
    elif len(stated) == 1 and stated[0] == "frames":
        rest = iter(("rows", "columns"))
        kinds = [kind or next(rest) for kind in kinds]
    elif len(stated) == 1 and kinds.index(stated[0]) != ("frames", "rows", "columns").index(stated[0]):
        raise InputError(f"{shown}, not (t, y, x), and the others are not known: name them t, y and x")
    if "" in kinds:
        return 0, 1, 2
    return kinds.index("frames"), kinds.index("rows"), kinds.index("columns")


def order_of_map(names: Sequence[str], where: str, components: bool = False) -> tuple[int, ...]:
    """Return the order of axes in which frames come first, and rows before columns.

    Other axes come before rows; of a map with components, the last one is that of the components.

    Raises
    ------
    InputError
        The names leave open which axes are rows and columns.

    Examples
    --------
    >>> order_of_map(("x", "y", "turn"), "height"), order_of_map(("vector", "y", "x"), "normals", True)
    ((2, 1, 0), (1, 2, 0))
    """
    kinds = [_kind_of(name) for name in names]
    frames, rows, columns, others = (
        [axis for axis, kind in enumerate(kinds) if kind in names]
        for names in (("frames",), ("rows",), ("columns",), ("", "colours"))
    )
    if len(rows) == len(columns) == 1:
        last = others[-1:] if components else []
        return *frames, *others[: len(others) - len(last)], *rows, *columns, *last
    end = len(names) - components
    if len(names) > 1 and (rows not in ([], [end - 2]) or columns not in ([], [end - 1])):
        raise InputError(f"{where} has the dimensions ({', '.join(names)}): name rows y and columns x")
    return *frames, *(axis for axis in range(len(names)) if axis not in frames)


def _kind_of(name: str) -> str:
    """Return the kind of an axis from its name; "" if it is unknown."""
    word = name.lower().strip()
    for kind, names in (("rows", _ROWS), ("columns", _COLUMNS), ("frames", _FRAMES), ("colours", _COLOURS)):
        if word in names:
            return kind
    return ""
