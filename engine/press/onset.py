"""Height from a vertical press: the travel at which a pixel turns light, or dark again (paper, section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.device_arrays import AnyArray
from mirrorskin.engine.operation import apply, limit_of, travel_function
from mirrorskin.engine.options import option
from mirrorskin.engine.press.crossing import EVENT_MAPS, Crossing, CrossingOperation, Event, EventMaps
from mirrorskin.engine.press.estimated_levels import estimate_levels_of
from mirrorskin.engine.press.no_answer import with_reason
from mirrorskin.io import Result
from mirrorskin.io.findings import Finding, warn, with_findings
from mirrorskin.io.samples import convert_samples, frame_dtype


class ThresholdOperation(CrossingOperation):
    """Base of operations that search for one event at one or several thresholds."""

    takes_device_arrays = True

    event: Event = option(
        default="onset",
        choices=("onset", "release"),
        help="event to find: dark to light while travel increases, or light to dark while it decreases",
    )

    def shares(self) -> Sequence[float]:
        """Return the thresholds to search for, as shares of the range from dark to bright."""
        raise NotImplementedError

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare a search for each threshold."""
        self._searches = [
            Crossing(self, shape, dtype, threshold=share, event=self.event) for share in self.shares()
        ]

    @property
    def used_noise(self) -> float:
        """Standard deviation of a sample, counts."""
        return self._searches[0].noise

    def use_noise(self, noise: float) -> None:
        """Replace the estimated noise before the first frame."""
        for search in self._searches:
            search.reset(noise)

    @property
    def room(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return self._searches[0].room

    def clear(self) -> None:
        """Forget the frames so far."""
        for search in self._searches:
            search.reset()

    def push(self, frames: NDArray[Any], *, travel: ArrayLike, lent: bool = False) -> None:
        """Process the next frames, (n, H, W), and the travel of each, (n,) mm."""
        for search in self._searches:
            search.push(frames, travel, lent)

    def as_result(self, event_maps: EventMaps, **others: NDArray[Any]) -> Result:
        """Return the maps of the event, and others, as a result."""
        maps: dict[str, NDArray[Any]] = dict(zip(EVENT_MAPS, event_maps, strict=True))
        process = {"noise": self._searches[0].noise}
        result = Result(maps | others, process=process, declarations=self.declarations)
        return self.with_travel_errors(result)


class Onset(ThresholdOperation):
    """Height from a press or a release, by the crossing of a threshold (paper, equations 3 and 4).

    A pixel has the height f = -s at the travel s at which it turns light, or dark again. If the levels of
    dark and light scatter from pixel to pixel by `dark_sigma` and `bright_sigma`, a second search at a
    threshold that is lower by one standard deviation of the level shows how much the heights depend on it.
    The difference is added to their standard deviation.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> operation = engine.Onset(threshold=0.4, noise=1.0)
    >>> for travel in (0.0, 0.1, 0.2, 0.3, 0.4):
    ...     operation.push(np.full((1, 1, 2), 255 * (travel > 0.25), np.uint8), travel=[travel])
    >>> operation.result().height.tolist()
    [[-0.25, -0.25]]
    """

    threshold: float = option(
        default=0.5,
        unit="share",
        within=(0, 1),
        help="share of the range from dark to bright at which a pixel counts as light",
    )
    dark_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own dark levels about `dark`",
        python_only=True,
    )
    bright_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own bright levels about `bright`",
        python_only=True,
    )

    def shares(self) -> Sequence[float]:
        """Return the threshold, and a lower one if the levels are uncertain."""
        if not (self.dark_sigma or self.bright_sigma):
            return [self.threshold]
        sigma = math.hypot((1 - self.threshold) * self.dark_sigma, self.threshold * self.bright_sigma)
        span = np.nanmedian(np.asarray(self.bright, np.float64) - np.asarray(self.dark, np.float64))
        return [self.threshold, max(0.0, self.threshold - sigma / float(span))]

    def result(self) -> Result:
        """Return height, status and frame of the frames so far."""
        return self._result(last=False)

    def finish(self) -> Result:
        """Return the maps of all frames, without copies of them."""
        return self._result(last=True)

    def _result(self, last: bool) -> Result:
        on_device = self._on_device and len(self._searches) == 1
        maps, *lower = [search.event_maps(last, on_device) for search in self._searches]
        if lower:
            # A pixel that is always light at the lower threshold turned light in the first frame or earlier.
            end = self._searches[0].travel[-1 if self.event == "release" else 0]
            height = np.where(np.isfinite(lower[0].height), lower[0].height, np.float32(-end))
            maps = maps._replace(sigma=np.hypot(maps.sigma, maps.height - height))
        return self.as_result(maps)


def _find_onset(frames: AnyArray, where: dict[str, Any], options: dict[str, Any]) -> Result:
    """Return the maps of a stack in memory, with estimated levels where none are given."""
    assumed = {}
    missing = [name for name in ("dark", "bright") if options.get(name) is None]
    if isinstance(frames, np.ndarray) and frames.ndim == 3:
        frames = convert_samples(frames, frame_dtype(frames.dtype, "frames"), "frames")
        fits = np.shape(where["travel"]) == (len(frames),)
    else:
        fits = False
    if missing and fits:
        levels = estimate_levels_of(frames, where["travel"], options.get("dark"), options.get("bright"))
        if levels is not None:
            assumed = {name: getattr(levels, name) for name in missing}
            options = {
                "dark_sigma": levels.dark_sigma,
                "bright_sigma": levels.bright_sigma,
                **options,
                **assumed,
            }
    operation = Onset(memory_limit=limit_of(frames), **options)
    result = apply(operation, frames, travel=where["travel"])
    if assumed:
        counts = " and ".join(f"{name} {value:.4g}" for name, value in assumed.items())
        text = f"{counts} counts are estimated from the frames; give {'= and '.join(assumed)}="
        result = with_findings(result, Finding("estimated levels", text))
    if isinstance(frames, np.ndarray):
        result = with_reason(result, operation, operation.threshold, frames[:: max(1, len(frames) - 1)])
    warn("find_onset", result.process)
    return result


find_onset = travel_function(
    Onset,
    "find_onset",
    """Find the onset of the light state, or its end, in a stack that fits in memory.

    The sheet at a pixel has the height f = -s at the travel s of the onset (paper, equations 3 and 4).

    Returns
    -------
    Result
        ``height``, ``height_sigma`` and ``frame`` are undefined where ``status`` is not 1; ``process``
        contains the ``noise``, counts, that was given or estimated.

    Warns
    -----
    mirrorskin.io.MirrorskinWarning
        ``dark`` or ``bright`` is not given, and is estimated from the first and the last frames;
        or there is no height at any pixel, with the reason.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, travel, references or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.zeros((5, 1, 2), np.uint8)
    >>> frames[3:, 0, 0] = 255
    >>> find_onset(frames, [0.0, 0.1, 0.2, 0.3, 0.4]).height
    array([[-0.25,   nan]], dtype=float32)
    """,
    "Millimetres that the body has been lowered: never decreasing in a press, never increasing in a release.",
    _find_onset,
)
