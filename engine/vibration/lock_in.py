"""Correlation of any recording with a phase: of a turn, of a frequency, or of a press that dithers."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.sources import EditedSource
from mirrorskin.engine.correlation.correlation import Correlate
from mirrorskin.engine.vibration.frequency import Frequency, frequency_of
from mirrorskin.engine.vibration.growth import Growth
from mirrorskin.io import Block, InputError
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.io import Source
    from mirrorskin.io.base.types import ProcessValue


class LockIn(Method):
    """Mean, cosine and sine of the phase in each pixel's brightness, over all frames of a recording."""

    frequency: float | Literal["estimate"] | None = option(
        default=None,
        unit="Hz",
        above=0,
        help="frequency, or estimate it: the phase is 2 pi times frequency times the time since the first"
        " frame. To estimate it, the source is read twice; see `engine.vibration.estimate_frequency`",
        shown_default="the phase of the source",
    )
    frame_rate: float | None = option(
        default=None,
        unit="frames/s",
        above=0,
        help="frames per second",
        shown_default="the times of the source",
    )
    dither: bool = option(
        default=False,
        help="the phase is that of the travel of a press that dithers, and the growth of the contact is"
        " added; see `mirrorskin.engine.vibration.Growth`",
    )
    harmonic: int = Correlate.harmonic
    window_frames: int | None = Correlate.window_frames

    def check_options(self) -> None:
        """Raise InputError if a dither is combined with another source of the phase."""
        if self.dither and (self.harmonic != 1 or self.frequency is not None):
            other = "harmonic" if self.harmonic != 1 else "frequency"
            raise InputError(f"dither takes the phase from the travel: leave {other} out")

    def plan(self, source: Source) -> Plan:
        """Return the correlation with the phase selected by the options."""
        process: dict[str, ProcessValue] = {
            "method": "correlation",
            "zenith": "none: the recording has no zenith gain",
        }
        if self.dither:
            return Plan(self.configure(Growth).configured_for(source), process=process)
        if self.harmonic != 1:
            process["harmonic"] = self.harmonic
        stream = None
        if self.frequency is not None:
            time = self._times(source)
            frequency = (
                frequency_of(source, time)
                if self.frequency == "estimate"
                else Frequency(self.frequency, math.nan)
            )
            process["frequency"] = frequency.hertz
            if self.frequency == "estimate":
                process["frequency_sigma"] = frequency.sigma
            phase = 2 * math.pi * frequency.hertz * (time - time[0])
            stream = EditedSource(source, partial(_with_phase, phase))
        return Plan(self.configure(Correlate), process=process, stream=stream)

    def _times(self, source: Source) -> Doubles:
        """Return the times of the frames, s, from the frame rate, otherwise from the source."""
        if self.frame_rate is not None:
            return np.arange(source.shape[0]) / self.frame_rate
        time: Doubles | None = getattr(source, "time", None)
        if time is None or not np.isfinite(time).all():
            raise InputError("the time of each frame is unknown: give the frame rate")
        return time


def _with_phase(phase: Doubles, block: Block) -> Block:
    return replace(block, phase=phase[block.index : block.index + len(block.frames)])
