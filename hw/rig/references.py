"""Dark and bright references of a scan: as the rig file gives them, or taken before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.rig.reference_files import read_reference
from mirrorskin.hw.rig.rig import Rig

_DARK_FRAMES = 16


def given_reference(rig: Rig, name: str) -> NDArray[np.float32] | None:
    """Return a reference that the rig file gives, (H, W), or None.

    Parameters
    ----------
    rig : Rig
    name : {"dark", "bright"}

    Raises
    ------
    InputError
        It cannot be read, or does not fit the camera.
    """
    camera = rig.settings.camera
    value = camera.dark if name == "dark" else camera.bright
    return None if value is None else read_reference(value, camera, f"{rig.settings.path}: camera.{name}")


def take_dark(rig: Rig, since: float, count: int = _DARK_FRAMES) -> NDArray[np.float32]:
    """Take the mean of some frames of a sheet that touches nothing, (H, W), float32.

    Parameters
    ----------
    rig : Rig
        The body is lifted.
    since : float
        Frames that arrived earlier do not count, seconds of `time.monotonic`.
    count : int
        How many frames.

    Raises
    ------
    HardwareError
        The camera gives none.
    """
    total = np.zeros(rig.camera.shape)
    left = count
    rig.camera.flush()
    while left:
        frames = rig.take(left)
        new = frames.pixels[frames.time > since]
        total += new.sum(axis=0, dtype=np.float64)
        left -= len(new)
    return (total / count).astype(np.float32)
