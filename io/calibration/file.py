"""Calibration files: read them, write them, and replace one part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mirrorskin.io.atomic import new_hdf5
from mirrorskin.io.calibration.fit import check_camera
from mirrorskin.io.calibration.layout import ENTRY, MARK, write_calibration
from mirrorskin.io.calibration.reading import carried_by, read_calibration
from mirrorskin.io.calibration.types import GROUPS, KINDS, Calibration, CameraId, Part
from mirrorskin.io.hdf5 import Hdf5File
from mirrorskin.io.types import InputError, ProcessValue

_MAKE = "'mirrorskin calibrate' makes one"


def open_calibration(path: str | Path) -> Calibration:
    """Read a calibration file, or the calibration that a recording or a result carries.

    Raises
    ------
    InputError
        There is no such file, it holds no calibration, one of another version, or it is damaged.
    """
    with Hdf5File(Path(path)) as file:
        if file.marked(MARK):
            return read_calibration(file, ENTRY, str(path))
        carried = carried_by(file)
    if carried is None:
        raise InputError(f"{path} is no calibration: {_MAKE}")
    return carried


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration; the file exists whole or not at all.

    Raises
    ------
    InputError
        It cannot be written there.
    """
    with new_hdf5(Path(path)) as new:
        new.root.attrs.update(NX_class="NXroot", default="entry")
        write_calibration(new.root, calibration, ENTRY)


def update_calibration(
    path: str | Path,
    part: Part,
    camera: CameraId,
    process: Mapping[str, ProcessValue] | None = None,
) -> Calibration:
    """Add a part to a calibration file, or replace that part in it; without such a file, make one.

    Parameters
    ----------
    path : str or Path
    part : References, Lens, WallResponse, Precession or Gel
    camera : CameraId
        Which camera the part is of.
    process : mapping, optional
        How the part came about: "sources", "date" and so on. The part's name is put before each.

    Returns
    -------
    Calibration
        What the file holds now.

    Raises
    ------
    InputError
        The file is no calibration, one of another camera, or cannot be written.
    """
    path = Path(path)
    before = _there(path, camera)
    name = next(name for name, kind in KINDS.items() if isinstance(part, kind))
    command = GROUPS[name]
    told = {key: value for key, value in before.process.items() if not key.startswith(f"{command}.")}
    told |= {f"{command}.{key.removeprefix(f'{command}.')}": value for key, value in (process or {}).items()}
    one: dict[str, Any] = {name: part}
    after = replace(before, process=told, name=str(path), **one)
    save_calibration(after, path)
    return after


def _there(path: Path, camera: CameraId) -> Calibration:
    """Return the calibration in a file, or an empty one where there is no file."""
    if not path.exists():
        return Calibration(camera)
    with Hdf5File(path) as file:
        if not file.marked(MARK):
            raise InputError(f"{path} is there and no calibration: name another file with -o")
        before = read_calibration(file, ENTRY, str(path))
    check_camera(before, camera, "this", "name another file with -o")
    return replace(before, camera=camera) if camera.name else before
