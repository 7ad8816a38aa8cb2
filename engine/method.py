"""Methods: an operation and the steps that follow it, for recordings of one motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.operation import OnDevice, Operation, mro_index
from mirrorskin.engine.options import Configured
from mirrorskin.engine.provenance import attach_provenance, naming
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.io import Calibrated, InputError, Result
from mirrorskin.io.findings import merged, warn, with_findings
from mirrorskin.io.interpreter_end import computes
from mirrorskin.io.types import exclusive_use

if TYPE_CHECKING:
    from mirrorskin.io import Source
    from mirrorskin.io.types import ProcessValue


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
        `mirrorskin.engine.rotation.registration.Registered`.
    """

    source: Source
    operation: Operation
    stream: Source

    def pushed(self, name: str) -> NDArray[np.float64]:
        """Return the positions of the frames, such as their ``travel``."""
        return self.operation.pushed(name)


class Step(Configured):
    """Base of steps, which change or add maps after an operation.

    Options are declared as class attributes.
    """

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with the maps of this step, and with its description in ``process``."""
        raise NotImplementedError


@dataclass(frozen=True)
class Plan:
    """Processing of one source by a method.

    Attributes
    ----------
    operation : Operation
    steps : sequence of Step
        Applied to the operation's maps, one after the other.
    process : mapping
        The options, and where their values come from.
    frames : range, optional
        Frames that are used, by default all.
    omit : sequence of str
        Maps of the operation that the result leaves out.
    stream : Source, optional
        Where the frames are read, if not from the source itself.
    """

    operation: Operation
    steps: Sequence[Step] = ()
    process: Mapping[str, ProcessValue] = field(default_factory=dict)
    frames: range | None = None
    omit: Sequence[str] = ()
    stream: Source | None = None

    def finish(
        self, result: Result, source: Source, more: Mapping[str, ProcessValue] | None = None
    ) -> Result:
        """Return the operation's maps after all steps, with provenance, in the camera's pixels."""
        context = Context(source, self.operation, self.stream or source)
        result = result.assign(dict.fromkeys(self.omit))
        process = merged({"frames": self.operation.count}, self.process, result.process, more or {})
        result = result.assign(process=process)
        for step in self.steps:
            result = step.apply(result, context)
        devices = self.operation.opened_devices
        return attach_provenance(result, source, devices, dict(result.process))


class Method(OnDevice):
    """Base of methods, which have the options of their operations and steps, listed by name.

    ``threshold: float = Onset.threshold`` gives a method the option of an operation.
    """

    memory_limit: int = Operation.memory_limit

    motions: ClassVar[tuple[str, ...]] = ()
    """Motions of recordings that the method applies to; none for all."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if mro_index(cls, "plan") < mro_index(cls, "live_plan"):  # live, too, the plan of a subclass is used
            cls.live_plan = Method.live_plan  # type: ignore[method-assign]

    def plan(self, source: Source) -> Plan:
        """Return the plan for a source: its operation, steps and frames."""
        raise NotImplementedError

    def live_plan(self, source: Source) -> Plan:
        """Return the plan for a source whose frames arrive while the body moves."""
        return self.plan(source)

    @computes
    def run(self, source: Source, progress: Progress | None = None, *, undistort: bool = True) -> Result:
        """Reconstruct a source.

        Parameters
        ----------
        source : Source
            It is rewound first, if it can be.
        progress : callable, optional
            Called with the number of frames so far.
        undistort : bool
            Whether maps are undistorted, if the source's calibration has a lens.

        Returns
        -------
        Result
            The maps by name. ``process`` contains the options and the origin of their values.

        Raises
        ------
        mirrorskin.io.InputError
            The source has another motion, or it and the options cannot be used.
        """
        check_motion(source, self)
        with exclusive_use(source), naming(source):
            plan = self.plan(source)
            with exclusive_use(plan.operation):
                found = feed(plan.stream or source, plan.operation, plan.frames, progress)
                result = plan.finish(plan.operation.finish(), source)
        result = with_findings(result, *found)
        warn(source.name, result.process)
        return undistorted(result, source) if undistort else result

    def with_options(self, **options: Any) -> Self:
        """Return a method of the same class in which some options differ."""
        return type(self)(**{**self.chosen(), **options})

    def make(self, kind: type[Configured], **changes: Any) -> Any:
        """Return an operation or step with this method's values of its options."""
        return kind(**{**self.part(kind), **changes})


def check_motion(source: Source, computed: Operation | Method) -> None:
    """Raise InputError if an operation or a method does not apply to a source's motion."""
    if computed.motions and source.motion not in computed.motions:
        motions = " or ".join(computed.motions)
        raise InputError(
            f"{source.name} has {source.motion} motion, but {type(computed).__name__} needs {motions} motion"
        )


def undistorted(result: Result, source: Source) -> Result:
    """Undistort a result's maps if its source's calibration has a lens: the last step of every method."""
    if not isinstance(source, Calibrated) or source.whole.lens is None:
        return result
    from mirrorskin.engine.undistort import undistort

    return undistort(result, source.whole.lens, source.region.origin)
