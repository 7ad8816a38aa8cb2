"""A touch: press, lean and turn until the fused surface has the requested standard deviation."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.reconstruction import calibrated
from mirrorskin.engine.fusion.fusion import PressEvidence, fuse_sources, press_evidence
from mirrorskin.engine.fusion.solver import is_relative
from mirrorskin.engine.live.recipe import PRESS_STEPS, TURN_FRAMES, Contact, Measured, Recipe, cheapest
from mirrorskin.io import ArrayRecording, Calibrated, Calibration, InputError, Result, check
from mirrorskin.io.base.arguments import check_number, checked, in_unit
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.selection import Region
from mirrorskin.io.base.types import Header, Source
from mirrorskin.io.watch.saturation import REACHED, scale_ends, scale_top
from mirrorskin.kernels.device import Choice, open_devices

CLEAR_CHANGE = 8.0
"""Change of a pixel's counts on contact, in standard deviations of the noise."""

_MIN_PIXELS = 16  # pixels that must have changed
_LEAST_SHARE = 0.01  # of the pixels, which are lit in three frames, to compare their light
_NOISE_MIN = 0.3  # counts: rounding alone, as the standard deviation of integers
_NOT_JOINED = 0.005  # share of a region in contact that may be missing
_LEVEL_MAX = 0.1  # share of a region that may be level, and thus dark, if contact encircles it
_HALVINGS = 2  # of the distance between frames of the search, for the depth of a region
_LIGHT_MAX = 0.08  # share of the light by which it may change between frames
_MOVED_MAX, _SMOOTHED = 0.5, 2.0  # pixels: largest shift between press and turn, and Gaussian blur for it
_MANY = 8  # press steps of a recipe, from which on half of them are taken first
_SAME_CONTACT = 0.75  # least ratio of the areas of contact in press and turn
_RETAKES = 2  # of what the check complains about
_GAIN_MIN = 0.97  # more frames that leave more than this share of the standard deviation were of no use
_USELESS = 2  # extensions in a row that were of no use, after which a touch ends
_MARGIN = 0.85  # of the requested standard deviation, which a recipe of few steps aims at
_RETAKEN = ("flicker", "outliers", "repeated frames", "phase jump", "no response")
_SATURATED = "cut off"  # again in all frames until the exposure is shorter
_EXPOSURE_RATIO = 0.5, 0.9  # by which an exposure is multiplied at a time
_EXPOSURES_MAX = 8
_PRESS = {"method": "change-point"}


@dataclass(frozen=True)
class Pose:
    """A position of the body at rest: the travel, mm, and the lean, radians."""

    travel: float
    tilt: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True)
class Taken:
    """A frame, (H, W), and the position of the body at rest in it."""

    pose: Pose
    frame: NDArray[Any]


class TouchSensor(Protocol):
    """What a touch needs of a sensor: a body that can be moved, and frames of it at rest.

    `mirrorskin.hw.RigTouch` is one of a stage and a camera.

    Attributes
    ----------
    name : str
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    header : Header
        Of a rotation at the deepest travel, with pixel size, zenith gain, tilt and pivot.
    start, deepest : float
        Travel without contact, and greatest travel, mm.
    search : float
        Distance between frames until there is contact, mm.
    """

    name: str
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    header: Header
    start: float
    deepest: float
    search: float

    def take(self, travel: float, tilt: float = 0.0, phase: float = 0.0, /) -> NDArray[Any]:
        """Move to a travel, mm, and a lean, radians, rest there, and return a frame of its own, (H, W)."""

    def lift(self) -> None:
        """Set the body upright, and lift it."""

    def expose(self, ratio: float, /) -> None:
        """Multiply the exposure by a ratio below 1; the header follows. InputError if it is fixed."""

    def now(self) -> float:
        """Return the time, seconds."""


