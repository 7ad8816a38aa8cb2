"""What the frames of a turn show in a part of a picture: waves of the brightness, and usable pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.touches.heights import MARGIN
from mirrorskin.engine.calibration.touches.sensor import SensorModel
from mirrorskin.engine.calibration.touches.window import slopes_of_waves
from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.engine.diagnosis.turn_nuisances import LEAST_LIGHT, shows_model
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.registration import BORDER

_SIDE = 48  # pixels along a side of a window
_WINDOWS = 2  # of a touch, at most
_ALL_OVER = 6  # windows of a touch, at most, of a response that differs from place to place
_LEAST_USABLE = 0.05  # share of the pixels of a window at which the model holds
_RIM, _REST_PLANE = 0.06, 0.92  # shares of full light between which scattered rays meet the whole wall
_LEVEL = 1.5  # tilts: zenith below which the wave of a pixel tells it better than the mean
_GENTLE = 3.0  # tilts: zenith up to which the amplitude of a wave may be any
_NEAR_AXIS = 0.5  # tilts: least difference of a zenith from the tilt, where the normal passes the axis
_VARIED = 0.2  # least scatter of the slopes of a touch, relative to the usual one
_STEEPEST = math.radians(80)
_EDGE = 4.0  # standard deviations between heights of neighbours, beyond their slope: an edge
_STEEPER = 1.2  # factor of slopes: they are approximate
_SWING = 0.4, 2.5  # range of the amplitude of the zenith, in tilts, from which the half-angle is guessed

NOT_FOLLOWED = (
    "the brightness does not follow the turn. Press deeper, on something with relief, and check phases, tilt"
    " and pivot, and the travel of the press"
)
"""Why a touch is not used that does not fit the model."""

_CLIPPED = "hardly any pixel has valid samples in all frames. Shorten the exposure"
_DARK = "it shows hardly any light in contact. Press deeper, on a larger object"
_EDGES = "nearly all of its pixels are next to edges or ridges. Touch something whose slopes change gradually"
_ALIKE = "its slopes are all alike, as those of a plate or an edge. Touch something rough or round"
_REASONS = (
    _CLIPPED,
    _DARK,
    NOT_FOLLOWED,
    "its contact is narrow, or its slopes are those of the half-angle. Press deeper, on something steeper",
    _EDGES,
)
_REASONS_UNDER_WALL = (
    _CLIPPED,
    _DARK,
    "nearly all of its slopes are steeper than the wall shows. Touch something that is less steep",
    "its light is in patches of a few pixels. Touch something larger, whose slopes change gradually",
    _EDGES,
)  # why few pixels remain that have samples, are lit, shown, inside and usable; see `View`

Place = tuple[slice, slice]
"""Rows and columns of a part of a picture."""


class View(NamedTuple):
    """What frames show in a part of a picture."""

    part: Place
    wave: Doubles  # (3, H, W): see `_wave`
    lit: NDArray[np.bool_]  # (H, W): whether there is light in all frames
    shown: NDArray[np.bool_]  # (H, W): whether the model holds
    inside: NDArray[np.bool_]  # (H, W): the same, next to no border, and not near the half-angle
    usable: NDArray[np.bool_]  # (H, W): whether samples can be used: those that are also smooth
    smooth: NDArray[np.bool_]  # (H, W): whether slopes cross no edge
    tilt_seen: float

    @classmethod
    def of(
        cls, frames: NDArray[Any], phase: Doubles, whole: NDArray[np.bool_], sensor: SensorModel,
        press: tuple[Doubles, Doubles], pixel_size: tuple[float, float], part: Place,
    ) -> View:  # fmt: skip
        """Return what frames show where samples are ``whole``.

        ``press`` are the middles of the intervals of a press, and their half-widths, mm; NaN where unknown.
        """
        counts, middle, half = frames[:, *part].astype(np.float64), press[0][part], press[1][part]
        with np.errstate(invalid="ignore", divide="ignore"):
            wave = _wave((counts - sensor.base[part]) / sensor.gain[part], phase, sensor.tilt)
            if sensor.wall is None:
                tilt_seen, least = _tilt_seen(wave, sensor.tilt), np.min(counts, axis=0) - sensor.dark[part]
                lit = whole[part] & (least > LEAST_LIGHT * sensor.full)
                gentle = np.isfinite(middle) & lit
                has_press = np.isfinite(press[0]).any()
                gentlest = _GENTLE if has_press else _LEVEL  # skin without contact does not swing
                gentle &= wave[0] < _GENTLE * tilt_seen
                shown = whole[part] & (gentle | shows_model(wave, least, tilt_seen, sensor.full, gentlest))
                inside = shown & (np.abs(wave[0] / tilt_seen - 1) > _NEAR_AXIS)
            else:
                tilt_seen = sensor.tilt
                first = math.atan2(*sensor.wall.body) / 2
                low, high = ((wave[0] + side * tilt_seen - first) / (math.pi / 4 - first) for side in (-1, 1))
                lit = whole[part] & np.isfinite(middle) & (low > _RIM)
                inside = shown = lit & (high < _REST_PLANE)
        if sensor.pivot is not None:
            inside = _without_border(inside)
        steepness = np.where(whole[part], np.tan(np.minimum(wave[0], _STEEPEST)), np.nan)
        smooth = _crosses_no_edge(middle, half, steepness, pixel_size)
        if sensor.wall is not None:
            smooth &= ~_ridges(middle, half)
        return cls(part, wave, lit, shown, inside, inside & smooth, smooth, tilt_seen)

    def seen(self, place: Place) -> Place:
        """Return the rows and columns of a place of the picture in the part."""
        rows, columns = (
            slice(each.start - part.start, each.stop - part.start)
            for each, part in zip(place, self.part, strict=True)
        )
        return rows, columns


def lacking(views: Sequence[View], whole: NDArray[np.bool_], sensor: SensorModel) -> str:
    """Return why slopes of usable pixels do not vary.

    Either no slopes vary, or there are hardly any usable pixels: because of the first step that leaves few,
    or the strictest one.

    ``whole`` are the pixels of the picture, (H, W), with samples in all frames.
    """
    steps = [(whole[view.part], view.lit, view.shown, view.inside, view.usable) for view in views]
    counts = np.sum([[np.count_nonzero(pixels) for pixels in step] for step in steps], axis=0)
    reasons = _REASONS if sensor.wall is None else _REASONS_UNDER_WALL
    few = counts <= _LEAST_USABLE * min(_SIDE, *whole.shape) ** 2
    if few.any():
        return reasons[int(np.argmax(few))]
    slopes = np.concatenate([slopes_of_waves(view.wave[:, view.shown]) for view in views], axis=1)
    return reasons[2 + int(np.argmin(counts[2:] / counts[1:-1]))] if vary(slopes) else _ALIKE


def _crosses_no_edge(
    middle: Doubles, half: Doubles, steepness: Doubles, size: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), at which the differences of heights that slopes are cross no edge.

    From one pixel to the next, heights of the press, the ``middle`` of intervals, change there by more than
    the steepness explains.
    """
    clear = np.ones(middle.shape, np.bool_)
    for axis, pixel in ((1, size[0]), (0, size[1])):
        height, width, steep = (np.moveaxis(part, axis, 0) for part in (middle, half, steepness))
        expected = _STEEPER * pixel * np.fmax(steep[1:], steep[:-1])
        expected += _EDGE * np.hypot(width[1:], width[:-1]) / math.sqrt(3)
        steps = np.pad(np.abs(np.diff(height, axis=0)) > expected, ((MARGIN, MARGIN), (0, 0)))
        for shift in range(2 * MARGIN):
            np.moveaxis(clear, axis, 0)[...] &= ~steps[shift : shift + len(height)]
    return clear


