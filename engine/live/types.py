"""What is known while the body still moves, and how well the work keeps up with the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Motion

WAITED, PUSHED, UPDATED, SHOWN = "waited", "push", "update", "frame to map"
STAGES = (WAITED, PUSHED, UPDATED, SHOWN)
"""What is timed: a frame from its arrival until it was taken, a push of frames, an update, and from the
newest frame's arrival until the maps that it is in."""


@dataclass(frozen=True, slots=True)
class Update:
    """What the frames so far tell.

    Maps are the receiver's own: nothing writes to them any more. Those that are not known, or not yet, are
    None.

    Attributes
    ----------
    frames : int
        That were used so far.
    time : float
        Of the newest of them, seconds on the scale of ``Block.time``; NaN where the source tells none.
    motion : {"vertical", "axial"}
    position : float
        Of the body in the newest frame: travel, mm, or phase, radians.
    picture : ndarray, (H, W), uint8, uint16 or float32
        The newest frame, raw counts.
    height : ndarray, (H, W), float32
        Millimetres; NaN where there is no answer.
    normals : ndarray, (H, W, 3), float32
        Unit vectors; NaN where there is no answer.
    contact : ndarray, (H, W), uint8
        1 where sheet and object touch: of a press so far, of a rotation in all frames of its window.
    edges : ndarray, (H, W), uint8
        1 on thin lines where the normal jumps or contact ends; of the last frames for which there was time.
    contact_area : float
        Square millimetres.
    offset_unknown : bool
        Whether heights are relative, the mean of each connected piece being 0.
    """

    frames: int
    time: float
    motion: Motion
    position: float
    picture: NDArray[Any]
    height: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None
    contact: NDArray[np.uint8] | None = None
    edges: NDArray[np.uint8] | None = None
    contact_area: float | None = None
    offset_unknown: bool = False


@dataclass(frozen=True, slots=True)
class Latency:
    """Seconds that a stage took, of the last few thousand times: the median, and what 99 % stay below.

    Both are NaN where it has not been timed.
    """

    median: float
    p99: float


@dataclass(frozen=True, slots=True)
class Status:
    """How well the work keeps up with the camera.

    Attributes
    ----------
    frames : int
        That were taken from the source: ``used`` and ``skipped``.
    used : int
        That were pushed into the estimator.
    skipped : int
        That were too old when they were taken, or more than the estimator asks for.
    dropped : int
        That the camera or its ring lost before they could be taken.
    updates : int
    seconds : float
        Since the first frame was taken.
    rate : float
        Frames a second that were taken lately.
    latency : mapping of str to Latency
        By stage; see `STAGES`.
    """

    frames: int = 0
    used: int = 0
    skipped: int = 0
    dropped: int = 0
    updates: int = 0
    seconds: float = 0.0
    rate: float = 0.0
    latency: Mapping[str, Latency] = field(default_factory=dict)
