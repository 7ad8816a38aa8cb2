"""Dark and bright references of a scan: as the rig file gives them, or taken before it."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.io.pictures import PICTURE_SUFFIXES, read_picture

if TYPE_CHECKING:
    from mirrorskin.hw.rig_file import CameraSettings

SUFFIXES = (".npy", *PICTURE_SUFFIXES)
"""How the names of reference files end."""

Counts = NDArray[np.float32]

_LARGEST = float(np.finfo(np.float32).max)


def read_reference(given: float | Path, camera: CameraSettings, where: str) -> Counts:
    """Read a reference.

    Parameters
    ----------
    given : float or Path
        Counts of all pixels, or a file: .npy, PNG or TIFF, of the camera's size, of its type or of floats.
    camera : CameraSettings
    where : str
        The rig file and the key, for messages.

    Returns
    -------
    ndarray, (H, W), float32
        Counts of each pixel; NaN where it has no reference.

    Raises
    ------
    InputError
        The file cannot be read, does not fit the camera, or holds counts that the camera cannot give.
    """
    if isinstance(given, Path):
        counts = _read(given, where)
        _check_fits(counts, given, camera, where)
    else:
        counts = np.full(camera.shape, given)
    _check_range(counts, given, camera, where)
    return counts.astype(np.float32)


def check_references(camera: CameraSettings, where: str) -> None:
    """Refuse references that the camera cannot have, or a bright one that is not above the dark one.

    Raises
    ------
    InputError
        As `read_reference`, and if they are out of order at most pixels.
    """
    given = {"dark": camera.dark, "bright": camera.bright}
    read = {
        name: read_reference(value, camera, f"{where}: camera.{name}")
        for name, value in given.items()
        if value is not None
    }
    if len(read) < 2:
        return
    span = read["bright"] - read["dark"]
    if 2 * np.count_nonzero(span > 0) < np.count_nonzero(~np.isnan(span)):
        raise InputError(
            f"{where}: camera.bright is not above camera.dark at most of the pixels; are they exchanged?"
        )


def _read(path: Path, where: str) -> NDArray[Any]:
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise InputError(
            f"{where}: {path} cannot be read: {error.strerror}; put it beside the rig file, or leave it out"
        ) from error
    if not stat.S_ISREG(mode):
        raise InputError(f"{where}: {path} is no file; name a picture beside the rig file")
    try:
        return _read_npy(path) if path.suffix.lower() == ".npy" else read_picture(path)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _read_npy(path: Path) -> NDArray[Any]:
    try:
        counts = np.load(path, allow_pickle=False)
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror or error}; write it with numpy.save"
        ) from error
    except (ValueError, EOFError) as error:
        raise InputError(f"{path} is no array: {error}; write it with numpy.save") from error
    if not isinstance(counts, np.ndarray):  # an archive of several
        counts.close()
        raise InputError(f"{path} holds several arrays; write one with numpy.save")
    return counts


def _check_fits(counts: NDArray[Any], path: Path, camera: CameraSettings, where: str) -> None:
    if counts.dtype != camera.dtype and counts.dtype.kind != "f":
        raise InputError(
            f"{where}: {path} is of {counts.dtype.name}, and the camera of {camera.dtype.name}; "
            "take the reference with this camera, or correct camera.dtype"
        )
    if counts.shape != camera.shape:
        told = " x ".join(map(str, reversed(counts.shape))) or "a single number"
        rows, columns = camera.shape
        raise InputError(
            f"{where}: {path} is {told}, and the camera's pictures {columns} x {rows} (columns x rows); "
            "take the reference with this camera, or correct camera.size"
        )


def _check_range(counts: NDArray[Any], given: float | Path, camera: CameraSettings, where: str) -> None:
    """Refuse counts that the camera cannot give."""
    known = counts[~np.isnan(counts)]
    if not known.size:
        raise InputError(f"{where}: {given} holds nothing but NaN; take the reference again")
    low, high = known.min(), known.max()
    bounds = (0, np.iinfo(camera.dtype).max) if camera.dtype.kind == "u" else (-_LARGEST, _LARGEST)
    if not bounds[0] <= low <= high <= bounds[1]:
        told = f"{given} holds {low:.6g} to {high:.6g}" if isinstance(given, Path) else f"it is {low:.6g}"
        raise InputError(
            f"{where}: {told}, and counts of {camera.dtype.name} go from {bounds[0]:g} to {bounds[1]:g}; "
            "take the reference with this camera"
        )
