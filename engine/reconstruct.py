"""From a source to a result: the right way for the motion."""

from __future__ import annotations

from typing import Any

from mirrorskin.engine.press.vertical import reconstruct_press
from mirrorskin.engine.rotation.axial import reconstruct_rotation
from mirrorskin.io import InputError, Result, Source


def reconstruct(source: Source, **options: Any) -> Result:
    """Reconstruct what was touched, in the way that fits the source's motion.

    Parameters
    ----------
    source : Source
        An open recording, or anything else that frames come from. It is rewound first, if it can be.
    **options
        Those of `reconstruct_press` for a vertical motion, of `reconstruct_rotation` for an axial one.

    Returns
    -------
    Result

    Raises
    ------
    mirrorskin.io.InputError
        The motion is not one that can be reconstructed, or the input cannot be used.
    """
    if source.motion == "vertical":
        return reconstruct_press(source, **options)
    if source.motion == "axial":
        return reconstruct_rotation(source, **options)
    raise InputError(
        f"{source.name} is of {source.motion} motion: only vertical and axial ones can be reconstructed yet"
    )
