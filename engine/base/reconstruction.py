"""From frames to a result: doors to a run, by an operation or by the method that fits the motion."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from numpy.typing import ArrayLike

from mirrorskin import io
from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.running import Progress, check_taken, run_over
from mirrorskin.engine.base.sources import ArraySource, IteratorSource
from mirrorskin.io import InputError
from mirrorskin.io.base.arguments import is_array
from mirrorskin.io.base.own_class import OPERATIONS, load_class
from mirrorskin.io.base.threads import computes

if TYPE_CHECKING:
    from mirrorskin.io import Calibration, Motion, Result, Source

_METHODS: Mapping[str, str] = {
    "vertical": "press.press.Press",
    "axial": "rotation.rotation.Rotation",
    "horizontal": "slip.slip.Slide",
    "twist": "slip.slip.Slide",
}


def method_for(motion: Motion) -> type[Method]:
    """Return the class of methods for a motion.

    Examples
    --------
    >>> method_for("vertical").__name__
    'Press'
    """
    module, _, name = _METHODS[motion].rpartition(".")
    return cast("type[Method]", getattr(import_module(f"mirrorskin.engine.{module}"), name))


@computes
def run(
    source: Source | Iterable[ArrayLike],
    operation: Operation | type[Operation],
    *,
    pixel_size: ArrayLike | None = None,
    progress: Progress | None = None,
    **positions: ArrayLike,
) -> Result:
    """Return the maps of an operation over all frames.

    Parameters
    ----------
    source : Source, array_like or device array (T, H, W), or iterable of array_like (H, W)
        An open recording or another source of frames, which is rewound first if possible, with the
        calibration that it carries; or frames: an array or a list is pushed as a whole, frames of an iterator
        one by one.
    operation : Operation, or a class of operations
        It is not changed. Missing options are taken from the source, if available.
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
    >>> import numpy as np
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
    if wrong := [name for name in positions if name in operation.options]:
        kind = type(operation).__name__
        raise InputError(f"{wrong[0]} is an option: give it to the class, {kind}({wrong[0]}=...)")
    return run_over(_frames_of(source, operation, positions, pixel_size), operation, progress)


def _frames_of(source: Any, operation: Operation, positions: Mapping[str, Any], pixel_size: Any) -> Source:
    """Return what frames are taken from as a source."""
    if hasattr(source, "read") and hasattr(source, "header"):
        opened = cast("Source", source)
        if pixel_size is not None:
            raise InputError(f"{opened.name} is a recording: give pixel_size to io.open_recording")
        if positions:
            raise InputError(f"{opened.name} has the positions of its frames. Remove {', '.join(positions)}")
        return calibrated(opened)
    if isinstance(source, str | os.PathLike) or not (is_array(source) or isinstance(source, Iterable)):
        remedy = "open a path with io.open_recording, or give an array"
        raise InputError(f"frames are a {type(source).__name__}: {remedy}")
    check_taken(operation, positions)
    if is_array(source) or operation.passes == 2:
        frames = source if is_array(source) else [*source]
        return ArraySource(frames, operation, positions, pixel_size=pixel_size)
    return IteratorSource(source, operation, positions, pixel_size)


def load_operation(name: str | type) -> type[Operation | Method]:
    """Return a class of operations or methods, which may be named.

    The name is MODULE:CLASS, FILE.py:CLASS, or that of an entry point in the group ``mirrorskin.operations``.

    Raises
    ------
    mirrorskin.io.InputError
        There is no such class, or it is not derived from `mirrorskin.engine.Operation`.

    Examples
    --------
    >>> load_operation("mirrorskin.engine:Onset").__name__
    'Onset'
    """
    kind = load_class(name, OPERATIONS)
    if not isinstance(kind, type) or not issubclass(kind, Operation | Method):
        raise _no_operation(kind)
    return kind


def run_class(
    kind: type[Operation | Method],
    source: Source,
    progress: Progress | None = None,
    calibration: Calibration | str | Path | None = None,
    /,
    **options: Any,
) -> Result:
    """Run an operation or a method with these options over a source; see `run` and `calibrated`."""
    if options.get("device") is None:
        options.pop("device", None)  # the class may have a default
    configured, source = kind(**options), calibrated(source, calibration)
    if isinstance(configured, Method):
        return configured.run(source, progress)
    return run(source, configured, progress=progress)