@dataclass(frozen=True)
class Touched:
    """Outcome of a touch.

    Attributes
    ----------
    result : Result
        The surface; ``height_sigma`` includes the uncertainty of the common height.
    press, turn : ArrayRecording
        The frames that it was computed from; `fuse_touch` of them repeats it.
    reached : bool
        Whether the requested share of the pixels has the requested standard deviation.
    share : float
        Share of the pixels with normals, in the region, that has it.
    sigma : float
        Standard deviation that the requested share of the pixels has, mm; infinite if some have none.
    reason : str
        Why the touch ended.
    planned : Recipe
        What was expected when there was contact.
    press_steps, turn_frames, search_frames, retaken : int
        Frames that were taken: of the press from the last one without contact, of the turn, before contact,
        and those that were taken again.
    seconds : float
        Time from the first frame to the last.
    """

    result: Result
    press: ArrayRecording
    turn: ArrayRecording
    reached: bool
    share: float
    sigma: float
    reason: str
    planned: Recipe
    press_steps: int
    turn_frames: int
    search_frames: int
    retaken: int
    seconds: float

    def __str__(self) -> str:
        known = f"{self.share:.1%} of the pixels have the requested standard deviation"
        frames = f"{self.press_steps} press steps and {self.turn_frames} turn frames in {self.seconds:.1f} s"
        return f"{frames}: {known}{self.reason and f'; {self.reason}'}"


@checked(sigma=in_unit("mm", check_number), share=check_number, within=in_unit("s", check_number))
def touch(
    sensor: TouchSensor,
    sigma: float,
    *,
    share: float = 0.95,
    within: float = math.inf,
    region: Region | None = None,
    calibration: Calibration | None = None,
    device: Choice = None,
    taken: list[Taken] | None = None,
    on_update: Callable[[str, Result | None], None] | None = None,
) -> Touched:
    """Press and turn until a share of the pixels has the requested standard deviation.

    The body is lowered until pixels change, and further in the steps of the recipe that is expected to
    suffice; it leans and turns at the deepest place. The fused surface decides: its standard deviations are
    measured from the frames. If they are too large, the frames that are expected to help most are added. What
    the check of the frames complains about is taken again; if light is cut off, everything is, with a shorter
    exposure.

    With n turn frames and b boundaries between press steps the expected variance of a height is ::

        a^2 s_r s_t ln(1 + 8 / (w a^2 s_r s_t)) / (4 pi) + beta^2 / b^1.5

    where a is the pixel size, s_r = c / (g sqrt(n)) and s_t = tan(theta) c sqrt(2 / n) / (g d) are the
    standard deviations of slopes along and across the inclination theta, for the noise c, the zenith gain g
    and the tilt d; beta is the rise within a pixel, a tan(theta) / sqrt(12), and w the density of boundaries.

    Parameters
    ----------
    sensor : TouchSensor
        Such as `mirrorskin.hw.RigTouch`.
    sigma : float
        Requested standard deviation of heights, mm, above 0.
    share : float
        Share of the pixels with normals, in the region, that must have it, above 0 to 1.
    within : float
        Seconds from the first frame; the best surface so far is returned then.
    region : Region, optional
        Part of the picture that must have it; by default all of it. The press is as deep as contact of the
        region needs, also when the body leans, which frames of the search find out. Frames and surface are
        those of the whole picture.
    calibration : Calibration, optional
        Applied to the frames of both movements.
    device : str, Device or sequence of them, optional
        See ``mirrorskin.kernels.device.open_devices``.
    taken : list of Taken, optional
        Receives all frames that are used, so that a caller can keep them if the touch fails.
    on_update : callable, optional
        Called with a line of text and the newest surface, or None, whenever either changes.

    Returns
    -------
    Touched
        The surface, why the touch ended, and the recordings of both movements.

    Raises
    ------
    mirrorskin.io.InputError
        Impossible numbers; a sensor without zenith gain or pixel size; or no contact.
    mirrorskin.engine.NotConverged
        No surface was found, with all frames either.

    Examples
    --------
    >>> from mirrorskin import engine, hw
    >>> with hw.open_rig(hw.load_rig("rig.toml"), steps=True) as rig:  # doctest: +SKIP
    ...     print(engine.live.touch(hw.RigTouch(rig), 0.003))
    """
    if not 0 < sigma < math.inf:
        raise InputError(f"sigma {sigma:g} mm is not possible: give a standard deviation above 0, as 0.002")
    if not 0 < share <= 1:
        raise InputError(f"share {share:g} is not possible: give one above 0, at most 1")
    if not within > 0:
        raise InputError(f"within {within:g} s is not possible: give a time above 0")
    if region is not None:
        region.check(sensor.shape, sensor.name)
    check_sensor(sensor, calibration)
    tell = on_update or (lambda text, result: None)
    work = _Touch(
        sensor, sigma, share, within, region, calibration, device, [] if taken is None else taken, tell
    )
    return work.run()


