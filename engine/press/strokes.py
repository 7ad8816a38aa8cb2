"""Height and hysteresis from a press that oscillates: the onsets and releases of all strokes, together."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from mirrorskin.engine.press.crossing import Crossing, CrossingOperation, Event, Found
from mirrorskin.engine.press.onset import STATUS, Onset
from mirrorskin.io import Map, Result
from mirrorskin.io.maps import TABLE, PressStatus
from mirrorskin.io.positions import check_strokes, stroke_starts
from mirrorskin.io.types import ProcessValue

_ALIKE = 1e-3  # relative difference of numbers that are the same but for rounding
_CONTRADICT = 0.001  # share of pixels without a place in all their intervals from which travel is not exact
_NOISY = 2.0  # standard deviations by which noise may move a crossing out of its interval
_UNLIKELY = 1e-3  # chance of a scatter that is taken to be more than what is predicted


class Strokes(CrossingOperation):
    """Height and hysteresis from a press that oscillates: the onsets and releases of all strokes.

    A stroke is a run of frames in which travel does not change its direction; its turning points belong to
    both strokes. The documentation, "Vibration", describes how strokes are joined. An unknown noise is
    estimated in the first stroke. A press of one stroke has no hysteresis. ``frame`` is that of the last
    stroke in which there was the event.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> travel = 0.5 - 0.5 * np.cos(0.8 * np.arange(60))
    >>> frames = np.where(travel > 0.3, 255, 0).astype(np.uint8)[:, np.newaxis, np.newaxis]
    >>> found = engine.run(frames, engine.press.Strokes(noise=1.0), travel=travel)
    >>> int(found.strokes[0, 0]), bool(abs(found.height[0, 0] + 0.3) < 0.03)
    (8, True)
    """

    threshold: float = Onset.threshold
    event: Event = Onset.event

    height = TABLE["height"]
    status = TABLE["status"]
    frame = TABLE["frame"]
    hysteresis = TABLE["hysteresis"]
    strokes = TABLE["strokes"]

    @property
    def declarations(self) -> Mapping[str, Map]:
        """Declarations of the maps; the legend of the status depends on the event."""
        return {**self.maps, "status": STATUS[self.event]}

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare a search for each direction."""
        directions: Mapping[int, Event] = {1: "onset", -1: "release"}
        self._searches = {
            sign: Crossing(self, shape, dtype, threshold=self.threshold, event=event)
            for sign, event in directions.items()
        }
        self.clear()

    @property
    def room(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return self._searches[1].room

    def clear(self) -> None:
        """Forget the frames so far."""
        for search in self._searches.values():
            search.reset()
        self._direction = 1  # a rest at the start is that before a press
        self._joined = {sign: _JoinedOnsets(self.shape) for sign in self._searches}
        self._travel: list[float] = []
        self._last: NDArray[Any] | None = None
        self._noise: float | None = None

    def push(self, frames: NDArray[Any], *, travel: ArrayLike, lent: bool = False) -> None:
        """Take in the next frames, (n, H, W), and the travel of each, (n,) mm."""
        values = check_strokes(travel, len(frames), "travel")
        before = self._travel[-1:]
        turns = (stroke_starts(np.concatenate([before, values]), self._direction) - len(before)).tolist()
        for start, stop in zip([0, *turns], [*turns, len(frames)], strict=True):
            if start in turns and stop > start:
                self._turn(frames[start - 1] if start > 0 else self._last)
            if stop > start:
                self._searches[self._direction].push(frames[start:stop], values[start:stop], lent)
                self._travel += values[start:stop].tolist()
        self._last = frames[-1].copy()

    def result(self) -> Result:
        """Return the maps of all strokes so far, the last of which is assumed to end here."""
        noise = self._known_noise
        joined = {sign: self._with_open(sign) for sign in self._searches}
        onset, release = (joined[sign].found() for sign in (1, -1))
        chosen, strokes = (onset, joined[1]) if self.event == "onset" else (release, joined[-1])
        maps: dict[str, Any] = {
            "height": chosen.height,
            "height_sigma": chosen.sigma,
            "status": chosen.status,
            "frame": chosen.frame,
        }
        process: dict[str, ProcessValue] = {"noise": noise}
        count = sum(one.strokes for one in joined.values())
        if count > 1:
            maps["hysteresis"] = release.height - onset.height
            maps["hysteresis_sigma"] = np.hypot(onset.sigma, release.sigma)
            maps["strokes"] = strokes.count
            process["strokes"] = count
        return Result(maps, process=process, declarations=self.declarations)

    def preview(self, seconds: float) -> Mapping[str, Any]:
        """Return height and contact, without the other maps."""
        if self.count < self.least_frames:
            return {}
        found = self._with_open(1).found()
        contact = np.isin(found.status, (PressStatus.ONSET, PressStatus.LIGHT_AT_START))
        return {"height": found.height, "contact": contact.astype(np.uint8)}

    def warm(self) -> None:
        """Press and lift nothing, twice, so that all kernels are compiled."""
        for travel in (0.0, 1.0, 2.0, 1.0, 0.0):
            self.push(np.zeros((1, *self.shape), self.dtype), travel=[travel])
            self.preview(0.0)
        self.reset()

    @property
    def _known_noise(self) -> float:
        """The noise, given or of the first stroke, counts."""
        return self._searches[self._direction].noise if self._noise is None else self._noise

    def _with_open(self, sign: int) -> _JoinedOnsets:
        """Return the onsets of a direction's strokes, including the open one."""
        if sign != self._direction:
            return self._joined[sign]
        joined, search = self._joined[sign].copy(), self._searches[sign]
        joined.add(search.found(), search.travel, len(self._travel))
        return joined

    def _turn(self, turning: NDArray[Any] | None) -> None:
        """End the open stroke, and begin the next with the frame at the turning point."""
        assert turning is not None  # a turn needs a frame before
        search = self._searches[self._direction]
        if len(search.travel) > 1:
            self._noise = search.noise if self._noise is None else self._noise
            if np.ptp(search.travel) > 0:  # else it was a rest
                self._joined[self._direction].add(search.found(), search.travel, len(self._travel))
        self._direction = -self._direction
        search = self._searches[self._direction]
        search.reset(self._noise)
        search.push(turning[np.newaxis], self._travel[-1:])


class _JoinedOnsets:
    """The onsets, or releases, of several strokes: sums and bounds of each pixel, (H W,).

    Heights are counted from the pixel's first, mm. Of a single stroke nothing is summed.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape, self.strokes = shape, 0
        self._first: Found | None = None

    def copy(self) -> _JoinedOnsets:
        """Return the same, to which more can be added."""
        other = copy(self)
        for name, values in vars(self).items():
            if isinstance(values, np.ndarray):
                setattr(other, name, values.copy())
        return other

    @property
    def count(self) -> NDArray[np.uint16]:
        """Strokes that had one, (H, W)."""
        if self.strokes > 1:
            return self._count.reshape(self._shape).copy()  # the next stroke is counted in place
        none = np.zeros(self._shape, np.uint16)
        return none if self._first is None else (self._first.status == PressStatus.ONSET).astype(np.uint16)

    def add(self, found: Found, travel: NDArray[np.float64], end: int) -> None:
        """Take in a stroke: its travel, and the number of the frame after it."""
        self.strokes += 1
        if self._first is None:
            self._first, self._alone = found, (travel, end)
            return
        if self.strokes == 2:
            self._begin()
            self._sum(self._first, *self._alone)
        self._sum(found, travel, end)

    def _begin(self) -> None:
        """Make room for sums."""
        pixels = self._shape[0] * self._shape[1]
        self._count, self._sudden = np.zeros((2, pixels), np.uint16)
        self._height = np.full(pixels, np.nan, np.float32)
        self._weight, self._guessed, self._moment, self._square = np.zeros((4, pixels))
        self._low, self._high = np.full(pixels, -np.inf), np.full(pixels, np.inf)
        self._frame = np.full(pixels, -1, np.int32)

    def _sum(self, found: Found, travel: NDArray[np.float64], end: int) -> None:
        at = np.flatnonzero(found.status == PressStatus.ONSET)
        frame = found.frame.reshape(-1)[at]
        height = found.height.reshape(-1)[at].astype(np.float64)
        sigma = found.sigma.reshape(-1)[at].astype(np.float64)
        ends = -travel[frame - 1], -travel[frame]
        low, high = np.minimum(*ends), np.maximum(*ends)
        # What noise hid at first was found in another step: the middle of it is the height.
        elsewhere = np.maximum(low - height, height - high) > _ALIKE * (high - low)
        low = np.where(elsewhere, height - np.sqrt(3) * sigma, low)
        high = np.where(elsewhere, height + np.sqrt(3) * sigma, high)
        half = (high - low) / 2
        guess = half / np.sqrt(3)
        guessed = sigma >= (1 - _ALIKE) * guess
        sudden = guessed & (sigma <= (1 + _ALIKE) * guess) & (abs(height - low - half) <= _ALIKE * half)

        begins = self._count[at] == 0
        self._height[at[begins]] = height[begins]
        apart = height - self._height[at]
        weight = 1 / np.maximum(sigma, np.finfo(np.float32).tiny) ** 2
        self._count[at] += 1
        self._sudden[at] += sudden
        self._weight[at] += weight
        self._guessed[at] += np.where(guessed, weight, 0.0)
        self._moment[at] += weight * apart
        self._square[at] += weight * apart**2
        noisy = _NOISY * np.sqrt(np.maximum(sigma**2 - np.where(guessed, guess, 0.0) ** 2, 0.0))
        noisy[sudden] = 0.0
        self._low[at] = np.maximum(self._low[at], low - noisy)
        self._high[at] = np.minimum(self._high[at], high + noisy)
        self._frame[at] = end - len(travel) + frame

    def found(self) -> Found:
        """Join what was found in all strokes."""
        if self._first is None:
            nothing, frame = np.full(self._shape, np.nan, np.float32), np.full(self._shape, -1, np.int32)
            return Found(nothing, nothing.copy(), np.zeros(self._shape, np.uint8), frame)
        if self.strokes == 1:
            travel, end = self._alone
            frame, earlier = self._first.frame, np.int32(end - len(travel))
            shifted = np.where(frame < 0, frame, frame + earlier) if earlier else frame
            return self._first._replace(frame=shifted)
        several, freedom = self._count > 1, np.maximum(self._count, 2) - 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            mean, width = self._moment / self._weight, self._high - self._low
            # Strokes that pass the same places make the same error in guessing between them.
            guessed = np.maximum(1 / self._guessed, width.clip(0) ** 2 / 12)
            predicted = 1 / (self._weight - self._guessed + 1 / guessed)
            square = np.where(several, self._square - mean * self._moment, 0.0)
            limits = special.chdtri(np.arange(1, freedom.max() + 1), _UNLIKELY)
            apart = square > limits[freedom.astype(np.intp) - 1]
            alike = several & ~apart
            overall = np.sum(square[alike]) / max(1.0, np.sum(freedom[alike]))
            more = np.where(apart, square / freedom, overall)
            variance = np.maximum(predicted, np.where(several, more / self._weight, 0.0))
            sudden = several & (self._sudden == self._count)
            height = self._height + np.where(several, mean, 0)
            # Samples on the way may tell less than they are taken to, or than the intervals do.
            outside = (height < self._low) | (height > self._high)
            better = sudden | apart | outside | (width**2 / 12 < variance)
            shared = several & (width > 0) & better
            if np.count_nonzero(shared & sudden) < (1 - _CONTRADICT) * np.count_nonzero(sudden):
                shared[:] = False
            height = np.where(shared, (self._low + self._high) / 2, height)
            sigma = np.sqrt(np.where(shared, width**2 / 12, variance))
        found = self.count > 0
        maps = (one.astype(np.float32).reshape(self._shape) for one in (height, sigma))
        height_map, sigma_map = (np.where(found, one, np.float32(np.nan)) for one in maps)
        status = np.where(found, np.uint8(PressStatus.ONSET), self._first.status)
        return Found(height_map, sigma_map, status, self._frame.reshape(self._shape))
