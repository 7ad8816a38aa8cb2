"""Comparison of a recording with the calibration of its sensor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mirrorskin.engine.base.reconstruction import calibrated, method_for
from mirrorskin.engine.base.running import Progress, Run
from mirrorskin.engine.diagnosis.sensor_health import find_clear_change
from mirrorskin.io import Calibration, InputError, Source
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.threads import computes


@computes
def compare_brightness(
    source: Source,
    calibration: Calibration | str | Path | None = None,
    progress: Progress | None = None,
) -> Finding | None:
    """Compare the brightness of a press or a rotation with the calibration of its sensor.

    Every reconstruction does this, too. See the documentation, "Health of a sensor".

    Parameters
    ----------
    source : Source
        A recording, which is read once, and rewound before and after.
    calibration : Calibration or path, optional
        By default that with the recording; without one, the numbers that the recording states.
    progress : callable, optional
        Called with the number of frames so far.

    Returns
    -------
    Finding or None
        By how much the brightness has changed, if it is clear. None, too, if the recording has nothing to be
        compared with, or cannot be reconstructed.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin.twin import Axial, Twin
    >>> movement = Axial(np.pi / 4 * np.arange(8), tilt=0.05, press=1.0)
    >>> turn = Twin(object="step", shape=(80, 80), pixel_size=0.13, movement=movement, pattern="linear")
    >>> compare_brightness(turn) is None
    True
    """
    if source.motion not in ("vertical", "axial") or not source.rewindable:
        return None
    source.rewind()
    try:
        opened = calibrated(source, calibration)
        plan = replace(method_for(source.motion)().plan(opened), steps=[])
        result = Run(plan, opened).complete(progress)
    except InputError:
        return None
    finally:
        source.rewind()
    return find_clear_change(result.fitted, source.motion)
