"""Reading of touches: a turn, and a press at the same place if there is one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.base.running import Run, plan_of
from mirrorskin.engine.base.sources import EditedSource
from mirrorskin.engine.calibration.sources import pixel_size_of, read_turn
from mirrorskin.engine.calibration.touches.heights import (
    MARGIN,
)
from mirrorskin.engine.calibration.touches.light import LinearLight
from mirrorskin.engine.calibration.touches.wall_light import WallLight
from mirrorskin.engine.calibration.touches.window import (
    MOVEMENT,
    TURNS,
    Poses,
    Window,
    slopes_of_waves,
)
from mirrorskin.engine.calibration.wall import LIKELY
from mirrorskin.engine.calibration.wall_fit import levels_of
from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.engine.diagnosis.registration import Registered, Sight
from mirrorskin.engine.diagnosis.residual_noise import valid
from mirrorskin.engine.diagnosis.turn_light import uneven_terms
from mirrorskin.engine.diagnosis.turn_nuisances import (
    LEAST_LIGHT,
    MAX_MISFIT,
    count_of,
    frame_priors,
    misfit_of,
    offset_prior,
    picture_axes,
    shows_model,
)
from mirrorskin.engine.fusion.fusion import press_evidence
from mirrorskin.engine.rotation.rotation import Rotation
from mirrorskin.io import (
    Block,
    Header,
    InputError,
    Source,
    pixel_axes,
)
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.rotation.registration import BORDER
from mirrorskin.kernels.rotation.response import sight_slopes

NOT_FOLLOWED = (
    "the brightness does not follow the turn. Press deeper, on something with relief, and check phases, tilt"
    " and pivot"
)
"""Why a touch is not used that does not fit the model."""

_RECORD = "state an approximate one when it is captured or imported, as in"
_FRAMES = 32  # frames of a turn that are used, at most, evenly spaced
_LEAST_FRAMES = 4
_SIDE = 48  # pixels along a side of a window
_LEAST_SIDE = 16
_WINDOWS = 2  # of a touch, at most
_ALL_OVER = 6  # windows of a touch, at most, of a response that differs from place to place
_AROUND = 2 * MARGIN + BORDER  # pixels next to the inner ones of a window on which they depend
_LEAST_USABLE = 0.05  # share of the pixels of a window at which the model holds
_ENDS = 0.1, 99.9  # percentiles of samples that replace references
_LEAST_NOISE = 0.3  # counts of 8 bits: rounding
_FLICKER = 4.0  # the light of frames may differ by this times the usual standard deviation, unless stated
_FLOOR = 1e-12  # variance that keeps covariances of gains and offsets without their means regular
_LEVELS = 5  # depths at which a surface without a press may be, from 0 to that of the body
_SMOOTH = 0.2  # least share of the pixels of a window that show the wall, and are next to no ridge or border
_RIM, _REST_PLANE = 0.06, 0.92  # shares of full light between which scattered rays meet the whole wall
_LEVEL = 1.5  # tilts: zenith below which the wave of a pixel tells it better than the mean
_GENTLE = 3.0  # tilts: zenith up to which the amplitude of a wave may be any
_NEAR_AXIS = 0.5  # tilts: least difference of a zenith from the tilt, where the normal passes the axis
_VARIED = 0.2  # least scatter of the slopes of a touch, relative to the usual one
_ODD_TILT = 0.15  # relative standard deviation of an assumed half-angle
_LEAST_PRESS = 0.1  # mm: from rest to the body's depth, between which a touched object is
_STEEPEST = math.radians(80)
_EDGE = 4.0  # standard deviations between heights of neighbours, beyond their slope: an edge
_STEEPER = 1.2  # factor of slopes: they are approximate
_SWING = 0.4, 2.5  # range of the amplitude of the zenith, in tilts, from which the half-angle is guessed


class Wall(NamedTuple):
    """A lit wall whose print gets brighter from the rim down, and the lines of sight that are assumed."""

    body: tuple[float, float]  # nominal radius of the body and height of the wall, mm
    span: Doubles  # (H, W): counts from dark to full light
    axis: tuple[float, float]  # of the body, mm
    sight: tuple[float, float]  # see `mirrorskin.io.WallResponse`
    scatter: float  # half-angle of the sheet's scatter, radians


class SensorModel(NamedTuple):
    """What is assumed of the sensor before a fit: the parameters of its movement are relative to it."""

    gain: Doubles  # (H, W): counts per radian of zenith
    base: Doubles  # (H, W): counts at zenith 0
    dark: Doubles  # (H, W)
    full: float  # full light, counts
    tilt: float
    pivot: tuple[float, float, float] | None  # None: frames are not registered
    wall: Wall | None = None  # None: the response is linear in the zenith

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of a fit."""
        return (*(LinearLight if self.wall is None else WallLight).names, *MOVEMENT)


