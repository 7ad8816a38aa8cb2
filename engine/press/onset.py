"""Height from a vertical press: the travel at which a pixel turns light, or dark again (paper, section 3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.functions import travel_function
from mirrorskin.engine.base.options import option
from mirrorskin.engine.diagnosis.brightness_levels import EstimatedLevelNote, with_estimated_levels
from mirrorskin.engine.diagnosis.position_uncertainty import PositionUncertainty
from mirrorskin.engine.press.crossing import EVENT_MAPS, Crossing, Event, EventMaps, PressOperation
from mirrorskin.engine.press.nuisances import Nuisances
from mirrorskin.engine.press.steps import NoAnswer, RollingShutter
from mirrorskin.io import Result

if TYPE_CHECKING:
    from mirrorskin.io import Source


class ThresholdOperation(PressOperation):
    """Base of operations that search for one event at one or several thresholds."""

    checks = NoAnswer, PositionUncertainty, RollingShutter, Nuisances, EstimatedLevelNote

    subframe: bool = option(
        default=True,
        help="interpolate between the frames around the event; without it, the paper's equation 4 as printed",
    )
    event: Event = option(
        default="onset",
        help="event to find: dark to light while travel increases, or light to dark while it decreases",
    )

    dark_sigma: float = Nuisances.dark_sigma
    bright_sigma: float = Nuisances.bright_sigma
    line_time: float | None = RollingShutter.line_time
    blur: float | None = Nuisances.blur

    def configured_for(self, source: Source) -> Self:
        """Return the operation with levels and travel error of the source, or estimated from its frames."""
        return with_estimated_levels(super().configured_for(source), source)

    @property
    def shares(self) -> Sequence[float]:
        """The thresholds to search for, as shares of the range from dark to bright."""
        raise NotImplementedError

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare a search for each threshold."""
        self._searches = [
            Crossing(self, shape, dtype, threshold=threshold, event=self.event) for threshold in self.shares
        ]

    @property
    def used_noise(self) -> float:
        """Standard deviation of a sample, counts."""
        return self._searches[0].noise

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Process the next frames, (n, H, W), and the travel of each, (n,) mm."""
        for search in self._searches:
            search.push(frames, travel)

    def as_result(self, event_maps: EventMaps, **others: NDArray[Any]) -> Result:
        """Return the maps of the event, and others, as a result."""
        maps: dict[str, NDArray[Any]] = dict(zip(EVENT_MAPS, event_maps, strict=True))
        process = {"noise": self._searches[0].noise}
        result = Result(maps | others, process=process, declarations=self.declarations)
        return self.with_event(result)


class Onset(ThresholdOperation):
    """Height from a press or a release, by the crossing of a threshold (paper, equations 3 and 4).

    A pixel has the height f = -s at the travel s at which it turns light, or dark again. Levels of dark and
    light that are not given are those of the recording, or estimated from the frames; their uncertainty is
    added to the standard deviation, see `mirrorskin.engine.diagnosis.brightness_levels`.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> travel = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    >>> frames = np.full((5, 1, 2), 255, np.uint8) * (travel > 0.25)[:, np.newaxis, np.newaxis]
    >>> engine.run(frames, engine.Onset(threshold=0.4, noise=1.0), travel=travel).height.tolist()
    [[-0.25, -0.25]]
    """

    threshold: float = option(
        default=0.5,
        unit="share",
        within=(0, 1),
        help="share of the range from dark to bright at which a pixel counts as light",
    )

    @property
    def shares(self) -> Sequence[float]:
        """The threshold."""
        return [self.threshold]

    def result(self) -> Result:
        """Return height, status and frame of the frames so far."""
        return self.as_result(self._searches[0].event_maps(on_host=False))


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
        Frames and travel contradict each other or the assumptions, or there is no height at any pixel, with
        the reason. ``process`` also contains notes, such as levels that were estimated from the frames.

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
