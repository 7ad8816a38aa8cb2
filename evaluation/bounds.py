"""Accuracy of a device: results compared with a known truth. All bounds must be met.

``python evaluation/bounds.py [--device NAME] [--quick] [-o RUN.json]`` prints the bounds that are missed, and
fails if there are any.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.cli.commands.bench.records import Case, Run, Target, describe_run
from mirrorskin.engine import (
    ChangePoint,
    Onset,
    estimate_normals,
    fuse,
    integrate,
)
from mirrorskin.evaluation.base.sources import run_unchecked
from mirrorskin.evaluation.base.tables import at_most, within
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.io import Header, Result
from mirrorskin.kernels.device import Device, open_device

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
    frames, options = _changes(kind, place, 0.0)
    travel = options.pop("travel")
    onset = run_unchecked(Onset(**options, noise=_press_noise(kind), device=device), frames, travel=travel)
    first = np.ceil(place)
    error = _frame_error(onset, place) * np.sqrt(12)
    sigma = float(np.mean(onset.height_sigma)) / _STEP * np.sqrt(12)
    return [
        at_most(f"{kind}, sudden: onsets in another frame", float(np.mean(onset.frame != first)), 0),
        within(f"{kind}, sudden: RMS error of 1/sqrt(12) frame", _rms(error), 1 - slack, 1 + slack),
        within(f"{kind}, sudden: sigma of 1/sqrt(12) frame", sigma, 0.999, 1.001),
    ]


def _ramps(kind: str, shape: tuple[int, int], device: Device, slack: float) -> list[Target]:
    """Return targets of ramps of 6 frames, and of the error relative to the best estimate's."""
    lasts = 6.0
    place = np.random.default_rng(2).uniform(2 + lasts, _FRAMES - 2 - lasts, shape)
    frames, options = _changes(kind, place, lasts)
    noise = _press_noise(kind)
    travel = options.pop("travel")  # not checked: pixels are unrelated, and show no surface
    onset = run_unchecked(Onset(**options, noise=noise, device=device), frames, travel=travel)
    change = run_unchecked(ChangePoint(**options, noise=noise, device=device), frames, travel=travel)
    fraction = np.ceil(place) - place  # share of the interval after the crossing
    span = _LEVELS[kind][1] - _LEVELS[kind][0]
    line = noise * lasts / span * np.sqrt(np.mean(fraction**2 + (1 - fraction) ** 2))
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
    light = np.clip((number - place) / lasts + 0.5, 0, 1) if lasts else (number >= place).astype(float)
    noise = np.random.default_rng(3).normal(0, _CHANGE_NOISE, light.shape)
    counts = dark + (bright - dark) * (light + noise)
    frames = counts.astype(kind) if kind == "float32" else np.rint(counts).astype(kind)
    return frames, {"travel": np.arange(_FRAMES) * _STEP, "dark": dark, "bright": bright}


def _press_noise(kind: str) -> float:
    """Return the standard deviation of a sample, including rounding, counts."""
    light = _CHANGE_NOISE * (_LEVELS[kind][1] - _LEVELS[kind][0])
    return light if kind == "float32" else float(np.hypot(light, 1 / np.sqrt(12)))


def _frame_error(result: Result, place: Doubles) -> Doubles:
    """Return the error of the height in frames; NaN if there is no height."""
    return np.asarray(-result.height.astype(np.float64) / _STEP - place)


def _chi_square(result: Result, error: Doubles) -> float:
    return float(np.mean((error * _STEP / result.height_sigma) ** 2))


def _rms(error: Doubles) -> float:
    return float(np.sqrt(np.mean(error**2)))


# Degrees. A normal inclined by the tilt is parallel to an axis of the body, where linear theory fails.
_BINS = (0, 1), (1, 2), (2.4, 2.6), (3, 5), (5, 10), (10, 20), (20, 35), (35, 50), (50, 58)
_DRAWS, _FEW_DRAWS = 10_000, 2_000


def run_normals(device: Device, quick: bool) -> Case:
    """Compare normals with the Cramer-Rao bound of equation 10 in bins of zenith, for each sample type."""
    draws = _FEW_DRAWS if quick else _DRAWS
    slack = 0.02 + 3 / np.sqrt(draws)
    targets = []
    for kind in ("uint8", "uint16", "float32"):
        stack = rotations.draw(rotations.SETUPS[kind], draws, seed=5, bins=_BINS)
        normals = _normals(stack.frames, stack.setup, device)
        scores = rotations.scores(normals.normals, normals.normals_sigma, stack)
        lost = np.mean(normals.contact == 0, axis=-1)
        for bin_, ratio, chi_square, missing in zip(
            _BINS, scores.ratio, scores.chi_square, lost, strict=True
        ):
            where = f"{kind}, zenith {bin_[0]} to {bin_[1]} degrees"
            targets.append(within(f"{where}: RMS error of the bound's", float(ratio), 1 - slack, 1 + slack))
            targets.append(within(f"{where}: chi-square", float(chi_square), 1 - slack, 1 + slack))
            targets.append(at_most(f"{where}: contact taken for lost", float(missing), 0.01))
    return _case("accuracy-normals", f"normals of {draws} draws of equation 10 a bin of zenith", targets)


