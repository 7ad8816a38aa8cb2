"""Plausibility check of the frames of a source."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.io.base.types import InputError, Source, exclusive_use
from mirrorskin.io.files.opening import open_recording
from mirrorskin.io.watch.watch import FIELD, TRAVEL, CheckReport, FrameChecker, Limits

_BLOCK = 32_000_000  # bytes of frames read at a time


def check(
    source: Source | str | Path,
    *,
    field_limits: Limits = FIELD,
    travel_limits: Limits = TRAVEL,
    progress: Callable[[int], None] | None = None,
    **opening: Any,
) -> CheckReport:
    """Read all frames of a source, and report whether they and their positions are plausible.

    Parameters
    ----------
    source : Source or path
        It is rewound before and after, if it can be. A path is opened by `open_recording`.
    field_limits : (float, float)
        Minimum and maximum plausible side of the field of view, mm.
    travel_limits : (float, float)
        Minimum and maximum plausible travel of a press, mm.
    progress : callable, optional
        Called with the number of frames so far.
    **opening
        Passed to `open_recording`, such as ``travel=``; only with a path.

    Returns
    -------
    CheckReport
        Facts and findings.

    Raises
    ------
    InputError
        The file or its parameters cannot be used.

    Examples
    --------
    >>> print(check("press.h5"))  # doctest: +SKIP
    press.h5
    frames  240 of 640 x 480, uint8
    """
    if isinstance(source, str | Path):
        with open_recording(source, **opening) as opened:
            return check(opened, field_limits=field_limits, travel_limits=travel_limits, progress=progress)
    if opening:
        raise InputError(f"{source.name} is open: give {', '.join(opening)} to io.open_recording")
    with exclusive_use(source):
        return _watched(source, progress).check(field_limits, travel_limits)


def _watched(source: Source, progress: Callable[[int], None] | None) -> FrameChecker:
    """Return what all frames of a source show, and rewind it before and after, if possible."""
    checker = FrameChecker(source, alone=True)
    if source.rewindable:
        source.rewind()
    size = math.prod(source.shape[1:]) * source.dtype.itemsize
    buffer = np.empty((max(1, min(_BLOCK // size, source.shape[0])), *source.shape[1:]), source.dtype)
    frames = 0
    while (block := source.read(buffer)) is not None:
        checker.push(block)
        frames += len(block.frames)
        if progress:
            progress(frames)
    if source.rewindable:
        source.rewind()
    return checker
