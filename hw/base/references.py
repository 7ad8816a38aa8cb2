"""The dark and the bright reference in a rig file: numbers, or picture files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.io.base.system import check_regular
from mirrorskin.io.files.arrays import read_array
from mirrorskin.io.formats.pictures import PICTURE_SUFFIXES, read_picture

if TYPE_CHECKING:
    from mirrorskin.hw.base.rig_file import CameraSettings

SUFFIXES = (".npy", *PICTURE_SUFFIXES)
"""Suffixes of reference files."""

_LARGEST = float(np.finfo(np.float32).max)


def read_reference(
    camera: CameraSettings, name: Literal["dark", "bright"], rig_file: str | Path
) -> NDArray[np.float32] | None:
    """Return a reference, (H, W), NaN at pixels without one; None if the rig file has none."""
    reference = camera.dark if name == "dark" else camera.bright
    if reference is None:
        return None
    where, dtype = f"{rig_file}: camera.{name}", np.dtype(camera.dtype)
    if isinstance(reference, str):
        counts = _read(Path(reference), where)
        _check_fits(counts, reference, camera, where)
    else:
        counts = np.full(camera.shape, reference, np.float64)
    finite = counts[~np.isnan(counts)]
    if not finite.size:
        raise InputError(f"{where}: {reference} contains only NaN; take the reference again")
    lowest, highest = (0, np.iinfo(dtype).max) if dtype.kind == "u" else (-_LARGEST, _LARGEST)
    low, high = finite.min(), finite.max()
    if not lowest <= low <= high <= highest:
        content = (
            f"{reference} contains {low:.6g} to {high:.6g}"
            if isinstance(reference, str)
            else f"it is {low:.6g}"
        )
        raise InputError(
            f"{where}: {content}, but counts of {dtype.name} are {lowest:g} to {highest:g}; take the "
            "reference with this camera"
        )
    return counts.astype(np.float32)


def check_references(camera: CameraSettings, rig_file: str | Path) -> None:
    """Refuse impossible references, and a bright one below the dark one at most pixels."""
    dark, bright = (read_reference(camera, name, rig_file) for name in ("dark", "bright"))
    if dark is None or bright is None:
        return
    span = bright - dark
    if 2 * np.count_nonzero(span > 0) < np.count_nonzero(~np.isnan(span)):
        raise InputError(
            f"{rig_file}: camera.bright is not above camera.dark at most of the pixels; are they swapped?"
        )


def _read(path: Path, where: str) -> NDArray[Any]:
    try:
        check_regular(path, "name an array or a picture relative to the rig file, or leave it out")
        return read_array(path) if path.suffix.lower() == ".npy" else read_picture(path)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _check_fits(counts: NDArray[Any], path: str, camera: CameraSettings, where: str) -> None:
    if counts.dtype != camera.dtype and counts.dtype.kind != "f":
        raise InputError(
            f"{where}: {path} contains {counts.dtype.name}, but the camera delivers "
            f"{camera.dtype}; take the reference with this camera, or correct camera.dtype"
        )
    if counts.shape != camera.shape:
        size = " x ".join(map(str, reversed(counts.shape))) or "a single number"
        rows, columns = camera.shape
        raise InputError(
            f"{where}: {path} is {size}, but the camera's pictures are {columns} x {rows} "
            "(columns x rows); take the reference with this camera, or correct camera.size"
        )
