"""What presses that a part of a calibration is learned from have in common: call, camera and pixel size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mirrorskin.cli.stack import StackOptions
    from mirrorskin.io import Calibration, CameraId, Source


def check_call(paths: Sequence[Path], rig: Path | None, **asked: str | None) -> None:
    """Refuse presses that are neither named nor taken, or both, and what a rig is asked for without one.

    Raises
    ------
    mirrorskin.io.InputError
    """
    from mirrorskin.io import InputError

    if rig is None and not paths:
        raise InputError("no recordings: name those of a ball, or take them with --rig RIG.toml")
    if rig is not None and paths:
        raise InputError("recordings and --rig both give the presses: leave one of them out")
    for name, value in asked.items():
        if rig is None and value is not None:
            raise InputError(f"--{name} says how a rig is to press: give --rig, too, or leave it out")


def with_scale(told: StackOptions, known: Calibration | None) -> StackOptions:
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


def camera_of(source: Source) -> CameraId:
    """Return the camera that a recording is of."""
    from mirrorskin.io import CameraId

    _, rows, columns = source.shape
    return CameraId(source.header.camera, (rows, columns), source.dtype)


def one_camera(
    names_of: Sequence[str], cameras: Sequence[CameraId], known: Calibration | None, output: Path
) -> CameraId:
    """Return the camera that all recordings are of, if it is that of the calibration.

    Parameters
    ----------
    names_of : sequence of str
        What the recordings are called.
    cameras : sequence of CameraId
    known : Calibration or None
        What is in the file already.
    output : Path
        The file.

    Raises
    ------
    mirrorskin.io.InputError
        They are of several, differ in size or type of sample, or are of another than the calibration.
    """
    from mirrorskin import io

    names = {camera.name for camera in cameras} - {""}
    if len(names) > 1:
        raise io.InputError(f"the recordings are of {' and '.join(sorted(names))}: take all with one camera")
    first = cameras[0]
    for name, camera in zip(names_of, cameras, strict=True):
        if (camera.shape, camera.dtype) != (first.shape, first.dtype):
            raise io.InputError(f"{name} is of {camera}, {names_of[0]} of {first}: take all with one camera")
    one = io.CameraId("".join(names), first.shape, first.dtype)
    if known is not None:
        io.check_camera(known, one, names_of[0], f"name another file than {output} with -o")
    return one
