"""OpenCV for pictures, without its messages, and with exceptions for all errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.types import InputError

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
        done, data = cv2.imencode(suffix, picture, list(parameters))
    if not done:
        raise ValueError(f"OpenCV cannot encode {picture.shape} {picture.dtype} as {suffix}")
    return bytes(data)


def is_coloured(picture: NDArray[Any]) -> bool:
    """Return whether the colours of a picture, (H, W) or (H, W, channels), differ anywhere."""
    if picture.ndim == 2:
        return False
    first = picture[..., 0]
    return not all(np.array_equal(first, picture[..., one], equal_nan=True) for one in (1, 2))


def to_grey(picture: NDArray[Any], name: str, channel: int | None = None) -> NDArray[Any]:
    """Return a picture, grey or blue, green, red, as grey samples, (H, W).

    Without a channel these are the common value of equal colours, otherwise the luma of ITU-R BT.601, 0.299 R
    + 0.587 G + 0.114 B, as computed by OpenCV; opacity is ignored. Channel 0 is red, 1 green, 2 blue.
    """
    if channel is not None:
        order = [2, 1, 0, 3][: 1 if picture.ndim == 2 else picture.shape[2]]
        if picture.ndim == 2 or not 0 <= channel < len(order):
            names = ", ".join(f"{k} {one}" for k, one in enumerate(_COLOURS[: len(order)]))
            there = "is grey: leave --channel out" if picture.ndim == 2 else f"has the channels {names}"
            raise InputError(f"{name} has no channel {channel}: it {there}")
        return picture[..., order[channel]]
    if not is_coloured(picture):
        return picture if picture.ndim == 2 else picture[..., 0]
    with quiet_opencv() as cv2:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_BGR2GRAY))