@dataclass(slots=True, eq=False)
class Touch:
    """Samples of a touch, and the gains and offsets of its frames."""

    name: str
    windows: list[Window]
    poses: Poses
    phase: Doubles  # (T,)
    frame_covariance: Doubles  # (2 T, 2 T)
    frame_values: Doubles  # (2 T,): gains and offsets of the frames
    least_noise: float  # counts
    time: float  # seconds since 1970; NaN if unknown
    tilt_seen: float  # radians: half-angle that the amplitude of the brightness shows
    misfits: Doubles  # of first slopes to surfaces; see `Window.start`
    varied: bool  # whether its slopes are not all alike
    relief: Doubles  # (H, W): heights with which frames were registered, mm
    is_warm: bool  # whether its surfaces are those of an earlier fit
    noise: float = 1.0  # variance of a sample

    _kept: tuple[Doubles, ...] = ()  # gains and offsets, and surfaces

    def keep(self) -> None:
        """Keep the present surfaces and frames."""
        self._kept = (self.frame_values, *(window.z for window in self.windows))

    def turn_back(self) -> None:
        """Go half way back to the surfaces and frames that were kept."""
        self.frame_values = (self.frame_values + self._kept[0]) / 2
        for window, z in zip(self.windows, self._kept[1:], strict=True):
            window.z = (window.z + z) / 2

    @property
    def pixels(self) -> int:
        """Number of usable pixels."""
        return sum(int(np.count_nonzero(window.usable)) for window in self.windows)

    @property
    def reason(self) -> str:
        """Why the touch is not used."""
        if not self.windows:
            return "it shows hardly any light in contact. Press deeper, on a larger object"
        if not self.varied:
            return "its slopes are all alike, as those of a plate or an edge. Touch something rough or round"
        return NOT_FOLLOWED

    @property
    def misfit(self) -> float:
        """Variance of the residuals, relative to that of any two waves of a pixel."""
        counts = np.concatenate([window.counts[:, window.usable] for window in self.windows], axis=1)
        left = np.concatenate([window.left for window in self.windows], axis=1)
        return misfit_of(counts, left, self.phase, 1, self.least_noise)

    def follows(self) -> bool:
        """Return whether samples differ from the fit hardly more than from any two waves of a pixel."""
        return self.misfit < MAX_MISFIT


def with_levels(header: Header, turns: Sequence[Source]) -> Header:
    """Return a header with the darkest and the brightest samples of all turns where it has no references.

    A wrong level only rescales the offset and the gain of a linear response, but pixels at its dark end are
    not linear, and are recognised by it.
    """
    if header.dark is not None and header.bright is not None:
        return header
    ends = []
    for turn in turns:
        if not turn.rewindable:
            raise InputError(
                f"{turn.name} has no dark and bright references, and cannot be read twice: record it first"
            )
        frames, _ = read_turn(turn, _FRAMES)
        samples = frames[valid(frames)]
        ends.append(np.percentile(samples, _ENDS) if samples.size else np.zeros(2))
    low, high = np.min(ends, axis=0)[0], np.max(ends, axis=0)[1]
    dark = np.asarray(low) if header.dark is None else header.dark
    return replace(header, dark=dark, bright=np.asarray(high) if header.bright is None else header.bright)


