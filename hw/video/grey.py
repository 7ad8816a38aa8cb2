"""One sample a pixel from the pictures that cameras give."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError

_CONVERSIONS = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}


def to_grey(picture: NDArray[Any], out: NDArray[Any], name: str) -> None:
    """Write a picture's grey to a frame.

    A grey picture is copied. Of two channels (YUYV) the first is taken, the luma as the camera sent it. BGR
    becomes the luma of ITU-R BT.601, which is exactly the one value where all three are equal, as a grey
    camera's are.

    Parameters
    ----------
    picture : ndarray, (H, W) or (H, W, channels)
    out : ndarray, (H, W)
    name : str
        What messages call the camera.

    Raises
    ------
    InputError
        The picture's size or type is not the frame's.
    """
    if picture.shape[:2] != out.shape or picture.dtype != out.dtype:
        raise InputError(
            f"{name} gives pictures of {_say(picture)}, and {_say(out)} is asked for: "
            "set camera.size, camera.dtype or camera.fourcc in the rig file so that they agree"
        )
    channels = 1 if picture.ndim == 2 else picture.shape[2]
    if channels in _CONVERSIONS:
        cv2.cvtColor(picture, _CONVERSIONS[channels], dst=out)
    elif picture.ndim == 2:
        np.copyto(out, picture)
    else:
        np.copyto(out, picture[..., 0])


def _say(picture: NDArray[Any]) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]} {picture.dtype}"
