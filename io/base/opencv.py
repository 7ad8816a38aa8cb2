"""OpenCV for pictures, without its messages, and with exceptions for all errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.system import check_unpacked
from mirrorskin.io.base.types import InputError

_AT_ONCE = 1 << 20  # samples that are compared or converted at once
_COLOURS = ("red", "green", "blue", "opacity")


@contextmanager
def quiet_opencv() -> Iterator[Any]:
    """Yield OpenCV with its messages turned off: callers report errors themselves."""
    import cv2  # slower to import than the rest of mirrorskin.io together

    # OpenCV 5 moved this function.
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    level = set_level(0)
    try:
        yield cv2
    finally:
        set_level(level)


def decode(data: bytes | NDArray[np.uint8], name: str, *, upright: bool = False) -> NDArray[Any]:
    """Decode a picture as stored, (H, W) or (H, W, channels): blue, green, red, opacity.

    ``upright`` applies the orientation that a JPEG states, and omits its opacity.
    """
    with quiet_opencv() as cv2:
        flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH if upright else cv2.IMREAD_UNCHANGED
        try:
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:
            picture = None
    if picture is None:
        raise InputError(f"{name} cannot be decoded: it is damaged, or of a kind that OpenCV does not read")
    return np.asarray(picture)


def encode(suffix: str, picture: NDArray[Any], parameters: Sequence[int] = ()) -> bytes:
    """Encode a picture; ValueError if OpenCV, which only returns a flag, fails."""
    with quiet_opencv() as cv2:
        success, data = cv2.imencode(suffix, picture, list(parameters))
    if not success:
        raise ValueError(f"OpenCV cannot encode {picture.shape} {picture.dtype} as {suffix}")
    return bytes(data)


def check_picture(
    name: str, columns: int, rows: int, itemsize: int, channels: int = 1, packed: int = 0, copies: int = 0
) -> None:
    """Raise InputError if a picture takes more memory than a file may, before it is decoded.

    All that exists at the same time is counted: its packed bytes twice (as read, and as decoded), its samples
    with ``copies`` of them, and grey samples twice (converted from colours, and where the caller needs them).
    """
    grey = 2 if channels > 1 else 1
    size = 2 * packed + columns * rows * itemsize * (channels * (1 + copies) + grey)
    check_unpacked(size, f"{name}: a picture of {columns} x {rows}", "save it as smaller pictures")


def rows_of(picture: NDArray[Any]) -> Iterator[slice]:
    """Yield parts of a picture, which are processed one after the other to take little memory."""
    step = max(1, _AT_ONCE // max(1, picture[:1].size))
    for start in range(0, len(picture), step):
        yield slice(start, start + step)


def look_up(table: NDArray[Any], indices: NDArray[Any]) -> NDArray[Any]:
    """Return ``table[indices]``, for which NumPy would convert all indices to 8 bytes each."""
    values = np.empty(indices.shape, table.dtype)
    for rows in rows_of(indices):
        values[rows] = table[indices[rows]]
    return values


def is_coloured(picture: NDArray[Any]) -> bool:
    """Return whether the colours of a picture, (H, W) or (H, W, channels), differ anywhere."""
    if picture.ndim == 2:
        return False
    return not all(
        np.array_equal(picture[rows, :, 0], picture[rows, :, k], equal_nan=True)
        for rows in rows_of(picture)
        for k in (1, 2)
    )


def to_grey(picture: NDArray[Any], name: str, channel: int | None = None) -> NDArray[Any]:
    """Return a picture, grey or blue, green, red, as grey samples, (H, W).

    Without a channel these are the common value of equal colours, otherwise the luma of ITU-R BT.601, 0.299 R
    + 0.587 G + 0.114 B, as computed by OpenCV; opacity is ignored. Channel 0 is red, 1 green, 2 blue.
    """
    if channel is not None:
        order = [2, 1, 0, 3][: 1 if picture.ndim == 2 else picture.shape[2]]
        if picture.ndim == 2 or not 0 <= channel < len(order):
            names = ", ".join(f"{k} {colour}" for k, colour in enumerate(_COLOURS[: len(order)]))
            problem = "is grey: leave --channel out" if picture.ndim == 2 else f"has the channels {names}"
            raise InputError(f"{name} has no channel {channel}: it {problem}")
        return picture[..., order[channel]]
    if not is_coloured(picture):
        return picture if picture.ndim == 2 else picture[..., 0]
    grey = np.empty(picture.shape[:2], picture.dtype)
    with quiet_opencv() as cv2:
        for rows in rows_of(picture):
            grey[rows] = cv2.cvtColor(np.ascontiguousarray(picture[rows, :, :3]), cv2.COLOR_BGR2GRAY)
    return grey
