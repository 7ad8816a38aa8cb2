"""Accuracy of a device: answers compared with known truths. All targets of these cases must be met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.cli.commands.bench.records import Case, Target
from mirrorskin.engine import (
    estimate_normals,
    find_change_point,
    find_onset,
    fuse,
    integrate,
)
from mirrorskin.io import Result
from mirrorskin.kernels.device import Device
from suite.harness import Cases, at_most, within
from suite.scenes import STEPS, TILT

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FRAMES = 40
_STEP = 0.05  # travel per frame, mm
_LEVELS = {"uint8": (20.0, 220.0), "uint16": (300.0, 3500.0), "float32": (20.0, 220.0)}
_CHANGE_NOISE = 0.01  # divided by bright minus dark
_SHAPE, _SMALL = (240, 320), (48, 64)


def run_press(device: Device, quick: bool) -> Case:
    """Compare onsets and change-points of sudden changes and ramps with the truth, for each sample type.

    A sudden change may be anywhere between two frames, so its error is distributed uniformly. On a ramp, the
    crossing is computed from a straight line through the samples on both sides of the level, and its error is
    due to their noise alone.
    """
    shape = _SMALL if quick else _SHAPE
    slack = 4 / np.sqrt(2 * shape[0] * shape[1])  # four standard errors of a root mean square
    targets = []
    for kind in _LEVELS:
        targets += _sudden(kind, shape, device, slack)
        targets += _ramps(kind, shape, device, slack)
    title = f"onset and change-point of {_FRAMES} x {shape[0]} x {shape[1]} changes at known times"
    return _case("accuracy-press", title, targets)


def _sudden(kind: str, shape: tuple[int, int], device: Device, slack: float) -> list[Target]:
    """Return targets of changes between two frames."""
    place = np.random.default_rng(1).uniform(2, _FRAMES - 2, shape)
    frames, known = _changes(kind, place, 0.0)
    found = find_onset(frames, **known, noise=_press_noise(kind), device=device)
    first = np.ceil(place)
    error = _frame_error(found, place) * np.sqrt(12)
    sigma = float(np.mean(found.height_sigma)) / _STEP * np.sqrt(12)
    return [
        at_most(f"{kind}, sudden: onsets in another frame", float(np.mean(found.frame != first)), 0),
        within(f"{kind}, sudden: RMS error of 1/sqrt(12) frame", _rms(error), 1 - slack, 1 + slack),
        within(f"{kind}, sudden: sigma of 1/sqrt(12) frame", sigma, 0.999, 1.001),
    ]


def _ramps(kind: str, shape: tuple[int, int], device: Device, slack: float) -> list[Target]:
    """Return targets of ramps of 6 frames, and of the error relative to the best estimate's."""
    lasts = 6.0
    place = np.random.default_rng(2).uniform(2 + lasts, _FRAMES - 2 - lasts, shape)
    frames, known = _changes(kind, place, lasts)
    noise = _press_noise(kind)
    onset = find_onset(frames, **known, noise=noise, device=device)
    change = find_change_point(frames, **known, noise=noise, device=device)
    share = np.ceil(place) - place  # share of the interval after the crossing
    span = _LEVELS[kind][1] - _LEVELS[kind][0]
    line = noise * lasts / span * np.sqrt(np.mean(share**2 + (1 - share) ** 2))
    best = noise * lasts / span / np.sqrt(lasts)  # Cramer-Rao bound for known levels
    error, other = _frame_error(onset, place), _frame_error(change, place)
    return [
        at_most(f"{kind}, ramps: RMS error of a straight line's", _rms(error) / line, 1.1 + slack),
        within(f"{kind}, ramps: chi-square", _chi_square(onset, error), 0.8, 1.15),
        at_most(f"{kind}, ramps: mean error in RMS errors", abs(float(error.mean())) / _rms(error), 0.15),
        at_most(f"{kind}, ramps: change-point, RMS error of the Cramer-Rao bound's", _rms(other) / best, 1.5),
        within(f"{kind}, ramps: change-point, chi-square", _chi_square(change, other), 0.6, 1.15),
    ]


