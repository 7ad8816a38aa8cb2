"""The twin's movements, out of the command line's words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from mirrorskin.cli.options import MotionName

if TYPE_CHECKING:
    from mirrorskin.hw.twin import Movement

# The options that each motion has, and what they are if they are not given.
DEFAULTS: dict[MotionName, dict[str, str]] = {
    MotionName.vertical: {"travel-step": "0.1mm", "travel-start": "0.1mm", "compliance": "0mm/N"},
    MotionName.axial: {"press": "1mm", "tilt": "2.5deg", "phase-step": "45deg", "pivot": "0mm,0mm,0mm"},
    MotionName.horizontal: {"press": "1mm", "displacement-step": "0.01mm,0mm"},
    MotionName.twist: {"press": "1mm", "twist-step": "0.2deg"},
}
_FRAMES = 30


def make_movement(
    motion: MotionName, frames: int | None, release: bool, given: Mapping[str, str | None]
) -> Movement:
    """Turn options into a movement of the twin.

    Parameters
    ----------
    motion : MotionName
    frames : int or None
        None is 30, or of a rotation one turn.
    release : bool
        Whether the body is lifted again.
    given : mapping
        Options by name, None where not given; defaults are in ``DEFAULTS``.

    Raises
    ------
    InputError
        An option belongs to another motion, or cannot be read.
    """
    import numpy as np

    from mirrorskin import io
    from mirrorskin.cli.quantity import angle, compliance, length, vector
    from mirrorskin.hw import twin

    own = DEFAULTS[motion]
    foreign = [f"--{name}" for name, value in given.items() if value is not None and name not in own]
    if release and motion != MotionName.vertical:
        foreign.append("--release")
    if foreign:
        raise io.InputError(
            f"{foreign[0]} says nothing of a motion that is {motion.value}: leave it out, or choose another"
        )
    words = own | {name: value for name, value in given.items() if value is not None}

    def steps(count: int, step: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return step * np.arange(count, dtype=np.float64)

    if motion == MotionName.vertical:
        step = length(words["travel-step"], "--travel-step")
        down = length(words["travel-start"], "--travel-start") + steps(frames or _FRAMES, step)
        travel = np.concatenate([down, down[-2::-1]]) if release else down
        return twin.Vertical(travel, compliance=compliance(words["compliance"], "--compliance"))
    press = length(words["press"], "--press")
    if motion == MotionName.axial:
        step = angle(words["phase-step"], "--phase-step")
        turn = max(1, round(math.tau / abs(step))) if step else _FRAMES
        x, y, z = vector(words["pivot"], 3, "--pivot")
        tilt = angle(words["tilt"], "--tilt")
        return twin.Axial(steps(frames or turn, step), tilt, press, (x, y, z))
    if motion == MotionName.horizontal:
        along = vector(words["displacement-step"], 2, "--displacement-step")
        return twin.Horizontal(steps(frames or _FRAMES, 1.0)[:, np.newaxis] * np.array(along), press)
    return twin.Twist(steps(frames or _FRAMES, angle(words["twist-step"], "--twist-step")), press)
