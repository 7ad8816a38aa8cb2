"""Heights in a file: those of a result or a surface, or the true ones of a simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.selection import Region
from mirrorskin.io.base.types import (
    InputError,
)
from mirrorskin.io.base.url import path_of
from mirrorskin.io.files.opening import open_recording
from mirrorskin.io.files.recording import Recording
from mirrorskin.io.files.result_file import open_result
from mirrorskin.io.formats.registry import format_of_surface
from mirrorskin.io.model.result import absolute_heights
from mirrorskin.io.storage.layout import (
    MARK,
)
from mirrorskin.io.storage.zarr import open_file


def open_heights(path: str | Path, source: Recording | None = None) -> NDArray[np.float32]:
    """Read the heights of a result or a surface, or the true heights of a simulated recording.

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
    ours = False
    if format_of_surface(path) is None:
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
    height: NDArray[np.float32], region: Region, source: Recording, name: str
) -> NDArray[np.float32]:
    """Crop heights to the pixels of a recording."""
    target = source.region
    if not (region.holds(target) and Region.whole(source.full_shape[1:]).holds(region)):
        raise InputError(
            f"{name} contains the heights of {region}, where {source.name} needs those of {target}: "
            "give some of all these pixels"
        )
    return np.ascontiguousarray(height[target.within(region)])
