"""Running an operation over a recording, an array, or an iterable of frames."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.inputs import as_result
from mirrorskin.engine.method import Method, check_motion
from mirrorskin.engine.operation import Operation, apply, warn_of_degrees
from mirrorskin.engine.provenance import attach_provenance, describe, naming, signature
from mirrorskin.engine.reconstruction import calibrated
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.io import InputError, Result
from mirrorskin.io.arguments import as_array, is_array
from mirrorskin.io.findings import in_process, warn
from mirrorskin.io.interpreter_end import computes
from mirrorskin.io.layout import as_series
from mirrorskin.io.own_class import load_class
from mirrorskin.io.types import exclusive_use

if TYPE_CHECKING:
    from mirrorskin.io import Source


@computes
def run(
    source: Source | Iterable[ArrayLike],
    operation: Operation | type[Operation],
    *,
    pixel_size: ArrayLike | None = None,
    progress: Progress | None = None,
    **positions: ArrayLike,
) -> Result:
    """Push all frames into an operation, and return its maps.

    Parameters
    ----------
    source : Source, array_like or device array (T, H, W), or iterable of array_like (H, W)
        An open recording or another source of frames, which is rewound first if possible; or frames: an array
        or a list is pushed as a whole, frames of an iterator one by one.
    operation : Operation, or a class of operations
        It forgets all earlier frames. Missing options are taken from the source, if available.
    pixel_size : float or (float, float), optional
        Millimetres along x and y, for an array or an iterable; a recording has its own.
    progress : callable, optional
        Called with the number of frames so far.
    **positions : array_like, (T, ...)
        For an array or an iterable: the positions that the operation needs, such as ``travel=``, mm.

    Returns
    -------
    Result
        ``process`` contains the operation's name, options and numbers.

    Raises
    ------
    mirrorskin.io.InputError
        The operation does not apply to the motion, needs missing information, or returns maps that contradict
        its declarations.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> class Brightest(engine.Operation):
    ...     def start(self, shape, dtype):
    ...         self.most = np.zeros(shape, dtype)
    ...     def push(self, frames):
    ...         np.maximum(self.most, frames.max(axis=0), out=self.most)
    ...     def result(self):
    ...         return {"brightest": self.most}
    >>> run(np.arange(12).reshape(3, 2, 2), Brightest).brightest.tolist()
    [[8, 9], [10, 11]]
    """
    if isinstance(operation, type) and issubclass(operation, Operation):
        operation = operation()
    if not isinstance(operation, Operation):
        raise _no_operation(operation)
    if wrong := [one for one in positions if one in operation.options]:
        kind = type(operation).__name__
        raise InputError(f"{wrong[0]} is an option: give it to the class, {kind}({wrong[0]}=...)")
    if hasattr(source, "read") and hasattr(source, "header"):
        if pixel_size is not None:
            raise InputError(
                f"{cast('Source', source).name} is a recording: give pixel_size to io.open_recording"
            )
        return _run_source(cast("Source", source), operation, positions, progress)
    if isinstance(source, str | os.PathLike) or not (is_array(source) or isinstance(source, Iterable)):
        remedy = "open a path with io.open_recording, or give an array"
        raise InputError(f"frames are a {type(source).__name__}: {remedy}")
    positions = {name: as_series(name, values) for name, values in positions.items() if values is not None}
    warn_of_degrees(type(operation).__name__, positions.get("phase"))
    if operation.passes == 2 and not is_array(source):
        source = list(source)
    compute = apply if is_array(source) else _run_each
    with exclusive_use(operation):
        result = compute(operation, source, progress, **positions)
    result = as_result(result, pixel_size=pixel_size)
    return result.assign(process={**signature(), **describe(operation), **result.process})


def load_operation(name: str) -> type[Operation | Method]:
    """Return the class of operations or methods that is named MODULE:CLASS or FILE.py:CLASS.

    Raises
    ------
    mirrorskin.io.InputError
        There is no such class, or it is not derived from `mirrorskin.engine.Operation`.

    Examples
    --------
    >>> load_operation("mirrorskin.engine:Onset").__name__
    'Onset'
    """
    kind = load_class(name)
    if not isinstance(kind, type) or not issubclass(kind, Operation | Method):
        raise _no_operation(kind)
    return kind


def run_class(
    kind: type[Operation | Method], source: Source, progress: Progress | None = None, /, **options: Any
) -> Result:
    """Run an operation or a method with these options over a source; see `run`."""
    if options.get("device") is None:
        options.pop("device", None)  # the class may have a default
    configured = kind(**options)
    if isinstance(configured, Method):
        return configured.run(calibrated(source), progress)
    return run(source, configured, progress=progress)


def _no_operation(kind: object) -> InputError:
    name = getattr(kind, "__name__", type(kind).__name__)
    return InputError(f"{name} is not an operation: derive the class from mirrorskin.engine.Operation")


def _run_source(
    source: Source, operation: Operation, positions: dict[str, ArrayLike], progress: Progress | None
) -> Result:
    if positions:
        raise InputError(f"{source.name} has the positions of its frames. Remove {', '.join(positions)}")
    check_motion(source, operation)
    with exclusive_use(source), exclusive_use(operation):
        with naming(source):
            configured = operation.configured_for(source)
            found = feed(source, configured, progress=progress)
            result = configured.finish()
        process = {**describe(configured, source), **result.process, **in_process(found, result.process)}
        result = attach_provenance(result, source, configured.opened_devices, process)
    warn(source.name, result.process)
    return result


def _run_each(
    operation: Operation, frames: Iterable[ArrayLike], progress: Progress | None, **positions: Any
) -> Result:
    """Push frames, (H, W), one by one."""
    count = 0
    for frame in frames:
        array = as_array("frames", frame)[np.newaxis]
        if array.ndim != 3:
            shape = array.shape[1:]
            raise InputError(f"frames are {array.dtype} {shape}: numbers (H, W) of one size are needed")
        array = array if count else operation._begin_with(array)
        for name, values in positions.items():
            if values.ndim == 0 or len(values) <= count:
                text = f"{name} has shape {values.shape} for {count + 1} frames or more"
                raise InputError(f"{text}: give one of each frame")
        operation.push(array, **{name: values[count : count + 1] for name, values in positions.items()})
        count += 1
        if progress:
            progress(count)
    if not count:
        raise InputError("there are no frames: give at least one")
    for name, values in positions.items():
        if len(values) > count:
            raise InputError(f"{name} has shape {values.shape} for {count} frames: give one of each frame")
    return operation.finish()