def model_of(turn: Source, header: Header, body: tuple[float, float] | None = None) -> SensorModel:
    """Return what the header of a recording, with levels, states of the sensor, under a wall or without."""
    if body is not None:
        return _model_under_wall(turn, header, body)
    shape = turn.shape[1:]
    if header.zenith_gain is None:
        raise InputError(
            f"{turn.name} has no zenith gain: touches improve an approximate one. Give it, such as"
            " --zenith-gain 6.3/deg --zenith-offset -60"
        )
    if header.tilt is None:
        raise InputError(f"{turn.name} has no tilt: {_RECORD} --tilt 2.5deg")
    gain, base, dark, bright = (
        np.broadcast_to(np.asarray(0.0 if values is None else values, np.float64), shape)
        for values in (header.zenith_gain, header.zenith_offset, header.dark, header.bright)
    )
    full = max(float(np.nanmedian(bright - dark)), 1e-9)
    pivot = header.pivot if header.pivot is not None else (0.0, 0.0, 0.0)
    return SensorModel(gain, base, dark, full, header.tilt, None if header.press is None else pivot)


def _model_under_wall(turn: Source, header: Header, body: tuple[float, float]) -> SensorModel:
    """Return the sensor whose wall is printed evenly, seen from the axis."""
    for name, remedy in (("tilt", "--tilt 2.5deg"), ("press", "--press 1.2mm")):
        if getattr(header, name) is None:
            raise InputError(f"{turn.name} has no {name}: {_RECORD} {remedy}")
    dark, bright = levels_of(turn, None)
    first = math.atan2(*body) / 2  # zenith at which the axis shows the rim
    gain = (bright - dark) / (math.pi / 4 - first)
    assert header.tilt is not None
    sight = LIKELY["sight_0"][0], LIKELY["sight_2"][0]
    wall = Wall(body, bright - dark, (0.0, 0.0), sight, LIKELY["scatter"][0])
    pivot = header.pivot or (0.0, 0.0, 0.0)
    full = float(np.nanmedian(wall.span))
    return SensorModel(gain, dark - first * gain, dark, full, header.tilt, pivot, wall)


