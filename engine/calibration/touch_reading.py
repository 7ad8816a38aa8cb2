"""Touches of unknown objects: reading of a press and a turn, and the windows that tell most of the sensor."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.base.sources import EditedSource
from mirrorskin.engine.calibration.sources import pixel_size_of, read_turn
from mirrorskin.engine.calibration.touch_window import MARGIN, TURNS, Poses, Window
from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.engine.diagnosis.registration import Registered
from mirrorskin.engine.diagnosis.residual_noise import valid
from mirrorskin.engine.diagnosis.turn_light import PixelScale, uneven_terms
from mirrorskin.engine.diagnosis.turn_nuisances import (
    count_of,
    frame_priors,
    offset_prior,
    picture_axes,
    shows_model,
)
from mirrorskin.engine.fusion.fusion import press_evidence
from mirrorskin.io import Block, Header, InputError, Source
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

_FRAMES = 32  # frames of a turn that are used, at most, evenly spaced
_LEAST_FRAMES = 4
_SIDE = 48  # pixels along a side of a window
_LEAST_SIDE = 4 * MARGIN
_WINDOWS = 2  # of a touch, at most
_LEAST_USABLE = 0.2  # share of the pixels of a window at which the model holds
_MAX_MISFIT = 4.0  # variance of residuals, relative to that of two waves a pixel, of a touch that fits
_LEAST_NOISE = 0.3  # counts of 8 bits: rounding
_FLICKER = 4.0  # the light of frames may differ by this times the usual standard deviation, unless stated
_FLOOR = 1e-12  # variance that keeps covariances of gains and offsets without their means regular
_SWING = 0.4, 2.5  # range of the amplitude of the zenith, in tilts, from which the half-angle is guessed


class SensorModel(NamedTuple):
    """What is assumed of the sensor before a fit: the parameters of touches are relative to it."""

    gain: Doubles  # (H, W): counts per radian of zenith
    base: Doubles  # (H, W): counts at zenith 0
    dark: Doubles  # (H, W)
    full: float | None  # full light, counts; None: the brightest sample
    tilt: float
    pivot: tuple[float, float, float] | None  # None: frames are not registered


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
    noise: float = 1.0  # variance of a sample

    def follows(self) -> bool:
        """Return whether samples differ from the fit hardly more than from any two waves of a pixel."""
        count = len(self.phase)
        waves = np.linalg.qr(np.concatenate([basis(self.phase), basis(2 * self.phase)[:, 1:]], axis=1))[0]
        if count <= waves.shape[1] + 1:
            return True
        counts = np.concatenate([window.counts[:, window.usable] for window in self.windows], axis=1)
        fitted = np.concatenate([window.left[:, window.usable] for window in self.windows], axis=1)
        left = counts - waves @ (waves.T @ counts)
        noise = float(np.median(np.sum(left**2, axis=0))) / (count - waves.shape[1])
        misfit = float(np.median(np.sum(fitted**2, axis=0))) / (count - 1)
        return bool(misfit < _MAX_MISFIT * max(noise, self.least_noise**2))


def model_of(turn: Source, header: Header) -> SensorModel:
    """Return what the header of a recording states of the sensor."""
    shape = turn.shape[1:]
    if header.zenith_gain is None:
        raise InputError(
            f"{turn.name} has no zenith gain: touches improve an approximate one. Give it, such as"
            " --zenith-gain 360 --zenith-offset -60"
        )
    if header.tilt is None:
        raise InputError(f"{turn.name} has no tilt: give an approximate one, as in --tilt 2.5deg")
    gain, base, dark = (
        np.broadcast_to(np.asarray(0.0 if values is None else values, np.float64), shape)
        for values in (header.zenith_gain, header.zenith_offset, header.dark)
    )
    full = None
    if header.bright is not None:
        span = header.bright - np.asarray(0.0 if header.dark is None else header.dark, np.float64)
        full = float(np.nanmedian(span))
    pivot = header.pivot if header.pivot is not None else (0.0, 0.0, 0.0)
    return SensorModel(gain, base, dark, full, header.tilt, None if header.press is None else pivot)


@dataclass(frozen=True, slots=True)
class TouchReader:
    """A press and a turn at the same place, which can be read with other movements."""

    turn: Source
    middle: Doubles  # (H, W): heights of the press, mm; NaN where unknown
    half: Doubles  # (H, W): half-widths of their intervals, mm
    relief: Doubles  # (H, W): heights that register frames, mm
    device: str | Device | None

    @classmethod
    def of(cls, press: Source, turn: Source, device: str | Device | None = None) -> TouchReader:
        """Read a press."""
        shape = turn.shape[1:]
        if min(shape) < _LEAST_SIDE:
            raise InputError(
                f"{turn.name} has {shape[1]} x {shape[0]} pixels: at least {_LEAST_SIDE} a side are needed"
            )
        if press.motion != "vertical":
            raise InputError(f"{press.name} has {press.motion} motion: give a press and a turn of each touch")
        if press.shape[1:] != shape:
            raise InputError(f"{press.name} and {turn.name} have pictures of different sizes")
        pressed, evidence = press_evidence(press, {"device": device})
        relief = np.asarray(pressed.height, np.float64)
        if not np.isfinite(relief).any():
            raise InputError(f"no pixel of {press.name} turned light: press deeper, or leave it out")
        half = math.sqrt(3) * evidence.heights.sigma
        return cls(turn, evidence.heights.height, half, fill_with_nearest(relief), device)

    def with_heights(self, touch: Touch) -> TouchReader:
        """Return the reader with the heights of a touch's surfaces to register frames."""
        relief = self.relief.copy()
        for window in touch.windows:
            part = relief[window.place]
            usable = window.usable.reshape(part.shape)
            part[usable] = window.heights[window.usable]
        return replace(self, relief=relief)

    def read(self, sensor: SensorModel, sense: int, ahead: float) -> Touch:
        """Read the turn, with its phases times ``sense``, 1 or -1, plus ``ahead``, radians."""

        def turned(block: Block) -> Block:
            return block if block.phase is None else replace(block, phase=sense * block.phase + ahead)

        source: Source = self.turn
        if sense < 0 or ahead:
            source = EditedSource(source, turned)
        registered = None
        if sensor.pivot is not None:
            header = replace(source.header, pivot=sensor.pivot, tilt=sensor.tilt)
            source = registered = Registered(source, self.relief, device=self.device, header=header)
        frames, phase = read_turn(source, _FRAMES)
        if len(phase) < _LEAST_FRAMES:
            raise InputError(f"{source.name} has {len(phase)} frames: at least {_LEAST_FRAMES} are needed")
        noise_gain = 1.0 if registered is None else float(np.nanmedian(registered.noise_gain))
        with naming(self.turn):
            return self._touch(frames, phase, noise_gain, sensor)

    def _touch(self, frames: NDArray[Any], phase: Doubles, noise_gain: float, sensor: SensorModel) -> Touch:
        header, shape, size = self.turn.header, self.turn.shape[1:], pixel_size_of(self.turn)
        whole = valid(frames).all(axis=0)
        frames = frames.astype(np.float64)
        for level in (sensor.gain, sensor.base, sensor.dark):
            whole &= np.isfinite(level)
        if not whole.any():
            raise InputError("no pixel has valid samples in all frames: shorten the exposure")
        light = frames - sensor.dark
        full = float(np.max(light[:, whole])) if sensor.full is None else sensor.full
        with np.errstate(invalid="ignore", divide="ignore"):
            wave = np.einsum(
                "kt,tij->kij", np.linalg.pinv(basis(phase)), (frames - sensor.base) / sensor.gain
            )
            tilt_seen = _tilt_seen(wave, sensor.tilt)
            usable = whole & shows_model(wave, np.min(light, axis=0), tilt_seen, full)
        counts = frames[:, whole]
        arm = None
        if sensor.pivot is not None and header.press is not None:
            arm = header.press - sensor.pivot[2]
        windows, misfits = list[Window](), np.zeros((2, len(TURNS)))
        x, y = np.meshgrid(*picture_axes(shape))
        for outer in _places(usable, wave):
            inner = [slice(part.start + MARGIN, part.stop - MARGIN) for part in outer]
            chosen = usable[*inner].ravel()
            gain, base, dark = (
                np.where(chosen, values[*inner].ravel(), 1.0)
                for values in (sensor.gain, sensor.base, sensor.dark)
            )
            window = Window(
                counts=np.where(chosen, frames[:, *inner].reshape(len(frames), -1), 0.0),
                scale=PixelScale(gain, base, dark, full),
                places=np.stack(uneven_terms(x[*inner].ravel(), y[*inner].ravel())),
                pixel_size=size,
                place=(inner[0], inner[1]),
                usable=chosen,
                middle=self.middle[outer].ravel(),
                half=self.half[outer].ravel(),
                relief=self.relief[*inner].ravel(),
                z=np.zeros(self.middle[outer].size),
                noise_gain=noise_gain,
            )
            misfits += window.start(np.nan_to_num(wave[:, *inner].reshape(3, -1)))
            windows.append(window)
        return Touch(
            name=self.turn.name,
            windows=windows,
            poses=Poses(phase[:, np.newaxis], sensor.tilt, arm),
            phase=phase,
            frame_covariance=_frame_covariance(header, phase, counts),
            frame_values=np.zeros(2 * len(phase)),
            least_noise=_LEAST_NOISE * count_of(counts),
            time=_time_of(header),
            tilt_seen=tilt_seen,
            misfits=misfits,
        )


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


def _places(usable: NDArray[np.bool_], wave: Doubles) -> Iterator[tuple[slice, slice]]:
    """Yield the windows in which slopes vary most, without overlap."""
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
    for _ in range(_WINDOWS):
        row, column = (int(number) for number in np.unravel_index(int(np.argmax(score)), score.shape))
        if score[row, column] < 0:
            return
        yield slice(row, row + side), slice(column, column + side)
        score[max(0, row - side + 1) : row + side, max(0, column - side + 1) : column + side] = -1.0
