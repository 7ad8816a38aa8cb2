"""Reading of touches: a turn, and a press at the same place if there is one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

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
from mirrorskin.engine.calibration.touches.pressed import Pressed, read_press
from mirrorskin.engine.calibration.touches.sensor import FRAMES, SensorModel, Wall
from mirrorskin.engine.calibration.touches.view import NOT_FOLLOWED, Place, View, lacking, varied_places, vary
from mirrorskin.engine.calibration.touches.wall_light import WallLight
from mirrorskin.engine.calibration.touches.window import (
    TURNS,
    Poses,
    Window,
    slopes_of_waves,
)
from mirrorskin.engine.diagnosis.registration import Registered, Sight
from mirrorskin.engine.diagnosis.residual_noise import valid
from mirrorskin.engine.diagnosis.turn_light import uneven_terms
from mirrorskin.engine.diagnosis.turn_nuisances import (
    MAX_MISFIT,
    count_of,
    frame_priors,
    misfit_of,
    offset_prior,
    picture_axes,
)
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
from mirrorskin.kernels.numerics.least_squares import mad_sigma
from mirrorskin.kernels.rotation.registration import BORDER
from mirrorskin.kernels.rotation.response import sight_slopes

_ODD = (
    "its samples differ from the model by more than those of the other touches, as next to ridges. Touch"
    " something whose slopes change gradually"
)
_LEAST_FRAMES = 4
_LEAST_SIDE = 16
_AROUND = 2 * MARGIN + BORDER  # pixels next to the inner ones of a window on which they depend
_LEAST_NOISE = 0.3  # counts of 8 bits: rounding
_FLICKER = 4.0  # the light of frames may differ by this times the usual standard deviation, unless stated
_FLOOR = 1e-12  # variance that keeps covariances of gains and offsets without their means regular
_LEVELS = 5  # depths at which a surface without a press may be, from 0 to that of the body
_SMOOTH = 0.2  # least share of the pixels of a window that show the wall, and are next to no ridge or border
_UNEVEN = 0.01  # relative standard deviation of gains from one pixel to the next
_ODD_TILT = 0.15  # relative standard deviation of an assumed half-angle
_LEAST_PRESS = 0.1  # mm: from rest to the body's depth, between which a touched object is


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
    lacking: str  # why it has no window with slopes that vary, if it has none
    is_sharp: bool  # whether heights are those of a press, and samples neither interpolated nor uneven
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
        if not self.windows or not self.varied:
            return self.lacking
        return _ODD if self.follows() else NOT_FOLLOWED

    @property
    def misfit(self) -> float:
        """Variance of the residuals, relative to that of any two waves of a pixel."""
        counts = np.concatenate([window.counts[:, window.usable] for window in self.windows], axis=1)
        left = np.concatenate([window.left for window in self.windows], axis=1)
        return misfit_of(counts, left, self.phase, 1, self.least_noise)

    def follows(self) -> bool:
        """Return whether samples differ from the fit hardly more than from any two waves of a pixel."""
        return self.misfit < MAX_MISFIT


@dataclass(frozen=True, slots=True)
class TouchReader:
    """A turn, and a press at the same place or none, which can be read with other movements."""

    turn: Source
    has_press: bool
    pressed: Pressed
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
            return cls(turn, False, Pressed.unknown(shape), np.zeros(shape), device)
        if press.motion != "vertical":
            raise InputError(f"{press.name} has {press.motion} motion: give a press and a turn of each touch")
        if press.shape[1:] != shape:
            raise InputError(f"{press.name} and {turn.name} have pictures of different sizes")
        pressed = read_press(press, device)
        return cls(turn, True, pressed, fill_with_nearest(pressed.height), device)

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
        readers = [replace(self, relief=relief + level) for level in levels]

        def score(reader: TouchReader) -> float:
            touch = reader._read(source, sensor, starts=False)
            odd = math.log(touch.tilt_seen / sensor.tilt) / _ODD_TILT
            return touch.pixels * math.exp(-(odd**2) / 2)

        best = readers[0] if len(readers) == 1 else max(readers, key=score)
        return best._read(source, sensor)

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

    def _read(self, source: Source, sensor: SensorModel, starts: bool = True) -> Touch:
        """Read the turn; unless it ``starts``, windows are left without first heights, which take longest."""
        registered = None
        reader = self if sensor.wall is None else self._seen_along(sensor.wall)
        if sensor.pivot is not None:
            header = replace(
                source.header,
                pivot=sensor.pivot,
                tilt=sensor.tilt,
                zenith_gain=sensor.gain,
                zenith_offset=sensor.base,
            )
            sight = None if sensor.wall is None else Sight(sensor.wall.sight[0], sensor.wall.axis)
            source = registered = Registered(
                source, reader.relief, device=self.device, header=header, sight=sight
            )
        frames, phase = read_turn(source, FRAMES)
        if len(phase) < _LEAST_FRAMES:
            raise InputError(f"{source.name} has {len(phase)} frames: at least {_LEAST_FRAMES} are needed")
        noise_gain = 1.0 if registered is None else float(np.nanmedian(registered.noise_gain))
        with naming(self.turn):
            return reader._touch(frames, phase, noise_gain, sensor, starts)

    def _seen_along(self, wall: Wall) -> TouchReader:
        """Return the reader with the press as the pixels of a turn see it, along inclined lines of sight.

        A press is seen in the rest plane, and a turn above it.
        """
        axes = pixel_axes(self.relief.shape, pixel_size_of(self.turn))
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
        return replace(self, pressed=self.pressed.seen(seen), relief=relief)

    def _touch(
        self, frames: NDArray[Any], phase: Doubles, noise_gain: float, sensor: SensorModel, starts: bool
    ) -> Touch:
        header = self.turn.header
        whole: NDArray[np.bool_] = np.asarray(valid(frames).all(axis=0))
        for level in (sensor.gain, sensor.base, sensor.dark):
            whole &= np.isfinite(level)
        if not whole.any():
            raise InputError("no pixel has valid samples in all frames: shorten the exposure")
        counts = frames[:, whole]
        extremes = np.array([np.min(counts), np.max(counts)], np.float64)
        press, pixel_size = (self.pressed.middle, self.pressed.half), pixel_size_of(self.turn)

        def look(part: Place) -> View:
            return View.of(frames, phase, whole, sensor, press, pixel_size, part)

        views, looked = self._views(look, sensor.wall is not None)
        windows, misfits, slopes = list[Window](), np.zeros((2, len(TURNS))), list[Doubles]()
        for number, (place, view) in enumerate(views):
            window, wave = self._window(frames, sensor, noise_gain, place, view)
            if self.earlier is not None:
                window.z = self.earlier.windows[number].z
            elif starts:
                misfits += window.start(wave)
            if self.earlier is not None and not self.chooses:
                window.spacing = self.earlier.windows[number].spacing
                window.relief_shown = self.earlier.windows[number].relief_shown
                window.usable &= self.earlier.windows[number].usable
            shown = np.count_nonzero(view.shown[view.seen(window.place)])
            least = 0.0 if sensor.wall is None else _SMOOTH * shown  # what is left among ridges misleads
            if np.count_nonzero(window.usable) <= least:
                continue
            windows.append(window)
            slopes.append(slopes_of_waves(wave[:, window.usable]))
        arm = self._arm(sensor)
        return Touch(
            name=self.turn.name,
            windows=windows,
            poses=Poses(phase[:, np.newaxis], sensor.tilt, arm),
            phase=phase,
            frame_covariance=_frame_covariance(header, phase, extremes),
            frame_values=np.zeros(2 * len(phase)) if self.earlier is None else self.earlier.frame_values,
            least_noise=_LEAST_NOISE * count_of(extremes),
            time=_time_of(header),
            tilt_seen=float(np.median([view.tilt_seen for _, view in views])) if views else sensor.tilt,
            misfits=misfits,
            is_sharp=_is_sharp(windows, arm, sensor.gain),
            is_warm=self.earlier is not None and not self.chooses,
            relief=self.relief,
            lacking=lacking(looked, whole, sensor),
            varied=bool(slopes) and vary(np.concatenate(slopes, axis=1)),
        )

    def _views(
        self, look: Callable[[Place], View], all_over: bool
    ) -> tuple[list[tuple[Place, View]], list[View]]:
        """Return the windows with what frames show there, and all that was looked at."""
        if self.earlier is None or not self.earlier.windows:
            height, width = self.turn.shape[1:]
            view = look((slice(0, height), slice(0, width)))
            places = [] if self.earlier is not None else varied_places(view, all_over)
            return [(place, view) for place in places], [view]
        views = []
        for window in self.earlier.windows:
            rows, columns = window.place
            place, part = (
                (
                    slice(max(0, rows.start - margin), rows.stop + margin),
                    slice(max(0, columns.start - margin), columns.stop + margin),
                )
                for margin in (MARGIN, _AROUND)
            )
            views.append((place, look(part)))
        return views, [view for _, view in views]

    def _arm(self, sensor: SensorModel) -> float | None:
        press = self.turn.header.press
        return None if sensor.pivot is None or press is None else press - sensor.pivot[2]

    def _window(
        self, frames: NDArray[Any], sensor: SensorModel, noise_gain: float, place: Place,
        view: View,
    ) -> tuple[Window, Doubles]:  # fmt: skip
        """Return the window at a place, and the waves of its inner pixels, (3, n)."""
        rows, columns = (slice(part.start + MARGIN, part.stop - MARGIN) for part in place)
        inner, seen = (rows, columns), view.seen((rows, columns))
        usable, shown = view.usable[seen].ravel(), view.shown[view.seen(place)]
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
            middle=np.where(shown, self.pressed.middle[place], np.nan).ravel(),
            half=np.where(shown, self.pressed.half[place], np.nan).ravel(),
            error=np.where(shown, np.nan_to_num(self.pressed.error[place]), 0.0).ravel(),
            compliance=self.pressed.compliance,
            by_compliance=np.where(shown, np.nan_to_num(self.pressed.by_compliance[place]), 0.0).ravel(),
            relief=self.relief[inner].ravel(),
            z=self.relief[place].ravel(),
            noise_gain=noise_gain,
            depth=(-press / 2, press / 2),
            smooth=view.smooth[seen].astype(np.float64),
        )
        return window, np.nan_to_num(view.wave[:, *seen].reshape(3, -1))

    def _response(
        self, sensor: SensorModel, place: Place, usable: NDArray[np.bool_]
    ) -> LinearLight | WallLight:
        """Return the response of the pixels of a place."""

        def of(values: Doubles) -> Doubles:
            return np.where(usable, values[place].ravel(), 1.0)

        def spread(x: Doubles, y: Doubles) -> list[Doubles]:
            return [axis.ravel() for axis in np.meshgrid(x[place[1]], y[place[0]])]

        if sensor.wall is None:
            places = np.stack(uneven_terms(*spread(*picture_axes(self.relief.shape))))
            usual = float(np.nanmedian(sensor.gain))
            return LinearLight(of(sensor.gain), of(sensor.base), of(sensor.dark), sensor.full, usual, places)
        assert sensor.pivot is not None
        assert self.turn.header.press is not None
        places = np.stack(spread(*pixel_axes(self.relief.shape, pixel_size_of(self.turn))))
        return WallLight(of(sensor.dark), of(sensor.wall.span), places, self.turn.header.press, sensor.pivot)


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


def _is_sharp(windows: Sequence[Window], arm: float | None, gain: Doubles) -> bool:
    """Return whether heights are those of a press, samples not interpolated, and pixels alike.

    Interpolation is as wrong as slopes may be where a surface is rough, and makes that seem smoother. So do
    gains that scatter from one pixel to the next.
    """
    if arm is not None or not all(window.is_pressed for window in windows):
        return False
    steps = np.diff(gain, axis=1) / math.sqrt(2)
    return mad_sigma(steps[np.isfinite(steps)]) < _UNEVEN * abs(float(np.nanmedian(gain)))


def _time_of(header: Header) -> float:
    """Return the time of a recording, seconds since 1970; NaN if unknown."""
    try:
        start = datetime.fromisoformat(header.start_time)
    except ValueError:
        return math.nan
    return (start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp()
