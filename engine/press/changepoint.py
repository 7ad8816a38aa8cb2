"""Height from a vertical press or release: the change-point of each pixel's brightness."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.base.frames import Noise, reference_pair
from mirrorskin.engine.base.functions import travel_function
from mirrorskin.engine.base.picture import Picture
from mirrorskin.engine.diagnosis.position_uncertainty import PositionUncertainty
from mirrorskin.engine.press.crossing import EVENT_MAPS, Event, PressOperation
from mirrorskin.engine.press.nuisances import Nuisances
from mirrorskin.engine.press.onset import Onset
from mirrorskin.engine.press.steps import NoAnswer, RollingShutter
from mirrorskin.io import InputError, Result
from mirrorskin.io.model.positions import check_travel
from mirrorskin.kernels.press.changepoint import DECIDED, INVALID, REACH, SLOTS, UNIT

_EVIDENCE = 12.0  # minimum logarithm of the likelihood ratio of a change
_RELEASED = np.array([0, 1, 3, 2], np.uint8)  # status of a release, from that of a press


class ChangePoint(PressOperation):
    """Height from a press or a release, by the most likely change of each pixel's brightness.

    With `dark` and `bright`, it is a CUSUM of each pixel's samples (Page, Biometrika 41, 1954, 100-115). If
    one of them is missing, both are estimated from each pixel's own samples before and after the change: the
    split of the samples that leaves the least squares. This takes two passes over the frames.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> frames = np.zeros((6, 1, 2), np.uint8)
    >>> frames[3:, 0, 0] = 200
    >>> engine.run(frames, engine.ChangePoint(), travel=0.1 * np.arange(6)).frame
    array([[ 3, -1]], dtype=int32)
    """

    checks = NoAnswer, PositionUncertainty, RollingShutter, Nuisances

    threshold: float = Onset.threshold
    event: Event = Onset.event
    line_time: float | None = Onset.line_time
    blur: float | None = Onset.blur
    dark_sigma: float = Onset.dark_sigma
    bright_sigma: float = Onset.bright_sigma

    @property
    def passes(self) -> int:
        """Number of times that all frames are pushed: twice if a level is unknown."""
        return 2 if self.dark is None or self.bright is None else 1

    def check_options(self) -> None:
        """Raise InputError unless a change can be searched for with this threshold and hold."""
        if not 0 < self.threshold < 1:
            raise InputError(
                f"threshold {self.threshold}: a change-point needs a share between 0 and 1, such as 0.5"
            )
        if self.hold > REACH:
            raise InputError(f"hold {self.hold}: a change-point needs a number of frames from 1 to {REACH}")

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        self._release, self._twice = self.event == "release", self.passes == 2
        self._noise = Noise(self.noise, dtype.kind == "u")
        top: dict[str, Any] = {} if dtype.kind == "f" else {"TOP": int(np.iinfo(dtype).max)}
        self._maps = Picture(self, "changepoint", self._planes(), **top)
        # A release is a change from bright to dark: its first level is the bright one.
        self._level = 1 - self.threshold if self._release else self.threshold
        self._weight: NDArray[np.float64] | None = None  # of a split at each frame, in the second pass
        start: ArrayLike = 0
        if not self._twice:
            references = reference_pair(self.dark, self.bright, shape, dtype)
            first, second = reversed(references) if self._release else references
            if not any(first.strides + second.strides):  # the same references at all pixels
                first, second = first[0, 0], second[0, 0]
            start = np.where(np.isnan(first), INVALID, 0)
            self._fill(dark=np.nan_to_num(first), gain=1 / np.where(np.isnan(first), 1, second - first))
        self._fill(start=start, excess=0, below=0, since=0)
        if self._twice:
            self._fill(total=0, total_rest=0)

    @property
    def used_noise(self) -> float | None:
        """Standard deviation of a sample, counts."""
        return self._noise.value

    def _planes(self) -> dict[str, DTypeLike]:
        """Return the state of each pixel on the device; see ``changepoint.cl``."""
        integers = dict.fromkeys(("start", "excess", "below", "since"), np.int32)
        floats = dict.fromkeys(("dark", "gain", "height", "sigma"), np.float32)
        twice = dict.fromkeys(("mean", "mean_rest", "total", "total_rest", "score"), np.float32)
        ring = np.dtype((np.void, SLOTS * self.dtype.itemsize))  # the last samples
        return {
            "ring": ring, "status": np.uint8, **integers, **floats, **(twice if self._twice else {})
        }  # fmt: skip

    def start_second_pass(self) -> None:
        """Prepare for the same frames once more, to find each pixel's best split."""
        split = np.arange(1.0, self.count)
        self._weight = np.pad(self._sign / np.sqrt(split * (self.count - split)), 1)
        total, rest = self._maps.read("total", "total_rest")
        mean = (total.astype(np.float64) + rest) / self.count
        self._fill(mean=mean, mean_rest=mean - mean.astype(np.float32))
        self._fill(start=np.where(np.isfinite(mean), 0, INVALID), total=0, total_rest=0, score=0)

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Process the next frames, (n, H, W), and the travel of each, (n,) mm."""
        last = self.positions_so_far("travel")[-1:]
        check_travel(travel, len(frames), "travel", after=last, falls=self._release)
        self._noise.look(frames)
        if not self._twice:
            level = round(self._level * UNIT)
            lowest_drift = self.hold * (UNIT - level)
            self._maps.scan(
                "changepoint_scan", frames, level=level, min_excess=lowest_drift, quiet=self._quiet()
            )
        elif self._weight is None:
            self._maps.scan("changepoint_sum", frames)
        elif self.count + len(frames) < len(self._weight):
            self._maps.scan("changepoint_split", frames, weight=self._weight)
        else:
            raise InputError("the second pass has more frames than the first. Push the same frames twice")

    def result(self) -> Result:
        """Return height, status and frame of the frames so far."""
        noise = self._noise.value
        assert noise is not None  # there are two frames
        if self._twice:
            self._estimate_levels(noise)
        travel = self.positions_so_far("travel")
        high = travel.astype(np.float32)
        pairs = np.stack([high, travel - high], axis=1)  # whose sums have the precision of float64
        self._maps.run(
            "changepoint_heights", count=len(travel), travel=pairs, noise=noise, quiet=self._quiet(),
            level=self._level, own_levels=self._twice,
        )  # fmt: skip
        height, sigma, *integers = self._maps.take("height", "sigma", "status", "start")
        status, frame = map(np.asarray, integers)
        answered = (status == 1) | (status == 3)
        status = _RELEASED[status] if self._release else status
        frame = np.where(answered, frame, np.int32(-1))
        named: dict[str, Any] = dict(zip(EVENT_MAPS, (height, sigma, status, frame), strict=True))
        result = Result(named, process={"noise": noise}, declarations=self.declarations)
        return self.with_event(result)

    def _estimate_levels(self, noise: float) -> None:
        """Compute the levels from the best splits, where they are significant."""
        score, mean, start = (
            values.astype(np.float64) for values in self._maps.read("score", "mean", "start")
        )
        changed = score**2 * self.count / 2 > (_EVIDENCE + np.log(self.count)) * noise**2
        split = np.where(changed, start, 1)
        rest = np.sqrt((self.count - split) / split)
        score *= self._sign
        dark = np.where(changed, mean - score * rest, 0)
        gain = 1 / np.where(changed, score * (rest + 1 / rest), 1)
        self._fill(excess=np.where(changed, DECIDED, 0), below=start, dark=dark, gain=gain)

    def _fill(self, **maps: ArrayLike) -> None:
        for name, values in maps.items():
            self._maps.fill(name, values)

    @property
    def _sign(self) -> int:
        return -1 if self._release else 1

    def _quiet(self) -> float:
        """Return the sum of squared counts that noise alone may reach; 0 before the second frame."""
        return _EVIDENCE * (self._noise.value or 0.0) ** 2


find_change_point = travel_function(
    ChangePoint,
    "find_change_point",
    """Find the most likely change from dark to light, or back, in a stack that fits in memory.

    Returns
    -------
    Result
        As of `find_onset`; ``frame`` is the first frame after the most likely change.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, travel, references or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.zeros((6, 1, 2), np.uint8)
    >>> frames[3:, 0, 0] = 200
    >>> find_change_point(frames, 0.1 * np.arange(6), dark=0, bright=200).frame
    array([[ 3, -1]], dtype=int32)
    """,
    "Millimetres that the body has been lowered: never decreasing in a press, never increasing in a release.",
)
