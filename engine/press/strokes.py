"""Height and hysteresis from a press that oscillates: the onsets and releases of all strokes, together."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import on_host
from mirrorskin.engine.diagnosis.brightness_levels import EstimatedLevelNote, with_estimated_levels
from mirrorskin.engine.press.crossing import EVENT_MAPS, Crossing, Event, EventMaps, PressOperation
from mirrorskin.engine.press.nuisances import Nuisances
from mirrorskin.engine.press.onset import Onset
from mirrorskin.engine.press.steps import NoAnswer, RollingShutter
from mirrorskin.io import Result
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.model.maps import TABLE, PressStatus
from mirrorskin.io.model.positions import check_strokes, stroke_starts

if TYPE_CHECKING:
    from mirrorskin.io import Source

_EQUAL_TOLERANCE = 1e-3  # relative tolerance of equal numbers, for rounding
_MAX_CONTRADICTIONS = 0.001  # share of pixels with contradictory intervals above which travel is not exact
_NOISE_Z_SCORE = 2.0  # standard deviations: displacement of a crossing by noise that is tolerated
_SCATTER_PROBABILITY = 1e-3  # significance level of scatter beyond the predicted one


class Strokes(PressOperation):
    """Height and hysteresis from a press that oscillates: the onsets and releases of all strokes.

    A stroke is a sequence of frames with the same direction of travel; turning points belong to both strokes.
    The documentation, "Vibration", describes how strokes are joined. An unknown noise is estimated in the
    first stroke. A press of one stroke has no hysteresis. ``frame`` is the frame of the last stroke with an
    event.

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

    checks = NoAnswer, RollingShutter, Nuisances, EstimatedLevelNote

    threshold: float = Onset.threshold
    subframe: bool = Onset.subframe
    event: Event = Onset.event
    line_time: float | None = Onset.line_time
    blur: float | None = Onset.blur

    hysteresis = TABLE["hysteresis"]
    strokes = TABLE["strokes"]
    optional_maps = ("hysteresis", "strokes")  # of several strokes

    def configured_for(self, source: Source) -> Self:
        """Return the operation with levels and travel error of the source, or estimated from its frames."""
        return with_estimated_levels(super().configured_for(source), source, oscillates=True)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare a search for each direction."""
        events: Mapping[int, Event] = {1: "onset", -1: "release"}
        self._searches = {
            sign: Crossing(self, shape, dtype, threshold=self.threshold, event=event)
            for sign, event in events.items()
        }
        self._direction = 1  # frames at rest at the start belong to a press
        self._joined = {sign: _JoinedOnsets(self.shape) for sign in self._searches}
        self._travel: list[float] = []
        self._last: NDArray[Any] | None = None
        self._noise: float | None = None

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Process the next frames, (n, H, W), and the travel of each, (n,) mm."""
        values, frames = check_strokes(travel, len(frames), "travel"), on_host(frames)
        before = self._travel[-1:]
        turns = (stroke_starts(np.concatenate([before, values]), self._direction) - len(before)).tolist()
        for start, stop in zip([0, *turns], [*turns, len(frames)], strict=True):
            if start in turns and stop > start:
                self._turn(frames[start - 1] if start > 0 else self._last)
                self._last = None  # kernels may still read it
            if stop > start:
                self._searches[self._direction].push(frames[start:stop], values[start:stop])
                self._travel += values[start:stop].tolist()
        if self._last is None:
            self._last = np.empty_like(frames[-1])
        self._last[...] = frames[-1]

    def result(self) -> Result:
        """Return the maps of all strokes so far; the last one is assumed to end here."""
        joined = {sign: self._with_open(sign) for sign in self._searches}
        onset, release = (joined[sign].event_maps() for sign in (1, -1))
        chosen, strokes = (onset, joined[1]) if self.event == "onset" else (release, joined[-1])
        maps: dict[str, Any] = dict(zip(EVENT_MAPS, chosen, strict=True))
        noise = self._searches[self._direction].noise if self._noise is None else self._noise
        process: dict[str, ProcessValue] = {"noise": noise}
        count = sum(part.strokes for part in joined.values())
        if count > 1:
            maps["hysteresis"] = release.height - onset.height
            maps["hysteresis_sigma"] = np.hypot(onset.sigma, release.sigma)
            maps["strokes"] = strokes.count
            process["strokes"] = count
        result = Result(maps, process=process, declarations=self.declarations)
        return self.with_event(result)

    def preview(self, seconds: float) -> Result:
        """Return height and the contact at the newest travel, without the other maps."""
        if self.count < self.least_frames:
            return Result()
        onset = self._with_open(1).event_maps()
        contact = (onset.status == PressStatus.ONSET) | (onset.status == PressStatus.LIGHT_AT_START)
        contact &= ~(onset.height < np.float32(-self._travel[-1]))  # of a lifted body, what is still touched
        return Result(height=onset.height, height_sigma=onset.sigma, contact=contact.astype(np.uint8))

    def precompile(self) -> None:
        """Push two presses without an object, so that all kernels are compiled."""
        for travel in (0.0, 1.0, 2.0, 1.0, 0.0):
            self.push(np.zeros((1, *self.shape), self.dtype), travel=[travel])
            self.count += 1
            self.preview(0.0)

    def _with_open(self, sign: int) -> _JoinedOnsets:
        """Return the events of one direction, including those of the open stroke."""
        if sign != self._direction:
            return self._joined[sign]
        joined, search = self._joined[sign].copy(), self._searches[sign]
        joined.add(search.event_maps(), search.travel, len(self._travel))
        return joined

    def _turn(self, turning: NDArray[Any] | None) -> None:
        """End the open stroke, and start the next one with the frame at the turning point."""
        assert turning is not None  # a frame precedes every turn
        search = self._searches[self._direction]
        if len(search.travel) > 1:
            self._noise = search.noise if self._noise is None else self._noise
            if np.ptp(search.travel) > 0:  # otherwise the body was at rest
                self._joined[self._direction].add(search.event_maps(), search.travel, len(self._travel))
        self._direction = -self._direction
        search = self._searches[self._direction]
        search.reset(self._noise)
        search.push(turning[np.newaxis], self._travel[-1:])


