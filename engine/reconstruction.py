"""From a source to a result: the method that fits the motion, and what a calibration adds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mirrorskin import io

if TYPE_CHECKING:
    from mirrorskin.io import Calibration, Result, Source


def reconstruct(
    source: Source, calibration: Calibration | str | Path | None = None, **options: Any
) -> Result:
    """Reconstruct what was touched, by the method that fits the source's motion.

    Parameters
    ----------
    source : Source
        An open recording, or anything else that frames come from. It is rewound first, if it can be.
    calibration : Calibration or path, optional
        What is known of the sensor, or a file that holds it; by default what the recording carries, if
        anything.
    **options
        Those of `mirrorskin.engine.press.press.reconstruct_press` for a vertical motion, of
        `mirrorskin.engine.rotation.rotation.reconstruct_rotation` for an axial one, of
        `mirrorskin.engine.slip.slip.reconstruct_slip` for a horizontal one or a twist.

    Raises
    ------
    mirrorskin.io.InputError
        The calibration is of another camera, or the input cannot be used.

    Examples
    --------
    >>> from mirrorskin import engine, hw
    >>> from mirrorskin.hw.twin import Vertical
    >>> press = hw.Twin(object="sphere", shape=(40, 40), pixel_size=0.26, movement=Vertical([0.1, 0.2, 0.3]))
    >>> engine.reconstruct(press).height.shape
    (40, 40)
    """
    known = calibrated(source, calibration)
    if source.motion == "vertical":
        from mirrorskin.engine.press.press import reconstruct_press

        result = reconstruct_press(known, **options)
    elif source.motion == "axial":
        from mirrorskin.engine.rotation.rotation import reconstruct_rotation

        result = reconstruct_rotation(known, **options)
    else:
        from mirrorskin.engine.slip.slip import reconstruct_slip

        result = reconstruct_slip(known, **options)
    return undistorted(result, known)


def calibrated(source: Source, calibration: Calibration | str | Path | None = None) -> Source:
    """Return a source as it is with a calibration.

    Parameters
    ----------
    source : Source
        One that has a calibration already stays as it is.
    calibration : Calibration or path, optional
        By default what a recording carries; without that, the source is returned as it is.

    Raises
    ------
    mirrorskin.io.InputError
        The calibration is of another camera, or the file is none.
    """
    if isinstance(source, io.Calibrated):
        return source
    if calibration is None:
        calibration = source.carried if isinstance(source, io.Recording) else None
    elif not isinstance(calibration, io.Calibration):
        calibration = io.open_calibration(calibration)
    return source if calibration is None else io.Calibrated(source, calibration)


def undistorted(result: Result, source: Source) -> Result:
    """Undistort a result's maps if its source's calibration has a lens: the last step of every method."""
    if not isinstance(source, io.Calibrated) or source.whole.lens is None:
        return result
    from mirrorskin.engine.undistort import undistort

    return undistort(result, source.whole.lens, source.region.origin)