@dataclass(frozen=True, slots=True)
class TouchReader:
    """A turn, and a press at the same place or none, which can be read with other movements."""

    turn: Source
    has_press: bool
    middle: Doubles  # (H, W): heights of the press, mm; NaN where unknown
    half: Doubles  # (H, W): half-widths of their intervals, mm; NaN in the same way
    relief: Doubles  # (H, W): heights that register frames, mm
    device: str | Device | None
    earlier: Touch | None = None  # the same touch, read with almost the same movement
    chooses: bool = False  # whether pixels and splines are chosen although there is an earlier touch

    @classmethod
    def of(cls, press: Source | None, turn: Source, device: str | Device | None = None) -> TouchReader:
        """Read a press, if there is one."""
        shape = turn.shape[1:]
        if min(shape) < _LEAST_SIDE:
            raise InputError(
                f"{turn.name} has {shape[1]} x {shape[0]} pixels: at least {_LEAST_SIDE} a side are needed"
            )
        if press is None:
            if not turn.rewindable:
                raise InputError(
                    f"{turn.name} cannot be read twice, as a turn without a press is: record it first"
                )
            unknown = np.full(shape, np.nan)
            return cls(turn, False, unknown, unknown, np.zeros(shape), device)
        if press.motion != "vertical":
            raise InputError(f"{press.name} has {press.motion} motion: give a press and a turn of each touch")
        if press.shape[1:] != shape:
            raise InputError(f"{press.name} and {turn.name} have pictures of different sizes")
        pressed, evidence = press_evidence(press, {"device": device})
        relief = np.asarray(pressed.height, np.float64)
        if not np.isfinite(relief).any():
            raise InputError(f"no pixel of {press.name} turned light: press deeper, or leave it out")
        half = math.sqrt(3) * evidence.heights.sigma
        return cls(turn, True, evidence.heights.height, half, fill_with_nearest(relief), device)

    def with_heights(self, touch: Touch, chooses: bool = False) -> TouchReader:
        """Return the reader with the surfaces of a touch, to register frames and to start with."""
        relief = touch.relief.copy()
        for window in touch.windows:
            part = relief[window.place]
            usable = window.usable.reshape(part.shape)
            part[usable] = window.heights[window.usable]
        return replace(self, relief=relief, earlier=touch, chooses=chooses)

    def read(self, sensor: SensorModel, sense: int, ahead: float) -> Touch:
        """Read the turn, with its phases times ``sense``, 1 or -1, plus ``ahead``, radians."""

        def turned(block: Block) -> Block:
            return block if block.phase is None else replace(block, phase=sense * block.phase + ahead)

        source: Source = self.turn
        if sense < 0 or ahead:
            source = EditedSource(source, turned)
        if self.has_press or self.earlier is not None:
            return self._read(source, sensor)
        relief = self._surface(source, sensor)
        press = self.turn.header.press or 0.0
        levels = np.zeros(1) if sensor.pivot is None else np.linspace(0, -press, _LEVELS)
        touches = (replace(self, relief=relief + level)._read(source, sensor) for level in levels)

        def score(touch: Touch) -> float:
            odd = math.log(touch.tilt_seen / sensor.tilt) / _ODD_TILT
            return touch.pixels * math.exp(-(odd**2) / 2)

        return max(touches, key=score)

    def _surface(self, source: Source, sensor: SensorModel) -> Doubles:
        """Return heights by the normals of a turn, (H, W), mm, with the highest at 0."""
        method = Rotation(
            zenith_gain=sensor.gain, zenith_offset=sensor.base, tilt=sensor.tilt, device=self.device
        )
        plan = plan_of(method, source)
        height = np.asarray(Run(plan, source).complete().height, np.float64)
        if not np.isfinite(height).any():
            return np.zeros(height.shape)
        return fill_with_nearest(height - np.nanmax(height))

    def _read(self, source: Source, sensor: SensorModel) -> Touch:
        registered = None
        reader = self if sensor.wall is None else self._seen_along(sensor.wall)
        if sensor.pivot is not None:
            header, sight = replace(source.header, pivot=sensor.pivot, tilt=sensor.tilt), None
            if sensor.wall is not None:
                header = replace(header, zenith_gain=sensor.gain, zenith_offset=sensor.base)
                sight = Sight(sensor.wall.sight[0], sensor.wall.axis)
            source = registered = Registered(
                source, reader.relief, device=self.device, header=header, sight=sight
            )
        frames, phase = read_turn(source, _FRAMES)
        if len(phase) < _LEAST_FRAMES:
            raise InputError(f"{source.name} has {len(phase)} frames: at least {_LEAST_FRAMES} are needed")
        noise_gain = 1.0 if registered is None else float(np.nanmedian(registered.noise_gain))
        with naming(self.turn):
            return reader._touch(frames, phase, noise_gain, sensor)

    def _seen_along(self, wall: Wall) -> TouchReader:
        """Return the reader with the press as the pixels of a turn see it, along inclined lines of sight.

        A press is seen in the rest plane, and a turn above it.
        """
        axes = pixel_axes(self.middle.shape, pixel_size_of(self.turn))
        x, y = np.meshgrid(*axes)
        size_x, size_y = pixel_size_of(self.turn)
        above = self.relief + (self.turn.header.press or 0.0)
        away = np.stack([x - wall.axis[0], y - wall.axis[1]])
        moved_x, moved_y = above * sight_slopes(away, wall.sight)
        columns, rows = np.meshgrid(*(np.arange(len(axis), dtype=np.float64) for axis in axes))
        column = (columns + moved_x / size_x).astype(np.float32)
        row = (rows - moved_y / size_y).astype(np.float32)

        def seen(values: Doubles) -> Doubles:
            remapped = cv2.remap(
                values, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan
            )
            return np.asarray(remapped, np.float64)

        relief = self.relief if self.earlier is not None else fill_with_nearest(seen(self.relief))
        return replace(self, middle=seen(self.middle), half=seen(self.half), relief=relief)

    def _touch(self, frames: NDArray[Any], phase: Doubles, noise_gain: float, sensor: SensorModel) -> Touch:
        header, shape = self.turn.header, self.turn.shape[1:]
        whole: NDArray[np.bool_] = np.asarray(valid(frames).all(axis=0))
        for level in (sensor.gain, sensor.base, sensor.dark):
            whole &= np.isfinite(level)
        if sensor.wall is not None:
            whole &= sensor.wall.span > 0
        if not whole.any():
            raise InputError("no pixel has valid samples in all frames: shorten the exposure")
        counts = frames[:, whole]
        extremes = np.array([np.min(counts), np.max(counts)], np.float64)
        if self.earlier is None:
            part = slice(0, shape[0]), slice(0, shape[1])
            view = self._view(frames, phase, whole, sensor, part)
            views = [(place, view) for place in _places(view, sensor.wall is not None)]
        else:
            views = []
            for window in self.earlier.windows:
                rows, columns = (
                    slice(max(0, each.start - _AROUND), each.stop + _AROUND) for each in window.place
                )
                place = tuple(slice(each.start - MARGIN, each.stop + MARGIN) for each in window.place)
                views.append(
                    ((place[0], place[1]), self._view(frames, phase, whole, sensor, (rows, columns)))
                )
        windows, misfits, slopes = list[Window](), np.zeros((2, len(TURNS))), list[Doubles]()
        for number, (place, view) in enumerate(views):
            window, wave = self._window(frames, sensor, noise_gain, place, view)
            if self.earlier is None:
                misfits += window.start(wave)
            else:
                window.z = self.earlier.windows[number].z
            if self.earlier is not None and not self.chooses:
                window.spacing = self.earlier.windows[number].spacing
                window.relief_shown = self.earlier.windows[number].relief_shown
                window.usable &= self.earlier.windows[number].usable
            shown = np.count_nonzero(view.shown[view.of(window.place)])
            least = 0.0 if sensor.wall is None else _SMOOTH * shown  # what is left among ridges misleads
            if np.count_nonzero(window.usable) <= least:
                continue
            windows.append(window)
            slopes.append(slopes_of_waves(wave[:, window.usable]))
        return Touch(
            name=self.turn.name,
            windows=windows,
            poses=Poses(phase[:, np.newaxis], sensor.tilt, self._arm(sensor)),
            phase=phase,
            frame_covariance=_frame_covariance(header, phase, extremes),
            frame_values=np.zeros(2 * len(phase)) if self.earlier is None else self.earlier.frame_values,
            least_noise=_LEAST_NOISE * count_of(extremes),
            time=_time_of(header),
            tilt_seen=float(np.median([view.tilt_seen for _, view in views])) if views else sensor.tilt,
            misfits=misfits,
            is_warm=self.earlier is not None and not self.chooses,
            relief=self.relief,
            varied=bool(slopes) and _vary(np.concatenate(slopes, axis=1)),
        )

    def _arm(self, sensor: SensorModel) -> float | None:
        press = self.turn.header.press
        return None if sensor.pivot is None or press is None else press - sensor.pivot[2]

    def _view(
        self, frames: NDArray[Any], phase: Doubles, whole: NDArray[np.bool_], sensor: SensorModel,
        part: tuple[slice, slice],
    ) -> _View:  # fmt: skip
        """Return what frames show in a part of the picture."""
        counts, middle = frames[:, *part].astype(np.float64), self.middle[part]
        with np.errstate(invalid="ignore", divide="ignore"):
            wave = _wave((counts - sensor.base[part]) / sensor.gain[part], phase, sensor.tilt)
            if sensor.wall is None:
                tilt_seen, least = _tilt_seen(wave, sensor.tilt), np.min(counts, axis=0) - sensor.dark[part]
                gentle = np.isfinite(middle) & (least > LEAST_LIGHT * sensor.full)
                gentlest = _GENTLE if self.has_press else _LEVEL  # skin without contact does not swing
                gentle &= wave[0] < _GENTLE * tilt_seen
                shown = whole[part] & (gentle | shows_model(wave, least, tilt_seen, sensor.full, gentlest))
                usable = shown & (np.abs(wave[0] / tilt_seen - 1) > _NEAR_AXIS)
            else:
                tilt_seen = sensor.tilt
                first = math.atan2(*sensor.wall.body) / 2
                low, high = ((wave[0] + side * tilt_seen - first) / (math.pi / 4 - first) for side in (-1, 1))
                usable = shown = whole[part] & np.isfinite(middle) & (low > _RIM) & (high < _REST_PLANE)
        if sensor.pivot is not None:
            usable = _without_border(usable)
        steepness = np.where(whole[part], np.tan(np.minimum(wave[0], _STEEPEST)), np.nan)
        smooth = _crosses_no_edge(middle, self.half[part], steepness, pixel_size_of(self.turn))
        if sensor.wall is not None:
            smooth &= ~_ridges(middle, self.half[part])
        return _View(part, wave, shown, usable & smooth, smooth, tilt_seen)

    def _window(
        self, frames: NDArray[Any], sensor: SensorModel, noise_gain: float, place: tuple[slice, slice],
        view: _View,
    ) -> tuple[Window, Doubles]:  # fmt: skip
        """Return the window at a place, and the waves of its inner pixels, (3, n)."""
        rows, columns = (slice(part.start + MARGIN, part.stop - MARGIN) for part in place)
        inner, seen = (rows, columns), view.of((rows, columns))
        usable, shown = view.usable[seen].ravel(), view.shown[view.of(place)]
        response = self._response(sensor, inner, usable)
        press = max(self.turn.header.press or 0.0, _LEAST_PRESS)
        window = Window(
            counts=np.where(usable, frames[:, rows, columns].reshape(len(frames), -1), 0.0).astype(
                np.float64
            ),
            response=response,
            pixel_size=pixel_size_of(self.turn),
            place=inner,
            usable=usable,
            middle=np.where(shown, self.middle[place], np.nan).ravel(),
            half=np.where(shown, self.half[place], np.nan).ravel(),
            relief=self.relief[inner].ravel(),
            z=self.relief[place].ravel(),
            noise_gain=noise_gain,
            depth=(-press / 2, press / 2),
            smooth=view.smooth[seen].astype(np.float64),
        )
        return window, np.nan_to_num(view.wave[:, *seen].reshape(3, -1))

    def _response(
        self, sensor: SensorModel, place: tuple[slice, slice], usable: NDArray[np.bool_]
    ) -> LinearLight | WallLight:
        """Return the response of the pixels of a place."""

        def of(values: Doubles) -> Doubles:
            return np.where(usable, values[place].ravel(), 1.0)

        def spread(x: Doubles, y: Doubles) -> list[Doubles]:
            return [axis.ravel() for axis in np.meshgrid(x[place[1]], y[place[0]])]

        if sensor.wall is None:
            places = np.stack(uneven_terms(*spread(*picture_axes(self.middle.shape))))
            return LinearLight(of(sensor.gain), of(sensor.base), of(sensor.dark), sensor.full, places)
        assert sensor.pivot is not None
        assert self.turn.header.press is not None
        places = np.stack(spread(*pixel_axes(self.middle.shape, pixel_size_of(self.turn))))
        return WallLight(of(sensor.dark), of(sensor.wall.span), places, self.turn.header.press, sensor.pivot)