def check_sensor(sensor: TouchSensor, calibration: Calibration | None = None) -> Header:
    """Return the calibrated header of a turn; InputError without what heights from slopes need."""
    blank = np.zeros((2, *sensor.shape), sensor.dtype)
    frames = [Taken(Pose(0.0, 1.0, phase), blank[0]) for phase in (0.0, 1.0)]
    _, turn = recordings_of(sensor, frames)
    assert turn is not None
    header = _calibrated(turn, calibration).header
    for value, what in ((header.pixel_size, "pixel_size"), (header.zenith_gain, "zenith_gain")):
        if value is None:
            raise InputError(
                f"{sensor.name}: a touch needs {what}: give it in the rig file, or a calibration"
            )
    return header


def _calibrated(source: ArrayRecording, calibration: Calibration | None) -> Source:
    return source if calibration is None else Calibrated(source, calibration)


def recordings_of(
    sensor: TouchSensor, frames: Sequence[Taken]
) -> tuple[ArrayRecording | None, ArrayRecording | None]:
    """Return the frames so far as a press, in the order of travel, and a rotation; None for less than two.

    The press has no references: each pixel has levels of its own, because the light depends on its slope.
    """
    upright = sorted((t for t in frames if t.pose.tilt == 0), key=lambda t: t.pose.travel)
    leaning = [taken for taken in frames if taken.pose.tilt != 0]
    header = sensor.header
    levels = {"dark", "bright", "zenith_gain", "zenith_offset", "press", "tilt", "pivot", "motion"}
    fields = {name: getattr(header, name) for name in header.__dataclass_fields__}
    plain = {name: value for name, value in fields.items() if name not in levels and value is not None}
    press = turn = None
    if len(upright) >= 2:
        stack = np.stack([taken.frame for taken in upright])
        travel = [taken.pose.travel for taken in upright]
        title = f"{sensor.name}, press"
        press = ArrayRecording(stack, {"travel": travel}, {**plain, "title": title}, name=title)
    if len(leaning) >= 2:
        stack = np.stack([taken.frame for taken in leaning])
        phase = [taken.pose.phase for taken in leaning]
        axial = {name: value for name, value in fields.items() if name != "motion" and value is not None}
        title = f"{sensor.name}, turn"
        axial |= {"press": leaning[0].pose.travel, "title": title}
        turn = ArrayRecording(stack, {"phase": phase}, axial, name=title)
    return press, turn


def fuse_touch(press: Source, turn: Source, device: Choice = None) -> Result:
    """Return the surface of the press and the turn of a touch; each pixel of the press has its own levels."""
    return fuse_sources(press, turn, press=_PRESS, device=device)


def sigma_of_normals(surface: Result, region: Region | None = None) -> NDArray[np.float64]:
    """Return the standard deviations of the heights of all pixels with a normal, mm, or of those in a region.

    It is infinite where the height is unknown, also of a whole component.
    """
    sigma = np.where(is_relative(surface), np.inf, np.asarray(surface.height_sigma, np.float64))
    sigma = sigma[_with_normal(surface, region)]
    return np.where(np.isfinite(sigma), sigma, np.inf)


def _with_normal(surface: Result, region: Region | None) -> NDArray[np.bool_]:
    """Return which pixels have a normal, (H, W), and are in a region, if one is given."""
    with_normal: NDArray[np.bool_] = np.isfinite(np.asarray(surface.normals)[..., 0])
    if region is not None:
        inside = np.zeros(with_normal.shape, bool)
        inside[region.slices] = True
        with_normal &= inside
    return with_normal


class _ExposureChanged(Exception):  # noqa: N818
    """All frames must be taken again."""