class _JoinedOnsets:
    """The onsets, or releases, of several strokes: sums and bounds of each pixel, (H W,).

    Heights are relative to the first height of the pixel, mm. A single stroke is stored unchanged.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape, self.strokes = shape, 0
        self._first: EventMaps | None = None

    def copy(self) -> _JoinedOnsets:
        """Return an independent copy."""
        other = copy(self)
        for name, values in vars(self).items():
            if isinstance(values, np.ndarray):
                setattr(other, name, values.copy())
        return other

    @property
    def count(self) -> NDArray[np.uint16]:
        """Number of strokes with an event, (H, W)."""
        if self.strokes > 1:
            return self._count.reshape(self._shape).copy()  # later strokes are counted in place
        if self._first is None:
            return np.zeros(self._shape, np.uint16)
        return np.asarray(self._first.status == PressStatus.ONSET, np.uint16)

    def add(self, maps: EventMaps, travel: NDArray[np.float64], end: int) -> None:
        """Add a stroke: its maps, its travel, and the number of the frame after it."""
        self.strokes += 1
        if self._first is None:
            self._first, self._alone = maps, (travel, end)
            return
        if self.strokes == 2:
            pixels = self._shape[0] * self._shape[1]
            self._count, self._sudden = np.zeros((2, pixels), np.uint16)
            self._height = np.full(pixels, np.nan, np.float32)
            self._weight, self._guessed, self._moment, self._square = np.zeros((4, pixels))
            self._low, self._high = np.full(pixels, -np.inf), np.full(pixels, np.inf)
            self._frame = np.full(pixels, -1, np.int32)
            self._sum(self._first, *self._alone)
        self._sum(maps, travel, end)

    def _sum(self, maps: EventMaps, travel: NDArray[np.float64], end: int) -> None:
        at = np.flatnonzero(maps.status == PressStatus.ONSET)
        frame = maps.frame.reshape(-1)[at]
        height = maps.height.reshape(-1)[at].astype(np.float64)
        sigma = maps.sigma.reshape(-1)[at].astype(np.float64)
        ends = -travel[frame - 1], -travel[frame]
        low, high = np.minimum(*ends), np.maximum(*ends)
        # An event that noise delayed is located in another step: that step is its interval.
        elsewhere = np.maximum(low - height, height - high) > _EQUAL_TOLERANCE * (high - low)
        low = np.where(elsewhere, height - np.sqrt(3) * sigma, low)
        high = np.where(elsewhere, height + np.sqrt(3) * sigma, high)
        half = (high - low) / 2
        interval_sigma = half / np.sqrt(3)  # without a sample between the levels
        guessed = sigma >= (1 - _EQUAL_TOLERANCE) * interval_sigma
        sudden = guessed & (sigma <= (1 + _EQUAL_TOLERANCE) * interval_sigma)
        sudden &= abs(height - low - half) <= _EQUAL_TOLERANCE * half

        first = self._count[at] == 0
        self._height[at[first]] = height[first]
        apart = height - self._height[at]
        weight = 1 / np.maximum(sigma, np.finfo(np.float32).tiny) ** 2
        self._count[at] += 1
        self._sudden[at] += sudden
        self._weight[at] += weight
        self._guessed[at] += np.where(guessed, weight, 0.0)
        self._moment[at] += weight * apart
        self._square[at] += weight * apart**2
        noisy = _NOISE_Z_SCORE * np.sqrt(
            np.maximum(sigma**2 - np.where(guessed, interval_sigma, 0.0) ** 2, 0.0)
        )
        noisy[sudden] = 0.0
        self._low[at] = np.maximum(self._low[at], low - noisy)
        self._high[at] = np.minimum(self._high[at], high + noisy)
        self._frame[at] = end - len(travel) + frame

    def event_maps(self) -> EventMaps:
        """Return the combined maps of all strokes."""
        if self._first is None:
            height, frame = np.full(self._shape, np.nan, np.float32), np.full(self._shape, -1, np.int32)
            return EventMaps(height, height.copy(), np.zeros(self._shape, np.uint8), frame)
        if self.strokes == 1:
            travel, end = self._alone
            frame, earlier = self._first.frame, np.int32(end - len(travel))
            shifted = np.where(frame < 0, frame, frame + earlier) if earlier else frame
            return self._first._replace(frame=shifted)
        from scipy import special  # slow to import, and unneeded for a press of one stroke

        several, freedom = self._count > 1, np.maximum(self._count, 2) - 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            mean, width = self._moment / self._weight, self._high - self._low
            # Errors of interpolation are equal in strokes that pass the same positions.
            guessed = np.maximum(1 / self._guessed, width.clip(0) ** 2 / 12)
            predicted = 1 / (self._weight - self._guessed + 1 / guessed)
            square = np.where(several, self._square - mean * self._moment, 0.0)
            limits = special.chdtri(np.arange(1, freedom.max() + 1), _SCATTER_PROBABILITY)
            apart = square > limits[freedom.astype(np.intp) - 1]
            alike = several & ~apart
            overall = np.sum(square[alike]) / max(1.0, np.sum(freedom[alike]))
            more = np.where(apart, square / freedom, overall)
            variance = np.maximum(predicted, np.where(several, more / self._weight, 0.0))
            sudden = several & (self._sudden == self._count)
            height = self._height + np.where(several, mean, 0)
            # Bounds replace the mean where samples contradict them, scatter too much, or are less accurate.
            outside = (height < self._low) | (height > self._high)
            better = sudden | apart | outside | (width**2 / 12 < variance)
            shared = several & (width > 0) & better
            if np.count_nonzero(shared & sudden) < (1 - _MAX_CONTRADICTIONS) * np.count_nonzero(sudden):
                shared[:] = False
            height = np.where(shared, (self._low + self._high) / 2, height)
            sigma = np.sqrt(np.where(shared, width**2 / 12, variance))
        answered = self.count > 0
        maps = (values.astype(np.float32).reshape(self._shape) for values in (height, sigma))
        height_map, sigma_map = (np.where(answered, values, np.float32(np.nan)) for values in maps)
        status = np.where(answered, np.uint8(PressStatus.ONSET), self._first.status)
        return EventMaps(height_map, sigma_map, status, self._frame.reshape(self._shape))
