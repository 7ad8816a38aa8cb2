"""What presses that a part of a calibration is learned from have in common: camera and pixel size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mirrorskin.cli.positions import Given
    from mirrorskin.io import Calibration, CameraId, Source


def with_scale(told: Given, known: Calibration | None) -> Given:
    """Return what recordings are opened with, and the pixel size of the calibration's scale, if it has one.

    Raises
    ------
    mirrorskin.io.InputError
        ``--pixel-size`` says otherwise.
    """
    from mirrorskin.io import InputError
    from mirrorskin.io.calibration.sizes import differ

    if known is None or known.lens is None:
        return told
    size, given = known.lens.pixel_size, told.get("pixel_size", known.lens.pixel_size)
    if differ(given, size):
        raise InputError(
            f"--pixel-size says {given[0]:.5g} mm, the scale of {known.name} {size[0]:.5g} mm: leave it out"
        )
    return told | {"pixel_size": size}


def one_camera(sources: Sequence[Source]) -> CameraId:
    """Return the camera that all recordings are of.

    Raises
    ------
    mirrorskin.io.InputError
        They are of several, or differ in size or type of sample.
    """
    from mirrorskin import io

    cameras = [io.CameraId(source.header.camera, source.shape[1:], source.dtype) for source in sources]
    names = {camera.name for camera in cameras} - {""}
    if len(names) > 1:
        raise io.InputError(f"the recordings are of {' and '.join(sorted(names))}: take all with one camera")
    first = cameras[0]
    for source, camera in zip(sources, cameras, strict=True):
        if (camera.shape, camera.dtype) != (first.shape, first.dtype):
            raise io.InputError(
                f"{source.name} is of {camera}, {sources[0].name} of {first}: take all with one camera"
            )
    return io.CameraId("".join(names), first.shape, first.dtype)
