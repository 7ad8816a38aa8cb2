"""Calibrations of a lit wall from touches by a sensor with a fault.

The light is that of the twin, which traces rays: nothing else here renders a wall.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from mirrorskin import io
from mirrorskin.engine.calibration.touches import TouchFit, from_touches
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.calibration import scorer
from mirrorskin.evaluation.calibration.scenes import in_other_light, press_for
from mirrorskin.evaluation.calibration.touches import LAB, REACH, references_of, touch
from mirrorskin.evaluation.faults.calibrations import answer_of_fits
from mirrorskin.evaluation.faults.camera import Floats
from mirrorskin.evaluation.faults.judge import Answer

_FITS = 2  # of a cell, each with two touches
_BODY = LAB.body.radius, LAB.body.height
_TRUE = {
    "radius": _BODY[0],
    "rim": _BODY[1],
    "axis_x": 0.0,
    "axis_y": 0.0,
    "tilt": LAB.tilt,
    "phase_offset": 0.0,
    "pivot_z": LAB.pivot[2],
}
_NEEDED = {
    "radius": 0.05 * _BODY[0],
    "rim": 0.1 * _BODY[1],
    "axis_x": 0.1,
    "axis_y": 0.1,
    "tilt": 0.01 * LAB.tilt,
    "phase_offset": math.radians(0.3),
    "pivot_z": 0.1,
}
"""Errors of parameters that hardly matter, mm and radians: the unit of errors."""


@dataclass(frozen=True)
class WallFault:
    """What goes wrong in the touches of a calibration of a wall.

    Attributes
    ----------
    name : str
    lamp : float
        Light of the second turn, as a share of that of the first.
    radius : float
        Nominal radius of the body over the true one.
    dropped : bool
        Whether the frame in the middle of the second turn is missing; nobody noticed.
    stated : float, optional
        The half-angle that is stated with a standard deviation of 2 %, over the true one.
    """

    name: str
    lamp: float = 1.0
    radius: float = 1.0
    dropped: bool = False
    stated: float | None = None


WALL_FAULTS = (
    WallFault("none"),
    WallFault("lamp 5 % dimmer in the second turn", lamp=0.95),
    WallFault("radius of the body 20 % too large", radius=1.2),
    WallFault("dropped frame", dropped=True),
    WallFault("half-angle stated 20 % too small", stated=0.8),
)


@functools.cache
def _references() -> io.References:
    return references_of(LAB)


@functools.cache
def _touch(seed: int) -> tuple[Frames, Frames]:
    """Return a press of waves, and a turn there."""
    generator = np.random.default_rng([seed, 9])
    depth, pitch, turned = generator.uniform((0.16, 2.2, 0.0), (0.24, 3.2, 1.5)).tolist()
    waves = scorer.waves(depth, pitch, turned, REACH)
    return touch(LAB, waves, press_for(waves), 40 + seed, _references())


def _faulty(turn: Frames, fault: WallFault, seed: int) -> Frames:
    """Return the second turn."""
    if fault.dropped:
        frames, middle = turn.frames, len(turn.frames) // 2
        frames = np.concatenate([frames[:middle], frames[middle + 1 :], frames[:1]])
        turn = Frames(frames, turn.header, turn.name, **turn.series)
    return in_other_light(turn, fault.lamp, np.nan_to_num(_references().dark), LAB.noise, seed)


def of_wall(fault: WallFault, seed: int) -> Answer:
    """Return the errors of the parameters of a few calibrations, in what hardly matters."""
    stated = {} if fault.stated is None else {"tilt": (fault.stated * LAB.tilt, 0.02 * LAB.tilt)}

    def fit(number: int) -> TouchFit:
        first, (press, turn) = (_touch(10 * seed + 2 * number + k) for k in range(2))
        touches = [first, (press, _faulty(turn, fault, seed))]
        for source in (source for pair in touches for source in pair):
            source.rewind()
        return from_touches(touches, body=(fault.radius * _BODY[0], _BODY[1]), stated=stated)

    def compared(_: int, found: TouchFit) -> tuple[Floats, Floats]:
        named = {estimate.name: estimate for estimate in found.estimates}
        parts = [(named[name].value - true, named[name].sigma) for name, true in _TRUE.items()]
        error, sigma = np.array(parts).T / np.array([_NEEDED[name] for name in _TRUE])
        return error, sigma

    return answer_of_fits(_FITS, fit, compared)