def _changes(kind: str, place: Doubles, lasts: float) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return frames, (T, H, W), that cross the threshold at a time, and travel, dark and bright."""
    dark, bright = _LEVELS[kind]
    number = np.arange(_FRAMES)[:, np.newaxis, np.newaxis]
    share = np.clip((number - place) / lasts + 0.5, 0, 1) if lasts else (number >= place).astype(float)
    noise = np.random.default_rng(3).normal(0, _CHANGE_NOISE, share.shape)
    counts = dark + (bright - dark) * (share + noise)
    frames = counts.astype(kind) if kind == "float32" else np.rint(counts).astype(kind)
    return frames, {"travel": np.arange(_FRAMES) * _STEP, "dark": dark, "bright": bright}


def _press_noise(kind: str) -> float:
    """Return the standard deviation of a sample, including rounding, counts."""
    light = _CHANGE_NOISE * (_LEVELS[kind][1] - _LEVELS[kind][0])
    return light if kind == "float32" else float(np.hypot(light, 1 / np.sqrt(12)))


def _frame_error(found: Result, place: Doubles) -> Doubles:
    """Return the error of the height in frames; NaN if there is no height."""
    return np.asarray(-found.height.astype(np.float64) / _STEP - place)


def _chi_square(found: Result, error: Doubles) -> float:
    return float(np.mean((error * _STEP / found.height_sigma) ** 2))


def _rms(error: Doubles) -> float:
    return float(np.sqrt(np.mean(error**2)))


# Degrees. A normal inclined by the tilt is parallel to an axis of the body, where linear theory fails.
_BINS = (0, 1), (1, 2), (2.4, 2.6), (3, 5), (5, 10), (10, 20), (20, 35), (35, 50), (50, 58)
_DRAWS, _FEW_DRAWS = 10_000, 2_000
_PHASES = np.arange(STEPS, dtype=np.float64) * (2 * np.pi / STEPS)


@dataclass(frozen=True, slots=True)
class Sensor:
    """Counts at zenith 0, counts per radian, standard deviation in counts before rounding, type."""

    offset: float
    gain: float
    noise: float
    kind: str

    @property
    def spread(self) -> float:
        """Standard deviation of a sample, including rounding."""
        return self.noise if self.kind == "float32" else float(np.hypot(self.noise, 1 / np.sqrt(12)))

    @property
    def known(self) -> dict[str, Any]:
        """The options of the operation."""
        return {"tilt": TILT, "zenith_gain": self.gain, "zenith_offset": self.offset, "noise": self.spread}


_SENSORS = (
    Sensor(12.0, 206.0, 1.0, "uint8"),
    Sensor(150.0, 3438.0, 20.0, "uint16"),
    Sensor(0.0, 286.0, 1.5, "float32"),
)


def expose(normals: Doubles, sensor: Sensor, seed: int) -> NDArray[Any]:
    """Return noisy frames, (STEPS, ...), of normals, (..., 3), computed by equation 10."""
    angle = np.arccos(np.clip(_axes() @ np.moveaxis(normals, -1, 0).reshape(3, -1), -1, 1))
    counts = sensor.offset + sensor.gain * angle.reshape(STEPS, *normals.shape[:-1])
    counts += np.random.default_rng(seed).normal(0, sensor.noise, counts.shape)
    if sensor.kind == "float32":
        return counts.astype(np.float32)
    return np.clip(np.rint(counts), 0, np.iinfo(sensor.kind).max).astype(sensor.kind)


def toward(zenith: Doubles, azimuth: Doubles) -> Doubles:
    """Return unit normals, (..., 3)."""
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], -1)


def run_normals(device: Device, quick: bool) -> Case:
    """Compare normals with the Cramer-Rao bound of equation 10 in bins of zenith, for each sample type."""
    draws = _FEW_DRAWS if quick else _DRAWS
    slack = 0.02 + 3 / np.sqrt(draws)
    generator = np.random.default_rng(5)
    ends = np.radians(np.array(_BINS))
    zenith = generator.uniform(ends[:, :1], ends[:, 1:], (len(_BINS), draws))
    truth = toward(zenith, generator.uniform(-np.pi, np.pi, zenith.shape))
    targets = []
    for sensor in _SENSORS:
        targets += _score_normals(truth, sensor, device, slack)
    return _case("accuracy-normals", f"normals of {draws} draws of equation 10 a bin of zenith", targets)


def _score_normals(truth: Doubles, sensor: Sensor, device: Device, slack: float) -> list[Target]:
    frames = expose(truth, sensor, 6)
    found = estimate_normals(frames, _PHASES, **sensor.known, device=device)
    across = np.linalg.norm(np.cross(found.normals.astype(np.float64), truth), axis=-1)
    square = np.arcsin(np.minimum(across, 1)) ** 2
    targets = []
    for bin_, mine, sigma, lost, least in zip(
        _BINS,
        square,
        found.normals_sigma.astype(np.float64),
        found.contact == 0,
        _bound(truth, sensor),
        strict=True,
    ):
        where = f"{sensor.kind}, zenith {bin_[0]} to {bin_[1]} degrees"
        ratio = float(np.sqrt(mine.mean() / least.mean()))
        targets.append(within(f"{where}: RMS error of the bound's", ratio, 1 - slack, 1 + slack))
        targets.append(within(f"{where}: chi-square", float(np.mean(mine / sigma**2)), 1 - slack, 1 + slack))
        targets.append(at_most(f"{where}: contact taken for lost", float(lost.mean()), 0.01))
    return targets


def _bound(normals: Doubles, sensor: Sensor) -> Doubles:
    """Return the minimum mean square error of an unbiased estimate, radians squared, (...).

    Each frame measures the angle to an axis: the information is (gain / sigma)^2 times the sum of u u', with
    u the tangent at the normal that points away from the axis. Its trace is N, and its determinant in the
    plane perpendicular to the normal follows from the trace of its square.
    """
    total = np.zeros((*normals.shape, 3))
    for axis in _axes():
        away = (normals @ axis)[..., np.newaxis] * normals - axis
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        total += away[..., :, np.newaxis] * away[..., np.newaxis, :]
    # One eigenvalue, along the normal, is 0; the others follow from trace and determinant.
    trace = np.trace(total, axis1=-2, axis2=-1)
    product = (trace**2 - np.trace(total @ total, axis1=-2, axis2=-1)) / 2
    return np.asarray(trace / product * (sensor.spread / sensor.gain) ** 2)


def _axes() -> Doubles:
    """Return the axis of the body at each phase, (STEPS, 3): it leans away from the phase."""
    return toward(np.full(STEPS, TILT), _PHASES + np.pi)


_PIXEL = 0.05  # mm
_RADIUS = 5.0  # radius of the ball, mm
_PRESS_STEP = 0.1  # travel per frame of the press, mm
_LIT = np.radians([11.8, 45.0])  # zeniths between which a pixel is light
_DEEP = np.radians(57.0)  # zenith up to which the sheet touches the ball
_SLOPE_NOISE = 0.02  # standard deviation of a slope


class Known(NamedTuple):
    """Heights, mm, and slopes along x and y, y up."""

    height: Doubles
    dz_dx: Doubles
    dz_dy: Doubles


def run_surfaces(device: Device, quick: bool) -> Case:
    """Compare heights from slopes of analytic surfaces with the truth: whole pictures, masks and noise."""
    shape = (45, 60) if quick else (600, 801)
    targets = []
    for name, (make, bound) in _SURFACES.items():
        known = make(*_grid(shape))
        for where, mask, slack in (("whole picture", None, 0.0), ("a ring", _ring(shape), 2e-5)):
            found = integrate(known.dz_dx, known.dz_dy, _PIXEL, mask=mask, sigma=False, device=device)
            off = _range_error(found, known)
            targets.append(at_most(f"{name}, {where}: RMS error, of the range", off, bound + slack))
    targets += _noisy(device, quick)
    title = f"heights of {shape[0]} x {shape[1]} slopes of analytic surfaces"
    return _case("accuracy-surfaces", title, targets)


def _plane(x: Doubles, y: Doubles) -> Known:
    return Known(0.3 * x - 0.2 * y, np.full_like(x, 0.3), np.full_like(x, -0.2))


def _cubic(x: Doubles, y: Doubles) -> Known:
    """Return a cubic polynomial, which the four-pixel formula integrates exactly."""
    u, v = x / np.ptp(x), y / np.ptp(x)
    height = np.ptp(x) * (0.3 * u**3 - 0.2 * u**2 + 0.4 * v**3 + 0.1 * u)
    return Known(height, 0.9 * u**2 - 0.4 * u + 0.1, 1.2 * v**2)


def _bump(x: Doubles, y: Doubles) -> Known:
    """Return a bump of a standard deviation of 3 pixels."""
    wide = 3 * _PIXEL
    height = wide * np.exp(-(x**2 + y**2) / (2 * wide**2))
    return Known(height, -x / wide**2 * height, -y / wide**2 * height)


def _waves(x: Doubles, y: Doubles) -> Known:
    """Return crossed waves with a wavelength of 40 pixels."""
    k = 2 * np.pi / (40 * _PIXEL)
    return Known(
        0.3 / k * np.sin(k * x) * np.cos(k * y),
        0.3 * np.cos(k * x) * np.cos(k * y),
        -0.3 * np.sin(k * x) * np.sin(k * y),
    )


_SURFACES: dict[str, tuple[Callable[[Doubles, Doubles], Known], float]] = {
    "plane": (_plane, 1e-6),
    "cubic": (_cubic, 3e-6),
    "bump of 3 pixels": (_bump, 3e-4),
    "waves of 40 pixels": (_waves, 1e-4),
}


def _noisy(device: Device, quick: bool) -> list[Target]:
    """Return the target that errors of heights from noisy slopes agree with sigma."""
    shape, draws = ((24, 30), 3) if quick else ((60, 80), 20)
    known = _waves(*_grid(shape))
    generator, square = np.random.default_rng(9), []
    for _ in range(draws):
        noise = generator.normal(0, _SLOPE_NOISE, (2, *shape))
        given = known.dz_dx + noise[0], known.dz_dy + noise[1]
        found = integrate(*given, _PIXEL, slope_weights=1 / _SLOPE_NOISE**2, device=device)
        error = found.height - known.height
        square.append(np.mean(((error - error.mean()) / found.height_sigma) ** 2))
    low, high = (0.5, 1.5) if quick else (0.75, 1.25)
    return [within("noisy slopes: chi-square", float(np.mean(square)), low, high)]


def run_fusion(device: Device, quick: bool) -> Case:
    """Compare a ball fused from a stepwise press and a noisy turn by equation 10 with the truth."""
    size = 101 if quick else 201
    x, y = _grid((size, size))
    x, y = 201 / size * x, 201 / size * y
    away = np.hypot(x, y)
    zenith = np.arcsin(np.minimum(away / _RADIUS, 0.999))
    there = zenith <= _DEEP
    truth = np.where(there, np.sqrt(np.maximum(_RADIUS**2 - away**2, 0)) - _RADIUS, np.nan)
    lit = (zenith >= _LIT[0]) & (zenith <= _LIT[1])
    middle = (np.floor(np.nan_to_num(truth) / _PRESS_STEP) + 0.5) * _PRESS_STEP
    height, sigma = (
        np.where(lit, values, np.nan).astype(np.float32) for values in (middle, _PRESS_STEP / np.sqrt(12))
    )
    press = Result(height=height, height_sigma=sigma)
    sensor = _SENSORS[1]
    normals = toward(np.where(there, zenith, 0.0), np.arctan2(y, x))
    frames = expose(normals, sensor, 10)
    turned = estimate_normals(frames, _PHASES, **sensor.known, device=device)
    turn = turned.assign(contact=(turned.contact * there).astype(np.uint8))
    found = fuse(press, turn, _PIXEL * 201 / size, mask=there, device=device)
    inner = zenith <= _LIT[1]
    error = (found.height - truth)[inner]
    top = (found.height - truth)[zenith <= np.radians(5)]
    answered = float(np.isfinite(error).mean())
    targets = [
        within("pixels with a height", answered, 1.0, 1.0),
        at_most("RMS error up to 45 degrees, mm", _rms(error), 0.003),
        at_most("RMS error of the apex, which stays dark in a press, mm", _rms(top), 0.003),
    ]
    return _case(
        "accuracy-fusion", f"a ball of 10 mm on {size} x {size} pixels, pressed in steps of 0.1 mm", targets
    )


def _grid(shape: tuple[int, int]) -> tuple[Doubles, Doubles]:
    """Return x and y of the pixels, mm, from the centre of the picture; y points up."""
    x = _PIXEL * (np.arange(shape[1]) - (shape[1] - 1) / 2)
    y = -_PIXEL * (np.arange(shape[0]) - (shape[0] - 1) / 2)
    wide, high = np.meshgrid(x, y)
    return wide, high


def _ring(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a mask with a hole, 1 inside."""
    x, y = _grid(shape)
    away = np.hypot(x, y) / (_PIXEL * min(shape) / 2)
    return ((away < 0.95) & (away > 0.02)).astype(np.uint8)


def _range_error(found: Result, known: Known) -> float:
    """Return the root mean square error about its mean, in ranges of the heights."""
    error = (found.height - known.height)[np.isfinite(found.height)]
    return float(np.std(error) / np.ptp(known.height[np.isfinite(found.height)]))


def _case(name: str, title: str, targets: list[Target]) -> Case:
    return Case(name, title, [], {}, (), tuple(targets))


CASES: Cases = {
    "accuracy-press": run_press,
    "accuracy-normals": run_normals,
    "accuracy-surfaces": run_surfaces,
    "accuracy-fusion": run_fusion,
}
