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
FRAMES_MAX = 10**7
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
        An option belongs to another motion, or cannot be read, or a turn has too many frames.
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
    count = frames or _FRAMES
    if motion == MotionName.vertical:
        step, start = (length(words[name], f"--{name}") for name in ("travel-step", "travel-start"))
        down = io.Steps(step, start).positions(count)
        travel = np.concatenate([down, down[-2::-1]]) if release else down
        return twin.Vertical(travel, compliance=compliance(words["compliance"], "--compliance"))
    press = length(words["press"], "--press")
    if motion == MotionName.axial:
        step = angle(words["phase-step"], "--phase-step")
        x, y, z = vector(words["pivot"], 3, "--pivot")
        tilt = angle(words["tilt"], "--tilt")
        return twin.Axial(io.Steps(step).positions(frames or _frames_of_a_turn(step)), tilt, press, (x, y, z))
    if motion == MotionName.horizontal:
        along = vector(words["displacement-step"], 2, "--displacement-step")
        return twin.Horizontal(np.stack([io.Steps(one).positions(count) for one in along], axis=1), press)
    step = angle(words["twist-step"], "--twist-step")
    return twin.Twist(io.Steps(step).positions(count), press)


def _frames_of_a_turn(step: float) -> int:
    from mirrorskin import io

    # Steps so small that the division overflows are too many as well.
    if 0 < abs(step) < math.tau / FRAMES_MAX:
        raise io.InputError(f"a turn by this --phase-step is more than {FRAMES_MAX} frames: give --frames")
    return max(1, round(math.tau / abs(step))) if step else _FRAMES
