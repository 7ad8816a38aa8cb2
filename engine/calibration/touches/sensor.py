"""What is assumed of a sensor before touches are fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from mirrorskin.engine.calibration.sources import read_turn
from mirrorskin.engine.calibration.touches.light import LinearLight
from mirrorskin.engine.calibration.touches.wall_light import WallLight
from mirrorskin.engine.calibration.touches.window import MOVEMENT
from mirrorskin.engine.calibration.wall import LIKELY
from mirrorskin.engine.calibration.wall_fit import levels_of
from mirrorskin.engine.diagnosis.residual_noise import valid
from mirrorskin.io import Header, InputError, Source
from mirrorskin.kernels.array_types import Doubles

FRAMES = 32
"""Frames of a turn that are used, at most, evenly spaced."""

_RECORD = "state an approximate one when it is captured or imported, as in"
_ENDS = 0.1, 99.9  # percentiles of samples that replace references
_LEAST_LIT = 0.1  # least light of a pixel, of the usual one: others are dead or covered


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
        frames, _ = read_turn(turn, FRAMES)
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
    stated = header.zenith_gain, header.zenith_offset
    if all(values is None or np.size(values) == 1 for values in stated):
        gain, base = _of_pixels(float(gain.flat[0]), float(base.flat[0]), dark, bright, turn.dtype)
    pivot = header.pivot if header.pivot is not None else (0.0, 0.0, 0.0)
    return SensorModel(gain, base, dark, full, header.tilt, None if header.press is None else pivot)


def _of_pixels(
    gain: float, base: float, dark: Doubles, bright: Doubles, dtype: np.dtype[Any]
) -> tuple[Doubles, Doubles]:
    """Return gain and offset of each pixel, (H, W), by its references.

    They are NaN where the bright one is clipped, and where it shows hardly any light, as at a dead pixel.
    """
    clear = bright < (np.iinfo(dtype).max if dtype.kind == "u" else math.inf)
    span = _lit(np.where(clear, bright - dark, np.nan))
    if np.isnan(span).all():
        return np.full(dark.shape, gain), np.full(dark.shape, base)
    share = span / np.nanmedian(span)
    return gain * share, dark + (base - np.nanmedian(dark)) * share


def _lit(span: Doubles) -> Doubles:
    """Return the counts from dark to full light of each pixel, (H, W), NaN where they are few."""
    known = span[np.isfinite(span)]
    usual = float(np.median(known)) if known.size else 0.0
    return np.where((span > _LEAST_LIT * usual) & (span > 0), span, np.nan)


def _model_under_wall(turn: Source, header: Header, body: tuple[float, float]) -> SensorModel:
    """Return the sensor whose wall is printed evenly, seen from the axis."""
    for name, remedy in (("tilt", "--tilt 2.5deg"), ("press", "--press 1.2mm")):
        if getattr(header, name) is None:
            raise InputError(f"{turn.name} has no {name}: {_RECORD} {remedy}")
    dark, bright = levels_of(turn, None)
    first = math.atan2(*body) / 2  # zenith at which the axis shows the rim
    span = _lit(bright - dark)
    gain = span / (math.pi / 4 - first)
    assert header.tilt is not None
    sight = LIKELY["sight_0"][0], LIKELY["sight_2"][0]
    wall = Wall(body, span, (0.0, 0.0), sight, LIKELY["scatter"][0])
    pivot = header.pivot or (0.0, 0.0, 0.0)
    full = float(np.nanmedian(wall.span))
    return SensorModel(gain, dark - first * gain, dark, full, header.tilt, pivot, wall)