def _normals(frames: NDArray[Any], setup: rotations.Setup, device: Device) -> Result:
    scale = {"zenith_gain": setup.slope, "zenith_offset": setup.offset, "noise": setup.spread}
    exact = {"blur": 0.0, "header": Header("axial", **rotations.EXACT)}  # neighbours are no neighbours
    options: dict[str, Any] = {"tilt": setup.tilt, **scale, **exact, "device": device}
    return estimate_normals(frames, np.array(setup.phase), **options)


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
        truth = make(*_grid(shape))
        for where, mask, slack in (("whole picture", None, 0.0), ("a ring", _ring(shape), 2e-5)):
            result = integrate(truth.dz_dx, truth.dz_dy, _PIXEL, mask=mask, sigma=False, device=device)
            off = _range_error(result, truth)
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
    truth = _waves(*_grid(shape))
    generator, square = np.random.default_rng(9), []
    for _ in range(draws):
        noise = generator.normal(0, _SLOPE_NOISE, (2, *shape))
        slopes = truth.dz_dx + noise[0], truth.dz_dy + noise[1]
        result = integrate(*slopes, _PIXEL, slope_weights=1 / _SLOPE_NOISE**2, device=device)
        error = result.height - truth.height
        square.append(np.mean(((error - error.mean()) / result.height_sigma) ** 2))
    low, high = (0.5, 1.5) if quick else (0.75, 1.25)
    return [within("noisy slopes: chi-square", float(np.mean(square)), low, high)]


def run_fusion(device: Device, quick: bool) -> Case:
    """Compare a ball fused from a stepwise press and a noisy turn by equation 10 with the truth."""
    size = 101 if quick else 201
    x, y = _grid((size, size))
    x, y = 201 / size * x, 201 / size * y
    away = np.hypot(x, y)
    zenith = np.arcsin(np.minimum(away / _RADIUS, 0.999))
    touched = zenith <= _DEEP
    truth = np.where(touched, np.sqrt(np.maximum(_RADIUS**2 - away**2, 0)) - _RADIUS, np.nan)
    lit = (zenith >= _LIT[0]) & (zenith <= _LIT[1])
    middle = (np.floor(np.nan_to_num(truth) / _PRESS_STEP) + 0.5) * _PRESS_STEP
    height, sigma = (
        np.where(lit, values, np.nan).astype(np.float32) for values in (middle, _PRESS_STEP / np.sqrt(12))
    )
    press = Result(height=height, height_sigma=sigma)
    setup = rotations.SETUPS["uint16"]
    frames = rotations.expose(
        rotations.direction(np.where(touched, zenith, 0.0), np.arctan2(y, x)), setup, 10
    )
    turned = _normals(frames, setup, device)
    turn = turned.assign(contact=(turned.contact * touched).astype(np.uint8))
    fused = fuse(press, turn, _PIXEL * 201 / size, mask=touched, device=device)
    inner = zenith <= _LIT[1]
    error = (fused.height - truth)[inner]
    top = (fused.height - truth)[zenith <= np.radians(5)]
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


def _range_error(result: Result, truth: Known) -> float:
    """Return the root mean square error about its mean, in ranges of the heights."""
    error = (result.height - truth.height)[np.isfinite(result.height)]
    return float(np.std(error) / np.ptp(truth.height[np.isfinite(result.height)]))


def _case(name: str, title: str, targets: list[Target]) -> Case:
    return Case(name, title, [], {}, (), tuple(targets))


Measurement = Callable[[Device, bool], Case]

CASES: dict[str, Measurement] = {
    "accuracy-press": run_press,
    "accuracy-normals": run_normals,
    "accuracy-surfaces": run_surfaces,
    "accuracy-fusion": run_fusion,
}


def measure(device: Device, quick: bool = False, more: Mapping[str, Measurement] | None = None) -> Run:
    """Run all cases, and some more."""
    cases = []
    for name, run in {**CASES, **(more or {})}.items():
        print(name, file=sys.stderr)
        cases.append(run(device, quick))
    return describe_run(device, cases, quick)


def missed(run: Run) -> list[str]:
    """Return the bounds that were missed, a line each."""
    return [
        f"{case.name}, {target.what}: {target.measured}, must be {target.bound}"
        for case in run.cases
        for target in case.targets
        if not target.met
    ]


def main() -> None:
    """Measure a device."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", metavar="NAME", help="a device that 'mirrorskin devices' lists")
    parser.add_argument("--quick", action="store_true", help="small inputs")
    parser.add_argument("-o", "--output", type=Path, metavar="RUN.json", help="file for all bounds")
    options = parser.parse_args()
    run = measure(open_device(options.device), options.quick)
    if options.output:
        options.output.write_bytes(run.as_json())
    if lines := missed(run):
        sys.exit("\n".join(["the device is not accurate:", *lines]))


if __name__ == "__main__":
    main()
