"""Functions on arrays, made from classes of operations: ``find_onset`` from ``Onset``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, Protocol, cast

from numpy.typing import ArrayLike

from mirrorskin.engine.base.operation import COMPONENTS, Operation
from mirrorskin.engine.base.options import documented, signature_of
from mirrorskin.engine.base.running import check_taken, run_over
from mirrorskin.engine.base.sources import ArraySource
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.arguments import unknown_argument
from mirrorskin.io.base.threads import computes

P = ParamSpec("P")

ABOUT_WEIGHTS = "Weight of each frame, such as its inverse variance; 0 for a missing frame. By default 1."
"""Description of ``frame_weights`` of array functions."""
_POSITIONS = {
    "time": "Seconds.",
    "travel": "Millimetres that the body has been lowered.",
    "phase": "Radians.",
    "twist": "Radians that the body has turned about its axis.",
    "tilt": "Radians that the body leans.",
    "displacement": "Millimetres that the body has moved along x and y.",
    "pose": "Orientation of the body, as in ``Block.pose``.",
}

Choose = Callable[[dict[str, Any], dict[str, Any]], tuple[Operation, dict[str, Any]]]
"""Function of positions and options by name that returns an operation and its positions."""


def function_of(
    operation: type[Operation],
    *,
    name: str = "",
    text: str = "",
    positions: Mapping[str, str] | None = None,
    optional: Mapping[str, str] | None = None,
    choose: Choose | None = None,
) -> Callable[..., Result]:
    """Return the function on arrays of an operation: of frames, (T, H, W), positions and options.

    Parameters
    ----------
    operation : type
        Class of operations; its options are those of the function.
    name : str, optional
        By default that of the class in lower case, with underscores.
    text : str, optional
        Docstring without the section "Parameters"; by default that of the class.
    positions : mapping of str, optional
        Descriptions of what ``push`` of the class takes for each frame; common ones have a description.
    optional : mapping of str, optional
        Descriptions of what may be given for each frame, in addition or although ``push`` needs it.
    choose : callable, optional
        Receives positions and options, and returns the operation and its positions; by default, it is the
        class with these options.

    Raises
    ------
    mirrorskin.io.InputError
        It is not a class of operations.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> class Sum(engine.Operation):
    ...     def start(self, shape, dtype):
    ...         self.sum = np.zeros(shape)
    ...     def push(self, frames):
    ...         self.sum += frames.sum(axis=0)
    ...     def result(self):
    ...         return {"total": self.sum}
    >>> total = engine.function_of(Sum)
    >>> total(np.ones((8, 1, 2))).total.tolist()
    [[8.0, 8.0]]
    """
    if not (isinstance(operation, type) and issubclass(operation, Operation)):
        kind = getattr(operation, "__name__", type(operation).__name__)
        raise InputError(f"{kind} is not a class of operations: derive it from mirrorskin.engine.Operation")
    name = name or re.sub(r"(?<!^)(?=[A-Z])", "_", operation.__name__).lower()
    texts, optional = {**_POSITIONS, **(positions or {})}, dict(optional or {})
    needed = {position: texts[position] for position, is_needed in operation.positions.items() if is_needed}
    optional = {
        position: texts[position] for position in operation.positions if position not in needed
    } | optional
    needed = {position: about for position, about in needed.items() if position not in optional}
    options = {key: declared for key, declared in operation.options.items() if key != "memory_limit"}
    signature = signature_of(options, ("frames", *needed), tuple(optional))

    @computes
    def function(*args: Any, **kwargs: Any) -> Result:
        if unknown := next((key for key in kwargs if key not in signature.parameters), ""):
            raise TypeError(unknown_argument(f"{name}()", unknown, [*signature.parameters]))
        arguments = signature.bind(*args, **kwargs).arguments
        frames = arguments.pop("frames")
        where = {key: arguments.pop(key, None) for key in (*needed, *optional)}
        if choose is not None:  # it may return positions from which a block computes what the operation takes
            chosen, where = choose(where, arguments)
        else:
            chosen = operation(**arguments)
            check_taken(chosen, {key: values for key, values in where.items() if values is not None})
        return run_over(ArraySource(frames, chosen, where, name=name), chosen)

    before = "frames : array_like or device array, (T, H, W)\n    Raw counts.\n"
    for names, end in ((needed, ""), (optional, ", optional")):
        for position, about in names.items():
            shape = ", ".join(("T", *map(str, COMPONENTS.get(position, ("",))))).rstrip(" ")
            before += f"{position} : array_like, ({shape}){end}\n    {about}\n"
    function.__name__ = function.__qualname__ = name
    function.__module__ = operation.__module__
    function.__doc__ = documented(text or operation._text or f"{operation.__name__}.", options, before)
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function


class TravelFunction(Protocol[P]):
    """A function of frames, (T, H, W), their travel, (T,) mm, perhaps their time, (T,) s, and options."""

    def __call__(
        self,
        frames: ArrayLike,
        travel: ArrayLike,
        time: ArrayLike | None = None,
        *args: P.args,
        **options: P.kwargs,
    ) -> Result:
        """Return the maps."""


class PhaseFunction(Protocol[P]):
    """A function of frames, (T, H, W), their phase, (T,) radians, their weights, (T,), and options."""

    def __call__(
        self,
        frames: ArrayLike,
        phase: ArrayLike,
        frame_weights: ArrayLike | None = None,
        *args: P.args,
        **options: P.kwargs,
    ) -> Result:
        """Return the maps."""


class OptionalPhaseFunction(Protocol[P]):
    """A function of frames, (T, H, W), their phase, (T,) radians, if it is needed, and options."""

    def __call__(
        self, frames: ArrayLike, phase: ArrayLike | None = None, *args: P.args, **options: P.kwargs
    ) -> Result:
        """Return the maps."""


def travel_function(
    operation: Callable[P, Operation], name: str, text: str, about_travel: str
) -> TravelFunction[P]:
    """Return the function on arrays of an operation whose ``push`` takes ``travel``; see `function_of`."""
    about = {"travel": about_travel}
    time = {"time": "Seconds, to correct a rolling shutter and to notice missing frames."}
    function = function_of(cast(Any, operation), name=name, text=text, positions=about, optional=time)
    return cast(TravelFunction[P], function)


def phase_function(
    operation: Callable[P, Operation], name: str, text: str, about_phase: str
) -> PhaseFunction[P]:
    """Return the function on arrays of an operation whose ``push`` takes ``phase`` and ``frame_weights``."""
    about, weights = {"phase": about_phase}, {"frame_weights": ABOUT_WEIGHTS}
    function = function_of(cast(Any, operation), name=name, text=text, positions=about, optional=weights)
    return cast(PhaseFunction[P], function)


def optional_phase_function(
    operation: Callable[P, Operation], name: str, text: str, about_phase: str
) -> OptionalPhaseFunction[P]:
    """Return the function on arrays of an operation whose ``push`` takes ``phase`` if options ask for it."""
    function = function_of(cast(Any, operation), name=name, text=text, positions={"phase": about_phase})
    return cast(OptionalPhaseFunction[P], function)
