"""Heights that are known already, for what needs them: from a result, or from a simulation's truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.hdf5 import Hdf5File
from mirrorskin.io.layout import MARK
from mirrorskin.io.recording import Recording, open_recording
from mirrorskin.io.result import open_result
from mirrorskin.io.selection import Region, source_region
from mirrorskin.io.types import UNDISTORTED, InputError, Result


def open_heights(path: str | Path, source: Recording | None = None) -> NDArray[np.float32]:
    """Read the heights of a result, or the true ones of a simulated recording.

    Parameters
    ----------
    path : str or Path
    source : Recording, optional
        What they are wanted for: of a larger part of the picture, its part is cut out.

    Returns
    -------
    ndarray, (H, W), float32
        Millimetres; NaN where none is known.

    Raises
    ------
    InputError
        There is no such file, it holds no heights or those of other pixels, or it is damaged.

    Examples
    --------
    >>> open_heights("press-result.h5").shape  # doctest: +SKIP
    (480, 640)
    """
    path = Path(path)
    with Hdf5File(path) as file:
        ours = file.marked(MARK)
    if ours:
        with open_recording(path) as recording:
            height, part = None if recording.truth is None else recording.truth.height, None
    else:
        result = open_result(path)
        if result.process.get(UNDISTORTED):
            remedy = "give one that was made without a scale in its calibration"
            raise InputError(
                f"{path} holds undistorted heights, and frames are as the camera saw them: {remedy}"
            )
        height = _absolute(result)
        part = source_region(result.process)
    if height is None:
        raise InputError(f"{path} holds no heights: give a result of a press, or a simulation with truth")
    if source is not None:
        height = _cut(height, part or Region.whole(height.shape), source, str(path))
    if not np.isfinite(height).any():
        raise InputError(
            f"{path} holds no heights whose offset is known: give a result of a press, or of 'fuse'"
        )
    return height


def _cut(height: NDArray[np.float32], own: Region, source: Recording, name: str) -> NDArray[np.float32]:
    """Cut out what belongs to the pixels of a recording."""
    wanted = source.region
    if not (own.holds(wanted) and Region.whole(source.full_shape[1:]).holds(own)):
        raise InputError(
            f"{name} holds the heights of {own}, where {source.name} needs those of {wanted}: "
            "give some of all these pixels"
        )
    return np.ascontiguousarray(height[wanted.within(own)])


def _absolute(result: Result) -> NDArray[np.float32] | None:
    """Return the heights of a result without the pieces whose offset nobody knows."""
    height, piece, unknown = result.height, result.component, result.offset_unknown
    if height is None or piece is None or unknown is None or not unknown.any():
        return height
    return np.where((piece >= 0) & (unknown[piece] == 0), height, np.float32(np.nan))