class _Touch:
    """State of a touch."""

    def __init__(
        self,
        sensor: TouchSensor,
        sigma: float,
        share: float,
        within: float,
        region: Region | None,
        calibration: Calibration | None,
        device: Choice,
        taken: list[Taken],
        tell: Callable[[str, Result | None], None],
    ) -> None:
        self._sensor, self._sigma, self._share, self._within = sensor, sigma, share, within
        self._device, self._tell, self._taken = device, tell, taken
        self._calibration, self._region = calibration, region
        self._began = sensor.now()
        self._searched = self._retaken = 0
        self._error: NotConverged | None = None
        self._worker = ThreadPoolExecutor(1, "mirrorskin-touch")
        self._pressed: tuple[list[Taken], Future[tuple[Result, PressEvidence]]] | None = None
        self._doubts: dict[str, str] = {}  # findings that were left, by kind
        self._exposed_at = self._began  # when the exposure was changed
        self._exposures = 0  # changes of the exposure
        self._fixed = ""  # why it is not changed any more

    def run(self) -> Touched:
        """Find contact, press and turn, and add what helps until the surface is good enough."""
        try:
            while True:
                with suppress(_ExposureChanged):
                    return self._run()
        finally:
            self._worker.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> Touched:
        contact = self._find_contact()
        planned = self._plan(contact)
        self._tell(f"expected: {planned}", None)
        steps = planned.press_steps
        if steps >= _MANY:  # half may suffice, and halving its steps costs no frame
            steps = (steps + 1) // 2
        self._press(np.linspace(self._first, self._bottom, steps + 1)[1:])
        self._turn(planned.turn_frames)
        self._take_again_if_moved()
        best, sigma = self._measure(planned, None)
        useless, reason = 0, ""
        while best is None or not best.reached:
            following, reason = self._following(contact, sigma, best)
            if following is None:
                break
            text = "no surface yet" if best is None else str(best)
            self._tell(f"{text}; expected: {following}", None if best is None else best.result)
            self._extend(following)
            before = math.inf if best is None else best.sigma
            best, sigma = self._measure(planned, best)
            useless = useless + 1 if sigma > _GAIN_MIN * before else 0
            if best is not None and useless == _USELESS and not best.reached:
                reason = f"more frames no longer help, limited by {_limit(best, self._region)}"
                break
        self._sensor.lift()
        if best is None:
            assert self._error is not None
            raise self._error
        reason = "; ".join(["the request is met" if best.reached else reason, *self._doubts.values()])
        return replace(best, reason=reason, retaken=self._retaken, seconds=self._seconds)

    def _take(self, pose: Pose) -> NDArray[Any]:
        frame = self._sensor.take(pose.travel, pose.tilt, pose.phase)
        self._taken.append(Taken(pose, frame))
        return frame

    def _shorten(self, share: float) -> None:
        """Shorten the exposure by the share of the pixels in contact that are cut off, and begin again.

        If that is not possible, remember why.
        """
        least, most = _EXPOSURE_RATIO
        ratio = min(max(least, 1 - share), most)
        try:
            if self._exposures == _EXPOSURES_MAX:
                raise InputError(f"it was shortened {_EXPOSURES_MAX} times")
            if self._seconds + self._each * len(self._taken) > self._within:
                raise InputError("there is no time to take all frames again")
            self._sensor.expose(ratio)
        except InputError as error:
            self._fixed = str(error)
            return
        again = f"{len(self._taken)} frames are taken again with {ratio:.2f} of the exposure"
        self._tell(f"{share:.0%} of the pixels in contact are cut off: {again}", None)
        self._exposures += 1
        self._exposed_at = self._sensor.now()
        self._retaken += len(self._taken)
        self._taken.clear()
        self._doubts.clear()
        self._pressed = None
        raise _ExposureChanged

    @property
    def _seconds(self) -> float:
        return self._sensor.now() - self._began

    def _find_contact(self) -> Contact:
        """Lower the body until pixels change; return what is expected of the touch."""
        sensor = self._sensor
        places = np.arange(sensor.start, sensor.deepest, sensor.search)
        frames = [self._search(place) for place in places[:2]]
        noise = max(_NOISE_MIN, float(np.std(frames[1] - frames[0])) / math.sqrt(2))
        before = (frames[0] + frames[1]) / 2
        for place in places[2:]:
            frame = self._search(place)
            changed = np.abs(frame - before) > CLEAR_CHANGE * noise
            if np.count_nonzero(changed) >= _MIN_PIXELS:
                break
        else:
            sensor.lift()
            raise InputError(
                f"{sensor.name}: no contact down to a travel of {sensor.deepest:g} mm: check the position of"
                " the object and the light, or allow a deeper press"
            )
        self._before, self._clear = before, CLEAR_CHANGE * noise
        self._searched = len(self._taken) - 1
        self._first = self._taken[self._searched - 1].pose.travel
        header = check_sensor(sensor, self._calibration)
        self._bottom = self._depth_of_region(float(place), frame, header)
        del self._taken[self._searched :]  # they are between press steps, which must be even
        gain, offset = (
            0.0 if counts is None else float(np.mean(counts))
            for counts in (header.zenith_gain, header.zenith_offset)
        )
        zenith = float(np.median(np.clip((frame[changed] - offset) / gain, 0.05, 1.2)))
        pixel, tilt = max(header.pixel_size or (0.0,)), header.tilt or 0.0
        return Contact(pixel, noise, abs(gain), tilt, zenith, self._bottom - self._first)

    def _depth_of_region(self, place: float, frame: NDArray[np.float32], header: Header) -> float:
        """Return the least travel with contact of a region, also when the body leans, from a first contact.

        It is the deepest place without a region, or if contact ends before.
        """
        sensor, region = self._sensor, self._region
        if region is None:
            return sensor.deepest
        below, step = self._first, sensor.search
        while not self._joined(frame, region):
            if place == sensor.deepest:
                return place
            below, place = place, min(place + step, sensor.deepest)
            frame = self._search(place)
        for _ in range(_HALVINGS):
            middle = (below + place) / 2
            if self._joined(self._search(middle), region):
                place = middle
            else:
                below = middle
        lean = (header.tilt or 0.0) * _reach(region, sensor.shape, header)
        return min(place + lean, sensor.deepest)

    def _joined(self, frame: NDArray[np.float32], region: Region) -> bool:
        """Return whether a region is in contact; a level spot that the wall does not reach is encircled."""
        changed = np.abs(frame - self._before) > self._clear
        parts = [float(np.mean(contact[region.slices])) for contact in (changed, _filled(changed))]
        return parts[0] >= 1 - _LEVEL_MAX and parts[1] >= 1 - _NOT_JOINED

    def _search(self, travel: float) -> NDArray[np.float32]:
        """Return a frame of the search for contact; what is cut off in it shows no contact."""
        frame = self._take(Pose(float(travel)))
        top = scale_top(float(frame.max()), frame.dtype.kind == "u")
        if top is not None and np.mean(frame >= top) > REACHED and not self._fixed:
            self._shorten(1.0)
        return np.asarray(frame, np.float32)

    def _plan(self, contact: Contact) -> Recipe:
        """Return the cheapest recipe; if none suffices in time, what is possible in it."""
        room = (self._within - self._seconds) / self._each
        recipe = cheapest(contact.variance, self._sigma)
        if recipe is not None and recipe.press_steps < _MANY:  # of which all are taken first
            recipe = cheapest(contact.variance, _MARGIN * self._sigma) or recipe
        if recipe is None or recipe.frames > room:
            most = min(room, (PRESS_STEPS[1] + TURN_FRAMES[1]) / 2)
            turn = TURN_FRAMES[0]
            press = max(PRESS_STEPS[0], min(PRESS_STEPS[1] // 2, math.floor(most) - turn))
            recipe = Recipe(press, turn, math.sqrt(contact.variance(press, turn)))
        return self._timed(recipe, 0)

    @property
    def _each(self) -> float:
        """Seconds per frame so far."""
        return (self._sensor.now() - self._exposed_at) / (len(self._taken) + 1)

    def _timed(self, recipe: Recipe, taken: int) -> Recipe:
        return replace(recipe, seconds=self._each * (recipe.frames - taken))

    def _press(self, travels: Sequence[float] | NDArray[np.float64]) -> None:
        """Take frames at some travels, and again if the check complains."""
        first = len(self._taken)
        for travel in sorted(travels):
            if all(abs(travel - taken.pose.travel) >= 1e-6 for taken in self._taken):
                self._take(Pose(float(travel)))
        self._check(first)
        self._evidence()

    def _turn(self, count: int) -> None:
        """Lean at the deepest place, and take evenly spaced frames of a turn."""
        sensor = self._sensor
        tilt, press = sensor.header.tilt or 0.0, self._deepest
        earlier = [taken for taken in self._taken if taken.pose.tilt]
        first, shift = len(self._taken), math.pi / len(earlier) if earlier else 0.0
        for number in range(count):
            self._take(Pose(press, tilt, (math.tau * number / count + shift) % math.tau))
        self._check(first)

    def _evidence(self) -> Future[tuple[Result, PressEvidence]]:
        """Return the evidence of the press so far, which is computed while the body leans and turns."""
        upright = [taken for taken in self._taken if not taken.pose.tilt]
        if self._pressed is not None:
            earlier, evidence = self._pressed
            if len(earlier) == len(upright) and all(map(operator.is_, earlier, upright)):
                return evidence
        press, _ = recordings_of(self._sensor, upright)
        assert press is not None
        options = {**_PRESS, "device": open_devices(self._device)}
        source = calibrated(_calibrated(press, self._calibration))
        self._pressed = upright, self._worker.submit(press_evidence, source, options)
        return self._pressed[1]

    @property
    def _deepest(self) -> float:
        """Travel of the deepest frame that is upright."""
        return max(taken.pose.travel for taken in self._taken if not taken.pose.tilt)

    def _check(self, first: int) -> None:
        """Take frames from a number on again, while the check complains about them."""
        sensor = self._sensor
        leaning = bool(self._taken[-1].pose.tilt)
        for attempt in range(_RETAKES + 1):
            recording = recordings_of(sensor, self._taken)[int(leaning)]
            if recording is None:
                return
            texts = {finding.kind: finding.text for finding in _check(recording)}
            if _SATURATED in texts:
                if not self._fixed:
                    self._shorten(_cut_off(_frames_of(recording), self._before + self._clear))
                texts[_SATURATED] += f" ({self._fixed})"
            found = {kind: text for kind, text in texts.items() if kind in _RETAKEN}
            if not found or attempt == _RETAKES:
                self._doubts |= {kind: texts[kind] for kind in (*found, _SATURATED) if kind in texts}
                return
            if attempt:  # an earlier frame may be wrong
                first = self._searched
            again = [taken.pose for taken in self._taken[first:] if bool(taken.pose.tilt) == leaning]
            kept = [taken for taken in self._taken[first:] if bool(taken.pose.tilt) != leaning]
            self._taken[first:] = kept
            self._retaken += len(again)
            self._tell(f"{len(again)} frames are taken again: {'; '.join(found.values())}", None)
            for pose in again:
                self._take(pose)

    def _take_again_if_moved(self) -> None:
        """Take press and turn again if the object moved between them, as by a bump."""
        for attempt in range(_RETAKES + 1):
            moved = _moved(*recordings_of(self._sensor, self._taken))
            if moved <= _MOVED_MAX:
                return
            text = f"the object moved by {moved:.1f} pixels between press and turn"
            if math.isinf(moved):
                text = "press and turn do not show the same contact"
            if attempt == _RETAKES:
                self._doubts["moved"] = text
                return
            self._tell(f"{text}: both are taken again", None)
            poses = [taken.pose for taken in self._taken[self._searched :]]
            del self._taken[self._searched :]
            self._retaken += len(poses)
            for pose in poses:
                self._take(pose)

    @property
    def _counts(self) -> tuple[int, int]:
        """Numbers of press steps and of turn frames."""
        turn = sum(1 for taken in self._taken if taken.pose.tilt)
        return len(self._taken) - turn - self._searched, turn

    def _measure(self, planned: Recipe, best: Touched | None) -> tuple[Touched | None, float]:
        """Return the best outcome so far, and the standard deviation that the share of the pixels has now."""
        press, turn = recordings_of(self._sensor, self._taken)
        assert press is not None
        assert turn is not None
        sources = (_calibrated(source, self._calibration) for source in (press, turn))
        try:
            evidence = self._evidence().result()
            result = fuse_sources(*sources, press=_PRESS, device=self._device, evidence=evidence)
        except NotConverged as error:  # more frames may help
            self._error = error
            return best, math.inf
        sigma = sigma_of_normals(result, self._region)
        share = float(np.mean(sigma <= self._sigma)) if sigma.size else 0.0
        reaching = float(np.quantile(sigma, self._share, method="higher")) if sigma.size else math.inf
        reached = share >= self._share
        counts = *self._counts, self._searched, self._retaken
        outcome = Touched(result, press, turn, reached, share, reaching, "", planned, *counts, self._seconds)
        return outcome if best is None or reached or reaching < best.sigma else best, reaching

    def _following(self, contact: Contact, sigma: float, best: Touched | None) -> tuple[Recipe | None, str]:
        """Return the next recipe, or None and the reason; press steps are halved, so that they stay even."""
        press, turn = self._counts
        limited = "" if best is None else f", limited by {_limit(best, self._region)}"
        finer = [press, 2 * press] if 2 * press <= PRESS_STEPS[1] else [press]
        more = [(steps, count) for steps in finer for count in range(turn, TURN_FRAMES[1] + 1)][1:]
        known = math.isfinite(sigma)
        if not more or not (known or len(finer) == 2):
            return None, f"{press} press steps and {turn} turn frames do not suffice{limited}"
        variance = sigma**2 if known else math.inf
        measured = Measured(press, turn, variance, contact.variance_of_turn(press, turn))
        recipes = [Recipe(*counts, math.sqrt(measured.after(*counts))) for counts in more]
        enough = [recipe for recipe in recipes if recipe.sigma <= self._sigma]
        usual = (2 * press, turn) if len(finer) == 2 else (press, min(2 * turn, TURN_FRAMES[1]))
        other = next(recipe for recipe in recipes if (recipe.press_steps, recipe.turn_frames) == usual)
        recipe = self._timed(min(enough, key=lambda r: (r.frames, r.sigma), default=other), press + turn)
        if self._seconds + recipe.seconds > self._within:
            return None, f"there is no time for {recipe}{limited}"
        return recipe, ""

    def _extend(self, recipe: Recipe) -> None:
        """Take the middles of all press steps, and turn frames in between those so far."""
        steps, frames = self._counts
        if recipe.press_steps > steps:
            places = self._places
            self._press((places[1:] + places[:-1]) / 2)
        if recipe.turn_frames > frames:
            self._turn(recipe.turn_frames - frames)

    @property
    def _places(self) -> NDArray[np.float64]:
        """Travels of the press, from the last one without contact."""
        travels = {taken.pose.travel for taken in self._taken if not taken.pose.tilt}
        return np.array(sorted(travel for travel in travels if travel >= self._first))


def _check(recording: ArrayRecording) -> Sequence[Finding]:
    """Return the warnings of the check of frames, also of few."""
    change = _change_of_light(_frames_of(recording), recording.phase)
    found = check(recording).warnings
    if change > _LIGHT_MAX:
        found += (Finding("flicker", f"the light changes by {change:.1%} between frames: use a steady lamp"),)
    return found


def _cut_off(frames: NDArray[Any], light: NDArray[Any]) -> float:
    """Return which share of the pixels with more light, (H, W), reach the end of the scale."""
    stored = frames.reshape(len(frames), -1)
    highest = stored.max(axis=0).astype(np.float32)
    ends = scale_ends(stored, stored.astype(np.float32))
    return float(np.mean((highest >= ends)[highest > light.ravel()]))


def _frames_of(recording: ArrayRecording) -> NDArray[Any]:
    return np.stack([recording.frame(number) for number in range(recording.shape[0])])


def _change_of_light(frames: NDArray[Any], phase: NDArray[np.float64] | None) -> float:
    """Return the largest change of the light between frames, as a share of it.

    Of a turn, the mean brightness of the picture is fitted by one harmonic of the phase. Of a press, pixels
    in contact in two frames and in the one before have the same brightness in both.
    """
    counts = frames.astype(np.float32)
    lit = counts > max(1.0, float(counts.max())) / 4
    if phase is not None:
        always = lit.all(axis=0)
        if np.count_nonzero(always) < _MIN_PIXELS:
            return 0.0
        means = counts[:, always].mean(axis=1).astype(np.float64)
        columns = np.column_stack([np.ones(len(phase)), np.cos(phase), np.sin(phase)])
        residual = means - columns @ np.linalg.lstsq(columns, means, rcond=None)[0]
        free = max(1e-9, 1 - min(3, len(phase)) / len(phase))  # share of a change that the fit leaves
        return float(np.abs(residual).max() / means.mean() / free) if len(phase) > 3 else 0.0
    changes = [0.0]
    for number in range(2, len(counts)):
        both = lit[number - 2] & lit[number - 1] & lit[number]
        if np.count_nonzero(both) >= max(_MIN_PIXELS, _LEAST_SHARE * both.size):
            changes.append(abs(float(np.median(counts[number][both] / counts[number - 1][both])) - 1))
    return max(changes)


def _moved(press: ArrayRecording | None, turn: ArrayRecording | None) -> float:
    """Return by how many pixels the picture of a turn is shifted from that of a press; inf if it differs.

    The mean of a turn shows the same picture, because its leans cancel. The shift is that of least squares.
    """
    assert press is not None
    assert turn is not None
    pictures = press.frame(press.shape[0] - 1), _frames_of(turn).mean(axis=0)
    deepest, mean = (
        cv2.GaussianBlur(np.asarray(picture, np.float32), (0, 0), _SMOOTHED) for picture in pictures
    )
    light = deepest.max() / 4
    contact = np.count_nonzero(deepest > light), np.count_nonzero(mean > light)
    if min(contact) < _SAME_CONTACT * max(contact):
        return math.inf
    lit = (np.minimum(deepest, mean) > light).astype(np.uint8)
    inner = cv2.erode(lit, np.ones((9, 9), np.uint8)) > 0
    if np.count_nonzero(inner) < _MIN_PIXELS**2:
        return 0.0
    down, right = np.gradient(deepest)
    columns = np.column_stack([right[inner], down[inner], deepest[inner]])  # and the light
    shift = np.linalg.lstsq(columns, (deepest - mean)[inner], rcond=1e-2)[0]
    return float(np.hypot(*shift[:2]))


def _filled(contact: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return pixels in contact, and those that they encircle within the picture, (H, W)."""
    outside = np.pad(~contact, 1, constant_values=True).astype(np.uint8)
    cv2.floodFill(outside, None, (0, 0), 0)
    return contact | (outside[1:-1, 1:-1] > 0)


def _reach(region: Region, shape: tuple[int, int], header: Header) -> float:
    """Return the largest distance of a region from the pivot, mm along the sheet."""
    pixel_size = header.pixel_size or (0.0, 0.0)
    centre, sides = region.centre(shape, pixel_size), region.shape[::-1]
    away = (
        abs(place - pivot) + count * size / 2
        for place, pivot, count, size in zip(
            centre, (header.pivot or (0.0, 0.0))[:2], sides, pixel_size, strict=True
        )
    )
    return math.hypot(*away)


def _contradict(outcome: Touched) -> bool:
    """Return whether most of the variance is the contradiction of heights and slopes."""
    return 2 * (outcome.result.fitted.disagreement or 0.0) ** 2 > outcome.sigma**2


def _limit(outcome: Touched, region: Region | None) -> str:
    """Return what limits the standard deviation of an outcome."""
    result = outcome.result
    sigma = np.asarray(result.height_sigma, np.float64)
    if not np.isfinite(sigma[_with_normal(result, region)]).any() or not math.isfinite(outcome.sigma):
        return "pixels without a height: there is no contact, or no light"
    common = result.fitted.common_height_sigma or 0.0
    if 2 * common**2 > outcome.sigma**2:
        return f"the common height ({1e3 * common:.2g} µm, from the press steps)"
    if _contradict(outcome):
        return "the calibration: heights and slopes contradict each other"
    return "the noise of the slopes, and the blur at edges"
