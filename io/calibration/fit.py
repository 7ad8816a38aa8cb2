"""Whether a calibration is one of this camera, and what is left of it for a part of the picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from mirrorskin.io.calibration.fields import stored
from mirrorskin.io.calibration.types import Calibration, CameraId, Part
from mirrorskin.io.region import Region
from mirrorskin.io.types import InputError

AGAIN = "calibrate again, or give that camera's"


def check_camera(calibration: Calibration, camera: CameraId, what: str, remedy: str = AGAIN) -> None:
    """Refuse a calibration of another camera.

    Parameters
    ----------
    calibration : Calibration
    camera : CameraId
        That it is to be used for; one without a name may be any.
    what : str
        What to call that in the message.
    remedy : str, optional
        The end of the message.

    Raises
    ------
    InputError
        Name, size of the picture or type of its samples differ.
    """
    ways = list(_differences(calibration.camera, camera))
    if ways:
        mine = " and ".join(way[0] for way in ways)
        its = " and ".join(way[1] for way in ways)
        raise InputError(f"{calibration.name or 'the calibration'} is of {mine}, {what} of {its}: {remedy}")


def cropped(calibration: Calibration, region: Region, pixel_size: tuple[float, float] | None) -> Calibration:
    """Return what is left of a calibration for a part of its camera's picture.

    Maps are cut; places are told from the part's centre.

    Parameters
    ----------
    calibration : Calibration
        Of the whole picture.
    region : Region
    pixel_size : (float, float) or None
        Millimetres; without it, places stay as they are.
    """
    picture = calibration.camera.shape
    if region == Region.whole(picture):
        return calibration
    right, up = region.centre(picture, pixel_size) if pixel_size else (0.0, 0.0)
    parts: dict[str, Any] = {
        name: _cut(part, region, right, up) for name, part in calibration.parts().items()
    }
    return replace(calibration, camera=replace(calibration.camera, shape=region.shape), **parts)


def _differences(mine: CameraId, its: CameraId) -> Iterator[tuple[str, str]]:
    """Yield what the two say of something in which they differ."""
    if mine.name and its.name and mine.name != its.name:
        yield f"the camera {mine.name!r}", f"{its.name!r}"
    if tuple(mine.shape) != tuple(its.shape):
        yield f"{mine.shape[1]} x {mine.shape[0]} pixels", f"{its.shape[1]} x {its.shape[0]}"
    if np.dtype(mine.dtype) != np.dtype(its.dtype):
        yield f"{np.dtype(mine.dtype).name} samples", np.dtype(its.dtype).name


def _cut(part: Part, region: Region, right: float, up: float) -> Part:
    """Cut a part's maps, and tell its places from a centre that lies so far off."""
    changed: dict[str, Any] = {}
    for name, how in stored(part).items():
        value = getattr(part, name)
        if value is None:
            continue
        if how.is_map:
            changed[name] = np.ascontiguousarray(value[region.slices])
        elif how.place:
            changed[name] = (value[0] - right, value[1] - up, *value[2:])
    return replace(part, **changed)
