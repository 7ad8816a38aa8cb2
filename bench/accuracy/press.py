"""Presses whose changes are known: sudden ones and ramps, and how well they can be told."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.accuracy.aims import at_most, tell, within
from mirrorskin.bench.results import Case, Target
from mirrorskin.engine import Onset, find_change_point, find_onset
from mirrorskin.kernels.device import Device

_FRAMES = 40
_STEP = 0.05  # mm of travel a frame
_LEVELS = {"uint8": (20.0, 220.0), "uint16": (300.0, 3500.0), "float32": (20.0, 220.0)}
_NOISE = 0.01  # of the way from dark to light

_SHAPE, _SMALL = (240, 320), (48, 64)

Doubles = NDArray[np.float64]


def run_press(device: Device, quick: bool) -> Case:
    """Hold onsets and change-points of sudden changes and ramps against their truth, in each type.

    A sudden change lies anywhere in its interval: all that can be told is the interval, and the error is that
    of a uniform number. Of a ramp, two samples on either side of the level tell when it was crossed, by a
    straight line; noise in them is all that is wrong with it.
    """
    shape = _SMALL if quick else _SHAPE
    slack = 4 / np.sqrt(2 * shape[0] * shape[1])  # of a root mean square: four of its standard errors
    targets = []
    for kind in _LEVELS:
        targets += _sudden(kind, shape, device, slack)
        targets += _ramps(kind, shape, device, slack)
    title = f"onset and change-point of {_FRAMES} x {shape[0]} x {shape[1]} changes whose place is known"
    return tell("accuracy-press", title, targets)


def _sudden(kind: str, shape: tuple[int, int], device: Device, slack: float) -> list[Target]:
    """Return targets of changes from one frame to the next."""
    place = np.random.default_rng(1).uniform(2, _FRAMES - 2, shape)
    frames, known = _frames(kind, place, 0.0)
    found = find_onset(frames, **known, noise=_noise(kind), device=device)
    first = np.ceil(place)
    error = _error(found, place) * np.sqrt(12)
    sigma = float(np.mean(found.sigma)) / _STEP * np.sqrt(12)
    return [
        at_most(f"{kind}, sudden: onsets in another frame", float(np.mean(found.frame != first)), 0),
        within(f"{kind}, sudden: RMS error of 1/sqrt(12) frame", _rms(error), 1 - slack, 1 + slack),
        within(f"{kind}, sudden: sigma of 1/sqrt(12) frame", sigma, 0.999, 1.001),
    ]


def _ramps(kind: str, shape: tuple[int, int], device: Device, slack: float) -> list[Target]:
    """Return targets of ramps of 6 frames, and the share of the noise that the best estimate has."""
    lasts = 6.0
    place = np.random.default_rng(2).uniform(2 + lasts, _FRAMES - 2 - lasts, shape)
    frames, known = _frames(kind, place, lasts)
    noise = _noise(kind)
    onset = find_onset(frames, **known, noise=noise, device=device)
    change = find_change_point(frames, **known, noise=noise, device=device)
    share = np.ceil(place) - place  # of the interval that lies behind the crossing
    span = _LEVELS[kind][1] - _LEVELS[kind][0]
    line = noise * lasts / span * np.sqrt(np.mean(share**2 + (1 - share) ** 2))
    best = noise * lasts / span / np.sqrt(lasts)  # Cramer and Rao: as many samples on the ramp, levels known
    error, other = _error(onset, place), _error(change, place)
    return [
        at_most(f"{kind}, ramps: RMS error of a straight line's", _rms(error) / line, 1.1 + slack),
        within(f"{kind}, ramps: chi-square", _chi_square(onset, error), 0.8, 1.15),
        at_most(f"{kind}, ramps: mean error in RMS errors", abs(float(error.mean())) / _rms(error), 0.15),
        at_most(f"{kind}, ramps: change-point, RMS error of the Cramer-Rao bound's", _rms(other) / best, 1.5),
        within(f"{kind}, ramps: change-point, chi-square", _chi_square(change, other), 0.6, 1.15),
    ]


def _frames(kind: str, place: Doubles, lasts: float) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return frames that cross half of the way at a place, (T, H, W), and travel, dark and bright."""
    dark, bright = _LEVELS[kind]
    number = np.arange(_FRAMES)[:, np.newaxis, np.newaxis]
    share = np.clip((number - place) / lasts + 0.5, 0, 1) if lasts else (number >= place).astype(float)
    noise = np.random.default_rng(3).normal(0, _NOISE, share.shape)
    counts = dark + (bright - dark) * (share + noise)
    frames = counts.astype(kind) if kind == "float32" else np.rint(counts).astype(kind)
    return frames, {"travel": np.arange(_FRAMES) * _STEP, "dark": dark, "bright": bright}


def _noise(kind: str) -> float:
    """Return the standard deviation of a sample, counts, with what rounding adds."""
    light = _NOISE * (_LEVELS[kind][1] - _LEVELS[kind][0])
    return light if kind == "float32" else float(np.hypot(light, 1 / np.sqrt(12)))


def _error(found: Onset, place: Doubles) -> Doubles:
    """Return by how many frames the height is wrong; NaN without an answer."""
    return np.asarray(-found.height.astype(np.float64) / _STEP - place)


def _chi_square(found: Onset, error: Doubles) -> float:
    return float(np.mean((error * _STEP / found.sigma) ** 2))


def _rms(error: Doubles) -> float:
    return float(np.sqrt(np.mean(error**2)))
