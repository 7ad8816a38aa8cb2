"""Steps change or add maps after an operation: their base class, and what they receive."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, stored_map
from mirrorskin.engine.base.frames import take_neighbours
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import Configured
from mirrorskin.io import Calibrated
from mirrorskin.io.watch.traces import FrameSamples

if TYPE_CHECKING:
    import numpy as np

    from mirrorskin.io import Result, Source


@dataclass(frozen=True)
class Context:
    """Information for steps in addition to maps.

    Attributes
    ----------
    source : Source
        Where the frames come from: its header and calibration.
    operation : Operation
        What the maps were computed by: its options, device, and the positions of the frames.
    stream : Source
        Where the frames were read: the source, or one that changes its frames, such as
        `mirrorskin.engine.diagnosis.registration.Registered`.
    first_frame : int
        Number in the source of the first frame that was used.
    samples : FrameSamples, optional
        Samples of all frames on a grid of pixels; None if a plan is not checked.
    time : ndarray, (T,), float64, or None
        Times of the frames that were used, s, if they are known.
    computed : Result
        The maps of the operation, before all steps.
    earlier : dict of Result
        The maps before each step so far, by its class; see `before`.
    sampled : dict
        Heights on the grid, by the map that they are of; see `neighbours`.
    """

    source: Source
    operation: Operation
    stream: Source
    first_frame: int
    samples: FrameSamples | None
    time: NDArray[np.float64] | None
    computed: Result
    earlier: dict[type[Step], Result] = field(default_factory=dict)
    sampled: dict[int, tuple[AnyArray, list[NDArray[Any]]]] = field(default_factory=dict)

    def before(self, step: type[Step], result: Result) -> Result:
        """Return the maps before a step was applied; the given ones if it was not."""
        return self.earlier.get(step, result)

    def neighbours(self, result: Result) -> list[NDArray[Any]]:
        """Return the heights at the grid of samples, and to the left, right, above and below its pixels."""
        assert self.samples is not None
        height = stored_map(result, "height")
        if id(height) not in self.sampled:
            self.sampled[id(height)] = height, take_neighbours(height, self.samples)  # which keeps the id
        return self.sampled[id(height)][1]

    def positions(self, name: str) -> NDArray[np.float64]:
        """Return the positions of the frames, such as their ``travel``."""
        return self.operation.positions_so_far(name)


class Step(Configured):
    """Base of steps, which change or add maps after an operation.

    Options are declared as class attributes. An operation that lists a step in its ``checks`` has it applied
    by every run, with the operation's values of the options that both have.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    """Quantities of maps without which the step is left out."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with the maps of this step, and with its description in ``process``."""
        raise NotImplementedError


class Undistortion(Step):
    """Resample the maps to equal pixels on the sheet, if the source's calibration has a lens."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result, undistorted if there is a lens."""
        return undistorted(result, context.source)


def undistorted(result: Result, source: Source) -> Result:
    """Return a result, undistorted if the source's calibration has a lens."""
    if not isinstance(source, Calibrated) or source.whole.lens is None:
        return result
    from mirrorskin.engine.base.undistort import undistort

    return undistort(result, source.whole.lens, source.region.origin)