class _View(NamedTuple):
    """What frames show in a part of a picture."""

    part: tuple[slice, slice]
    wave: Doubles  # (3, H, W): see `_wave`
    shown: NDArray[np.bool_]  # (H, W): whether the model holds
    usable: NDArray[np.bool_]  # (H, W): whether samples can be used
    smooth: NDArray[np.bool_]  # (H, W): whether slopes cross no edge
    tilt_seen: float

    def of(self, place: tuple[slice, slice]) -> tuple[slice, slice]:
        """Return the rows and columns of a place of the picture in the part."""
        rows, columns = (
            slice(each.start - part.start, each.stop - part.start)
            for each, part in zip(place, self.part, strict=True)
        )
        return rows, columns


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


def _vary(slopes: Doubles) -> bool:
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


def _frame_covariance(header: Header, phase: Doubles, counts: Doubles) -> Doubles:
    """Return the covariance of gains and offsets of frames, whose means are those of the sensor."""
    gains, offsets = frame_priors(header, phase, offset_prior(header, counts))
    if header.frame_gain_sigma is None:
        gains = _FLICKER**2 * gains
    covariance = np.zeros((2 * len(phase),) * 2)
    without_mean = np.eye(len(phase)) - 1 / len(phase)
    for part, block in ((slice(None, len(phase)), gains), (slice(len(phase), None), offsets)):
        covariance[part, part] = without_mean @ block @ without_mean
    return np.asarray(covariance + _FLOOR * np.eye(len(covariance)))


def _time_of(header: Header) -> float:
    """Return the time of a recording, seconds since 1970; NaN if unknown."""
    try:
        start = datetime.fromisoformat(header.start_time)
    except ValueError:
        return math.nan
    return (start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp()


def _places(view: _View, all_over: bool) -> Iterator[tuple[slice, slice]]:
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
