"""From a source to a result: the method that fits the motion, and what a calibration adds."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from numpy.typing import ArrayLike

from mirrorskin import io

if TYPE_CHECKING:
    from mirrorskin.engine.method import Method
    from mirrorskin.engine.streaming import Progress
    from mirrorskin.io import Calibration, Motion, Result, Source

_METHODS: Mapping[str, str] = {
    "vertical": "press.press.Press",
    "axial": "rotation.rotation.Rotation",
    "horizontal": "slip.slip.Sliding",
    "twist": "slip.slip.Sliding",
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
        axial motion, and of `mirrorskin.engine.Sliding` for a slide or a twist; see ``help(engine.Press)``.

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

    >>> from mirrorskin import engine, hw
    >>> from mirrorskin.hw.twin import Vertical
    >>> press = hw.Twin(object="sphere", shape=(40, 40), pixel_size=0.26, movement=Vertical([0.1, 0.2, 0.3]))
    >>> engine.reconstruct(press).height.shape
    (40, 40)
    """
    given = {"travel": travel, "phase": phase, "displacement": displacement, "twist": twist}
    opened = calibrated(_as_source(source, given, pixel_size), calibration)
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
    from mirrorskin.engine.integration.validation import check_pixel_size
    from mirrorskin.io.arguments import as_array
    from mirrorskin.io.arrays import ArrayRecording

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
