"""Methods: an operation and the steps that follow it, for recordings of one motion."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from mirrorskin.engine.base.operation import OnDevice, Operation, Plan
from mirrorskin.engine.base.options import Configured
from mirrorskin.engine.base.running import Progress, run_over
from mirrorskin.engine.base.steps import Undistortion
from mirrorskin.io.base.threads import computes

if TYPE_CHECKING:
    from mirrorskin.io import Result, Source


class Method(OnDevice):
    """Base of methods, which have the options of their operations and steps, listed by name.

    ``threshold: float = Onset.threshold`` gives a method the option of an operation.
    """

    memory_limit: int = Operation.memory_limit

    motions: ClassVar[tuple[str, ...]] = ()
    """Motions of recordings that the method applies to; none for all."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "plan" in vars(cls) and "live_plan" not in vars(cls):  # live, too, the plan of a subclass is used
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
        return run_over(source, self, progress, [Undistortion()] if undistort else [])

    def configure(self, kind: type[Configured], **changes: Any) -> Any:
        """Return an operation or step with this method's values of its options."""
        return kind(**{**self.shared_options(kind), **changes})