def _ridges(middle: Doubles, half: Doubles) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), at which slopes are not those of one side of a ridge.

    There, the change of heights from one pixel to the next differs from that to the next but one.
    """
    ridges = np.zeros(middle.shape, np.uint8)
    for axis in (0, 1):
        height, width = np.moveaxis(middle, axis, 0), np.moveaxis(half, axis, 0)
        bent = np.abs(np.diff(height, 2, axis=0)) > _EDGE * math.sqrt(2) * width[1:-1]
        np.moveaxis(ridges, axis, 0)[1:-1] |= bent
    return np.asarray(cv2.dilate(ridges, np.ones((2 * MARGIN + 3,) * 2, np.uint8)) > 0)


def _without_border(usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels whose registered samples are interpolated from usable ones alone.

    Where contact or the linear response ends, brightness has a bend, across which samples are wrong.
    """
    reach = np.ones((2 * BORDER + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(usable.astype(np.uint8), reach) > 0)


def _wave(angles: Doubles, phase: Doubles, tilt: float) -> Doubles:
    """Return the zenith of each pixel, and the apparent half-angle times cosine and sine of the azimuth.

    The cosines of angles to the axis, (T, H, W), are a wave of the phase: its mean is cos(zenith) cos(tilt),
    and its amplitude sin(zenith) sin(tilt), which is the better known if the zenith is less than the tilt.
    """
    mean, cosine, sine = np.einsum("kt,tij->kij", np.linalg.pinv(basis(phase)), np.cos(angles))
    zenith, size = np.arccos(np.clip(mean / math.cos(tilt), -1, 1)), np.hypot(cosine, sine)
    swing = np.arcsin(np.clip(size / np.maximum(np.sin(zenith), 1e-9), 0, 1))
    by_size = np.arcsin(np.clip(size / math.sin(tilt), 0, 1))
    zenith = np.where(zenith < _LEVEL * tilt, by_size, zenith)
    return np.stack([zenith, *(-swing * part / np.maximum(size, 1e-30) for part in (cosine, sine))])


def vary(slopes: Doubles) -> bool:
    """Return whether slopes, (2, m), differ from each other.

    Those of a plate or of a ramp change like gains and offsets of the frames, whatever is wrong.
    """
    low, middle, high = np.percentile(slopes, (16, 50, 84), axis=1)
    return bool(np.hypot(*(high - low)) / 2 > _VARIED * np.hypot(*middle))


def _tilt_seen(wave: Doubles, tilt: float) -> float:
    """Return the usual amplitude of the zenith: pixels are usable at any half-angle near the assumed one."""
    swing = np.hypot(wave[1], wave[2])
    usual = swing[(wave[0] > 3 * tilt) & (swing > _SWING[0] * tilt) & (swing < _SWING[1] * tilt)]
    return float(np.median(usual)) if usual.size else tilt


def varied_places(view: View, all_over: bool) -> Iterator[Place]:
    """Yield the windows in which slopes vary most, without overlap; of tiles if they are to be all over."""
    usable, wave = view.usable, view.wave
    side = min(_SIDE, *usable.shape)
    azimuth = np.arctan2(wave[2], wave[1])
    flat = [np.where(usable, wave[0] * turned, 0.0) for turned in (np.cos(azimuth), np.sin(azimuth))]

    def sums(values: Doubles) -> Doubles:
        table = np.pad(np.cumsum(np.cumsum(values, axis=0), axis=1), ((1, 0), (1, 0)))
        return np.asarray(
            table[side:, side:] - table[:-side, side:] - table[side:, :-side] + table[:-side, :-side]
        )

    count = sums(usable.astype(np.float64))
    spread = sum(sums(part**2) - sums(part) ** 2 / np.maximum(count, 1) for part in flat)
    score = np.where(count > _LEAST_USABLE * side**2, spread, -1.0)
    if all_over:
        starts = (
            np.linspace(0, length - side, length // side).round().astype(np.intp) for length in usable.shape
        )
        tiles = np.zeros(score.shape, np.bool_)
        tiles[np.ix_(*starts)] = True
        score[~tiles] = -1.0
    for _ in range(_ALL_OVER if all_over else _WINDOWS):
        row, column = (int(number) for number in np.unravel_index(int(np.argmax(score)), score.shape))
        if score[row, column] < 0:
            return
        yield slice(row, row + side), slice(column, column + side)
        score[max(0, row - side + 1) : row + side, max(0, column - side + 1) : column + side] = -1.0
