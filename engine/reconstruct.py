"""From a source to a result: the right way for the motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mirrorskin.engine.calibrated import calibrated, on_the_sheet
from mirrorskin.engine.press.vertical import reconstruct_press
from mirrorskin.engine.rotation.axial import reconstruct_rotation
from mirrorskin.io import Calibration, InputError, Result, Source


def reconstruct(
    source: Source, calibration: Calibration | str | Path | None = None, **options: Any
) -> Result:
    """Reconstruct what was touched, in the way that fits the source's motion.

    Parameters
    ----------
    source : Source
        An open recording, or anything else that frames come from. It is rewound first, if it can be.
    calibration : Calibration or path, optional
        What is known of the sensor, or a file that holds it; by default what the recording carries, if
        anything.
    **options
        Those of `reconstruct_press` for a vertical motion, of `reconstruct_rotation` for an axial one.

    Returns
    -------
    Result

    Raises
    ------
    mirrorskin.io.InputError
        The motion is not one that can be reconstructed, the calibration is of another camera, or the input
        cannot be used.
    """
    known = calibrated(source, calibration)
    return on_the_sheet(_reconstruct(known, **options), known)


def _reconstruct(source: Source, **options: Any) -> Result:
    """Do what fits the motion."""
    if source.motion == "vertical":
        return reconstruct_press(source, **options)
    if source.motion == "axial":
        return reconstruct_rotation(source, **options)
    raise InputError(
        f"{source.name} is of {source.motion} motion: only vertical and axial ones can be reconstructed yet"
    )
