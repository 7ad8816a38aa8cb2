"""Height from a vertical press: the travel at which a pixel turns light, or dark again (paper, section 3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.operation import travel_function
from mirrorskin.engine.options import option
from mirrorskin.engine.press.crossing import Crossing, CrossingOperation, Event, Found
from mirrorskin.io import Map, Result
from mirrorskin.io.maps import TABLE, PressStatus, ReleaseStatus, status_of

STATUS: Mapping[str, Map] = {"onset": status_of(PressStatus), "release": status_of(ReleaseStatus)}
"""Declaration of the status of each event."""


class ThresholdOperation(CrossingOperation):
    """Base of operations that search for one event at one or several thresholds."""

    event: Event = option(
        default="onset",
        choices=("onset", "release"),
        help="event to find: dark to light while travel increases, or light to dark while it decreases",
    )

    height = TABLE["height"]
    status = TABLE["status"]
    frame = TABLE["frame"]

    @property
    def declarations(self) -> Mapping[str, Map]:
        """Declarations of the maps; the legend of the status depends on the event."""
        return {**self.maps, "status": STATUS[self.event]}

    def shares(self) -> Sequence[float]:
        """Return the thresholds to search for, as shares of the range from dark to bright."""
        raise NotImplementedError

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare a search for each threshold."""
        self._searches = [
            Crossing(self, shape, dtype, threshold=share, event=self.event) for share in self.shares()
        ]

    @property
    def room(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return self._searches[0].room

    def clear(self) -> None:
        """Forget the frames so far."""
        for search in self._searches:
            search.reset()

    def push(self, frames: NDArray[Any], *, travel: ArrayLike, lent: bool = False) -> None:
        """Take in the next frames, (n, H, W), and the travel of each, (n,) mm."""
        for search in self._searches:
            search.push(frames, travel, lent)

    def as_result(self, found: Found, **others: NDArray[Any]) -> Result:
        """Return what was found, and other maps, as a result."""
        names = ("height", "height_sigma", "status", "frame")
        maps: dict[str, NDArray[Any]] = dict(zip(names, found, strict=True))
        process = {"noise": self._searches[0].noise}
        return Result(maps | others, process=process, declarations=self.declarations)


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
        return [self.threshold, max(0.0, self.threshold - self._level_sigma())]

    def _level_sigma(self) -> float:
        """Return the standard deviation of the level at the threshold, as a share of the range."""
        parts = (1 - self.threshold) * self.dark_sigma, self.threshold * self.bright_sigma
        span = np.nanmedian(np.asarray(self.bright, np.float64) - np.asarray(self.dark, np.float64))
        return math.hypot(*parts) / float(span)

    def result(self) -> Result:
        """Return height, status and frame of the frames so far."""
        return self._result(last=False)

    def finish(self) -> Result:
        """Return the maps of all frames, without copies of them."""
        return self._result(last=True)

    def _result(self, last: bool) -> Result:
        found, *lower = [search.found(last) for search in self._searches]
        if lower:
            found = found._replace(sigma=np.hypot(found.sigma, self._shift(found, lower[0])))
        return self.as_result(found)

    def _shift(self, found: Found, lower: Found) -> NDArray[np.float32]:
        """Return by how much heights depend on the uncertain level."""
        # A pixel that is always light at the lower threshold turned light no later than in the first frame.
        end = self._searches[0].travel[-1 if self.event == "release" else 0]
        return found.height - np.where(np.isfinite(lower.height), lower.height, np.float32(-end))


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
)
