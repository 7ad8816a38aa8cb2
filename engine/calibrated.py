"""What a calibration does to a reconstruction: before it, to the source, and after it, to the maps."""

from __future__ import annotations

from pathlib import Path

from mirrorskin.engine.undistort import undistort
from mirrorskin.io import Calibrated, Calibration, Gel, Recording, Result, Source, open_calibration


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
    if isinstance(source, Calibrated):
        return source
    if calibration is None:
        calibration = source.carried if isinstance(source, Recording) else None
    elif not isinstance(calibration, Calibration):
        calibration = open_calibration(calibration)
    return source if calibration is None else Calibrated(source, calibration)


def gel_of(source: Source) -> Gel | None:
    """Return the gel of a source's calibration, if that tells of one."""
    return source.calibration.gel if isinstance(source, Calibrated) else None


def on_the_sheet(result: Result, source: Source) -> Result:
    """Undistort a result's maps if its source's calibration has a lens: the last that is done to them."""
    if not isinstance(source, Calibrated) or source.whole.lens is None:
        return result
    return undistort(result, source.whole.lens, source.region.origin)