def _no_operation(kind: object) -> InputError:
    name = getattr(kind, "__name__", type(kind).__name__)
    return InputError(f"{name} is not an operation: derive the class from mirrorskin.engine.Operation")


def reconstruct(
    source: Source | ArrayLike,
    calibration: Calibration | str | Path | None = None,
    *,
    travel: ArrayLike | None = None,
    phase: ArrayLike | None = None,
    displacement: ArrayLike | None = None,
    twist: ArrayLike | None = None,
    pixel_size: float | tuple[float, float] | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Result:
    """Reconstruct the touched object, by the method for the motion of the source.

    Parameters
    ----------
    source : Source or array_like, (T, H, W), uint8, uint16 or float32
        An open recording or another source of frames, which is rewound first if possible; or an array of
        frames.
    calibration : Calibration or path, optional
        Calibration of the sensor, or its file; by default the calibration in the recording, if any.
    travel, phase, twist : array_like, (T,), optional
        For an array: the position in each frame, which also determines the motion. Travel of a press, mm;
        phase of a rotation, or angle of a twist, radians.
    displacement : array_like, (T, 2), optional
        For an array: displacement of a slide along x and y, mm.
    pixel_size : float or (float, float), optional
        For an array: size of a pixel along x and y at the sheet, mm.
    progress : callable, optional
        Called with the number of frames so far.
    **options
        Options of `mirrorskin.engine.Press` for a vertical motion, of `mirrorskin.engine.Rotation` for an
        axial motion, and of `mirrorskin.engine.Slide` for a slide or a twist; see ``help(engine.Press)``.

    Returns
    -------
    Result
        The maps of the method, by name; the help of its class lists them.

    Raises
    ------
    mirrorskin.io.InputError
        The calibration belongs to another camera, or the input cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.zeros((5, 3, 4), np.uint8)
    >>> frames[3:] = 255
    >>> reconstruct(frames, travel=[0.0, 0.1, 0.2, 0.3, 0.4], pixel_size=0.03).height[0].tolist()
    [-0.25, -0.25, -0.25, -0.25]

    >>> from mirrorskin import engine
    >>> from mirrorskin.twin import Twin, Vertical
    >>> press = Twin(object="sphere", shape=(40, 40), pixel_size=0.26, movement=Vertical([0.1, 0.2, 0.3]))
    >>> engine.reconstruct(press).height.shape
    (40, 40)
    """
    positions = {"travel": travel, "phase": phase, "displacement": displacement, "twist": twist}
    opened = calibrated(_as_source(source, positions, pixel_size), calibration)
    return method_for(opened.motion)(**options).run(opened, progress)


def _as_source(
    source: Source | ArrayLike,
    positions: Mapping[str, ArrayLike | None],
    pixel_size: float | tuple[float, float] | None,
) -> Source:
    """Return frames in an array as a source."""
    if hasattr(source, "read") and hasattr(source, "header"):
        opened = cast("Source", source)
        if pixel_size is not None or any(values is not None for values in positions.values()):
            raise io.InputError(
                f"{opened.name} has positions and pixel size of its own: give them with frames in an array"
            )
        return opened
    if isinstance(source, str | Path):
        raise io.InputError(f"{source} is a path: open it with io.open_recording")
    from mirrorskin.io.base.arguments import as_array, check_pixel_size
    from mirrorskin.io.files.arrays import ArrayRecording

    size = None if pixel_size is None else check_pixel_size(pixel_size)
    return ArrayRecording(as_array("frames", source), positions, {"pixel_size": size})


def calibrated(source: Source, calibration: Calibration | str | Path | None = None) -> Source:
    """Return a source with a calibration applied.

    Parameters
    ----------
    source : Source
        A source that is already calibrated is returned unchanged.
    calibration : Calibration or path, optional
        By default the calibration in the recording; without one, the source is returned unchanged.

    Raises
    ------
    mirrorskin.io.InputError
        The calibration belongs to another camera, or the file is not a calibration.
    """
    if isinstance(source, io.Calibrated):
        return source
    if calibration is None:
        calibration = source.carried if isinstance(source, io.Recording) else None
    elif not isinstance(calibration, io.Calibration):
        calibration = io.open_calibration(calibration)
    return source if calibration is None else io.Calibrated(source, calibration)
