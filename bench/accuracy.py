"""How near a device's answers are to known truths: cases of targets, all of which must be met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Case, Cases, Target, at_most, within
from mirrorskin.bench.scenes import STEPS, TILT
from mirrorskin.engine import (
    Correlation,
    Correlator,
    Onset,
    Surface,
    correlate,
    estimate_normals,
    find_change_point,
    find_edges,
    find_onset,
    fuse,
    integrate,
)
from mirrorskin.hw.twin import Camera, Twin, Vertical
from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FRAMES = 40
_STEP = 0.05  # mm of travel a frame
_LEVELS = {"uint8": (20.0, 220.0), "uint16": (300.0, 3500.0), "float32": (20.0, 220.0)}
_CHANGE_NOISE = 0.01  # of the way from dark to light
_SHAPE, _SMALL = (240, 320), (48, 64)


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
    return _case("accuracy-press", title, targets)


def _sudden(kind: str, shape: tuple[int, int], device: Device, slack: float) -> list[Target]:
    """Return targets of changes from one frame to the next."""
    place = np.random.default_rng(1).uniform(2, _FRAMES - 2, shape)
    frames, known = _changes(kind, place, 0.0)
    found = find_onset(frames, **known, noise=_press_noise(kind), device=device)
    first = np.ceil(place)
    error = _frame_error(found, place) * np.sqrt(12)
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
    frames, known = _changes(kind, place, lasts)
    noise = _press_noise(kind)
    onset = find_onset(frames, **known, noise=noise, device=device)
    change = find_change_point(frames, **known, noise=noise, device=device)
    share = np.ceil(place) - place  # of the interval that lies behind the crossing
    span = _LEVELS[kind][1] - _LEVELS[kind][0]
    line = noise * lasts / span * np.sqrt(np.mean(share**2 + (1 - share) ** 2))
    best = noise * lasts / span / np.sqrt(lasts)  # Cramer and Rao: as many samples on the ramp, levels known
    error, other = _frame_error(onset, place), _frame_error(change, place)
    return [
        at_most(f"{kind}, ramps: RMS error of a straight line's", _rms(error) / line, 1.1 + slack),
        within(f"{kind}, ramps: chi-square", _chi_square(onset, error), 0.8, 1.15),
        at_most(f"{kind}, ramps: mean error in RMS errors", abs(float(error.mean())) / _rms(error), 0.15),
        at_most(f"{kind}, ramps: change-point, RMS error of the Cramer-Rao bound's", _rms(other) / best, 1.5),
        within(f"{kind}, ramps: change-point, chi-square", _chi_square(change, other), 0.6, 1.15),
    ]


def _changes(kind: str, place: Doubles, lasts: float) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return frames that cross half of the way at a place, (T, H, W), and travel, dark and bright."""
    dark, bright = _LEVELS[kind]
    number = np.arange(_FRAMES)[:, np.newaxis, np.newaxis]
    share = np.clip((number - place) / lasts + 0.5, 0, 1) if lasts else (number >= place).astype(float)
    noise = np.random.default_rng(3).normal(0, _CHANGE_NOISE, share.shape)
    counts = dark + (bright - dark) * (share + noise)
    frames = counts.astype(kind) if kind == "float32" else np.rint(counts).astype(kind)
    return frames, {"travel": np.arange(_FRAMES) * _STEP, "dark": dark, "bright": bright}


def _press_noise(kind: str) -> float:
    """Return the standard deviation of a sample, counts, with what rounding adds."""
    light = _CHANGE_NOISE * (_LEVELS[kind][1] - _LEVELS[kind][0])
    return light if kind == "float32" else float(np.hypot(light, 1 / np.sqrt(12)))


def _frame_error(found: Onset, place: Doubles) -> Doubles:
    """Return by how many frames the height is wrong; NaN without an answer."""
    return np.asarray(-found.height.astype(np.float64) / _STEP - place)


def _chi_square(found: Onset, error: Doubles) -> float:
    return float(np.mean((error * _STEP / found.sigma) ** 2))


def _rms(error: Doubles) -> float:
    return float(np.sqrt(np.mean(error**2)))


# Degrees; a normal at the tilt meets an axis of the body, where linear theory is at its limit.
_BINS = (0, 1), (1, 2), (2.4, 2.6), (3, 5), (5, 10), (10, 20), (20, 35), (35, 50), (50, 58)
_DRAWS, _FEW_DRAWS = 10_000, 2_000
_TURNS = 64  # of a stack of whole counts
_HELD = 1.2e-7  # of a number, that float32 holds
_ROUNDED = 5e-7  # of the largest count, where cosines are rounded to multiples of 2^-17: with uint8
_JUMP = 20.0  # degrees, of a roof
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
        """Standard deviation of a sample, with what rounding adds."""
        return self.noise if self.kind == "float32" else float(np.hypot(self.noise, 1 / np.sqrt(12)))

    @property
    def known(self) -> dict[str, Any]:
        """What the estimator is given."""
        return {"tilt": TILT, "gain": self.gain, "offset": self.offset, "noise": self.spread}


_SENSORS = (
    Sensor(12.0, 206.0, 1.0, "uint8"),
    Sensor(150.0, 3438.0, 20.0, "uint16"),
    Sensor(0.0, 286.0, 1.5, "float32"),
)


def expose(normals: Doubles, sensor: Sensor, seed: int) -> NDArray[Any]:
    """Return the frames, (STEPS, ...), that normals, (..., 3), make by equation 10, with noise."""
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
    """Hold normals against the Cramer-Rao bound of equation 10, zenith by zenith, in each type."""
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
    across = np.linalg.norm(np.cross(found.vectors.astype(np.float64), truth), axis=-1)
    square = np.arcsin(np.minimum(across, 1)) ** 2
    targets = []
    for bin_, mine, sigma, lost, least in zip(
        _BINS, square, found.sigma.astype(np.float64), found.contact == 0, _bound(truth, sensor), strict=True
    ):
        where = f"{sensor.kind}, zenith {bin_[0]} to {bin_[1]} degrees"
        ratio = float(np.sqrt(mine.mean() / least.mean()))
        targets.append(within(f"{where}: RMS error of the bound's", ratio, 1 - slack, 1 + slack))
        targets.append(within(f"{where}: chi-square", float(np.mean(mine / sigma**2)), 1 - slack, 1 + slack))
        targets.append(at_most(f"{where}: contact taken for lost", float(lost.mean()), 0.01))
    return targets


def _bound(normals: Doubles, sensor: Sensor) -> Doubles:
    """Return the least mean square error of an unbiased estimate, radians squared, (...).

    Each frame tells the angle from an axis: the information is (gain / sigma)^2 times the sum of u u', with u
    the tangent at the normal that points away from the axis. In the plane across the normal, its trace is N
    and its determinant follows from that of the sum of squares.
    """
    total = np.zeros((*normals.shape, 3))
    for axis in _axes():
        away = (normals @ axis)[..., np.newaxis] * normals - axis
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        total += away[..., :, np.newaxis] * away[..., np.newaxis, :]
    # u u' is nothing along the normal: of three eigenvalues one is 0, and two tell trace and determinant.
    trace = np.trace(total, axis1=-2, axis2=-1)
    product = (trace**2 - np.trace(total @ total, axis1=-2, axis2=-1)) / 2
    return np.asarray(trace / product * (sensor.spread / sensor.gain) ** 2)


def _axes() -> Doubles:
    """Return the body's axis at each phase, (STEPS, 3): it leans away from the phase."""
    return toward(np.full(STEPS, TILT), _PHASES + np.pi)


def run_correlation(device: Device, quick: bool) -> Case:
    """Hold waves against sums in fractions, and look for drift where a window moves on."""
    shape, turns = ((9, 13), 4) if quick else ((60, 80), _TURNS)
    targets = []
    for kind in ("uint8", "uint16", "float32"):
        frames = _whole_counts(kind, (turns * STEPS, *shape))
        phase = np.tile(_PHASES, turns)
        targets += _score_exact_waves(f"{kind}, a stack", correlate(frames, phase, device=device), frames)
        window = Correlator(shape, kind, window=STEPS, device=device)
        for number, frame in enumerate(frames):
            window.push(frame[np.newaxis], phase=phase[number : number + 1])
        moved, last = window.result(), frames[-STEPS:]
        targets += _score_exact_waves(f"{kind}, a window", moved, last)
        anew = correlate(last, _PHASES, device=device)
        drift = max(float(np.max(np.abs(a - b))) for a, b in zip(_parts(moved), _parts(anew), strict=True))
        what = f"{kind}, a window that moved on against a new one: apart, of the largest count"
        targets.append(at_most(what, drift / float(frames.max()), _HELD if kind == "float32" else 0.0))
    return _case("accuracy-correlation", f"waves of {turns} turns against exact sums", targets)


def _score_exact_waves(what: str, found: Correlation, frames: NDArray[Any]) -> list[Target]:
    """Return targets of what float32 holds of a wave, and of the residual, a root of a small difference."""
    apart = [np.max(np.abs(a - b)) for a, b in zip(_parts(found), _exact_waves(frames), strict=True)]
    near = _ROUNDED if frames.dtype == np.uint8 else _HELD
    wave, residual = (float(one) / float(frames.max()) for one in (max(apart[:3]), apart[3]))
    return [
        at_most(f"{what}: mean, cosine and sine, largest error of the largest count", wave, near),
        at_most(f"{what}: residual, largest error of the largest count", residual, 4 * _HELD),
    ]


def _whole_counts(kind: str, shape: tuple[int, int, int]) -> NDArray[Any]:
    """Return frames of any whole counts that the type holds, the extreme ones among them."""
    top = np.iinfo(kind).max if kind != "float32" else 4095
    frames = np.random.default_rng(7).integers(0, top, shape, endpoint=True).astype(kind)
    frames[:, 0, 0] = top
    return frames


def _exact_waves(frames: NDArray[Any]) -> Doubles:
    """Return mean, cosine, sine and residual of whole turns, (4, H, W), from sums of whole numbers."""
    count, samples = len(frames), frames.astype(np.int64)
    total, square = samples.sum(axis=0), (samples**2).sum(axis=0)
    # Samples of one phase are summed first, as whole numbers; eight products are left to round.
    eighths = samples.reshape(-1, STEPS, *samples.shape[1:]).sum(axis=0).astype(np.float64)
    cosine, sine = (2 / count * np.tensordot(wave(_PHASES), eighths, 1) for wave in (np.cos, np.sin))
    left = np.empty(total.shape)
    for place in np.ndindex(total.shape):
        exact = Fraction(int(square[place])) - Fraction(int(total[place]) ** 2, count)
        left[place] = float(exact) - count / 2 * (cosine[place] ** 2 + sine[place] ** 2)
    return np.stack([total / count, cosine, sine, np.sqrt(np.maximum(left, 0) / (count - 3))])


def _parts(wave: Correlation) -> tuple[NDArray[np.float32], ...]:
    return wave.mean, wave.cosine, wave.sine, wave.residual


def run_edges(device: Device, quick: bool) -> Case:
    """Hold the edges of a roof against its ridge, with noise and on a bend that is none."""
    rows, columns = (60, 80) if quick else (480, 640)
    ridge, noise = columns // 2, np.radians(1.0)
    column = np.arange(columns)
    lean = np.radians(np.where(column < ridge, 10.0, 10.0 - _JUMP) + 0.5 * np.sin(column / 15))
    zenith = np.broadcast_to(lean, (rows, columns))
    vectors = np.stack([np.sin(zenith), np.zeros(zenith.shape), np.cos(zenith)], -1)
    vectors += np.random.default_rng(8).normal(0, noise / np.sqrt(2), vectors.shape)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    sigma, touched = np.full(zenith.shape, noise, np.float32), np.ones(zenith.shape, np.uint8)
    drawn = find_edges(vectors.astype(np.float32), sigma, touched, device=device) != 0
    inner = drawn[8:-8]
    found = inner[:, ridge - 2 : ridge + 2].any(axis=1)
    elsewhere = np.abs(column - (ridge - 0.5)) > 3
    targets = [
        at_most("rows of the ridge without an edge", float(np.mean(~found)), 0.01),
        at_most("pixels elsewhere with an edge", float(inner[:, elsewhere].mean()), 1e-3),
        within("pixels across the ridge", float(inner[:, ~elsewhere].sum() / found.sum()), 0.99, 1.2),
    ]
    return _case("accuracy-edges", f"a ridge of {_JUMP:.0f} degrees, normals as noisy as 1 degree", targets)


_PIXEL = 0.05  # mm
_RADIUS = 5.0  # of the ball, mm
_PRESS_STEP = 0.1  # of the press, mm
_LIT = np.radians([11.8, 45.0])  # zenith of what turns light
_DEEP = np.radians(57.0)  # as far as the sheet lies on the ball
_SLOPE_NOISE = 0.02  # of a slope


class Known(NamedTuple):
    """Heights, mm, and slopes along x and y, y up."""

    height: Doubles
    dz_dx: Doubles
    dz_dy: Doubles


def run_surfaces(device: Device, quick: bool) -> Case:
    """Hold heights from exact slopes against the surfaces they are of: whole pictures, masks and noise."""
    shape = (45, 60) if quick else (600, 801)
    targets = []
    for name, (make, bound) in _SURFACES.items():
        known = make(*_grid(shape))
        whole = integrate(known.dz_dx, known.dz_dy, _PIXEL, sigma=False, device=device)
        targets.append(
            at_most(f"{name}, whole picture: RMS error, of the range", _range_error(whole, known), bound)
        )
        mask = _ring(shape)
        part = integrate(known.dz_dx, known.dz_dy, _PIXEL, mask=mask, sigma=False, device=device)
        targets.append(
            at_most(f"{name}, a ring: RMS error, of the range", _range_error(part, known), bound + 2e-5)
        )
    targets += _noisy(device, quick)
    return _case(
        "accuracy-surfaces", f"heights of {shape[0]} x {shape[1]} slopes of analytic surfaces", targets
    )


def _plane(x: Doubles, y: Doubles) -> Known:
    return Known(0.3 * x - 0.2 * y, np.full_like(x, 0.3), np.full_like(x, -0.2))


def _cubic(x: Doubles, y: Doubles) -> Known:
    """Return a polynomial of third degree, for which the rule of four pixels is exact."""
    u, v = x / np.ptp(x), y / np.ptp(x)
    height = np.ptp(x) * (0.3 * u**3 - 0.2 * u**2 + 0.4 * v**3 + 0.1 * u)
    return Known(height, 0.9 * u**2 - 0.4 * u + 0.1, 1.2 * v**2)


def _bump(x: Doubles, y: Doubles) -> Known:
    """Return a bump of a standard deviation of 3 pixels."""
    wide = 3 * _PIXEL
    height = wide * np.exp(-(x**2 + y**2) / (2 * wide**2))
    return Known(height, -x / wide**2 * height, -y / wide**2 * height)


def _waves(x: Doubles, y: Doubles) -> Known:
    """Return waves 40 pixels long, across each other."""
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
    """Return targets of noisy slopes: that sigma is what errors are."""
    shape, draws = ((24, 30), 3) if quick else ((60, 80), 20)
    known = _waves(*_grid(shape))
    generator, square = np.random.default_rng(9), []
    for _ in range(draws):
        noise = generator.normal(0, _SLOPE_NOISE, (2, *shape))
        given = known.dz_dx + noise[0], known.dz_dy + noise[1]
        found = integrate(*given, _PIXEL, slope_weights=1 / _SLOPE_NOISE**2, device=device)
        error = found.height - known.height
        square.append(np.mean(((error - error.mean()) / found.sigma) ** 2))
    return [
        within(
            "noisy slopes: chi-square", float(np.mean(square)), 0.5 if quick else 0.75, 1.5 if quick else 1.25
        )
    ]


def run_fusion(device: Device, quick: bool) -> Case:
    """Hold the fused surface of a ball against it: a press in steps, and a turn of equation 10 with noise."""
    size = 101 if quick else 201
    x, y = _grid((size, size))
    x, y = 201 / size * x, 201 / size * y
    away = np.hypot(x, y)
    zenith = np.arcsin(np.minimum(away / _RADIUS, 0.999))
    there = zenith <= _DEEP
    truth = np.where(there, np.sqrt(np.maximum(_RADIUS**2 - away**2, 0)) - _RADIUS, np.nan)
    lit = (zenith >= _LIT[0]) & (zenith <= _LIT[1])
    middle = (np.floor(np.nan_to_num(truth) / _PRESS_STEP) + 0.5) * _PRESS_STEP
    press = _Press(
        np.where(lit, middle, np.nan).astype(np.float32),
        np.where(lit, _PRESS_STEP / np.sqrt(12), np.nan).astype(np.float32),
    )
    sensor = _SENSORS[1]
    normals = toward(np.where(there, zenith, 0.0), np.arctan2(y, x))
    frames = expose(normals, sensor, 10)
    told = estimate_normals(frames, _PHASES, **sensor.known, device=device)
    turn = _Turn(told.vectors, told.sigma, (told.contact * there).astype(np.uint8))
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


class _Press(NamedTuple):
    height: NDArray[np.float32]
    sigma: NDArray[np.float32]


class _Turn(NamedTuple):
    vectors: NDArray[np.float32]
    sigma: NDArray[np.float32]
    contact: NDArray[np.uint8]


def _grid(shape: tuple[int, int]) -> tuple[Doubles, Doubles]:
    """Return x and y of the pixels, mm, from the picture's centre; y runs up."""
    x = _PIXEL * (np.arange(shape[1]) - (shape[1] - 1) / 2)
    y = -_PIXEL * (np.arange(shape[0]) - (shape[0] - 1) / 2)
    wide, high = np.meshgrid(x, y)
    return wide, high


def _ring(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a mask with a hole, 1 inside."""
    x, y = _grid(shape)
    away = np.hypot(x, y) / (_PIXEL * min(shape) / 2)
    return ((away < 0.95) & (away > 0.02)).astype(np.uint8)


def _range_error(found: Surface, known: Known) -> float:
    """Return the root mean square error about its mean, in ranges of the heights."""
    error = (found.height - known.height)[np.isfinite(found.height)]
    return float(np.std(error) / np.ptp(known.height[np.isfinite(found.height)]))


_READ_NOISE, _ELECTRONS = 2.0, 4.0  # standard deviation, counts; electrons of a count
_LIGHTS = 8  # of light, from dark to bright
_WAY = 12.0  # width of the picture, mm


def run_twin(device: Device, quick: bool) -> Case:
    """Hold the moments of a camera's noise against its numbers, from the dark to full light.

    Read noise is normal, shot noise Poisson's: in counts, light L above the dark has the variance r^2 + L / e
    and the third moment L / e^2, with e electrons a count.
    """
    shape, count = ((60, 80), 12) if quick else ((240, 320), 30)
    travel = np.linspace(0.05, 3.0, count)
    clean = _render(shape, travel, Camera(np.dtype(np.float32), noise=0.0), device)
    noisy = _render(
        shape, travel, Camera(np.dtype(np.float32), noise=_READ_NOISE, electrons=_ELECTRONS), device
    )
    whole = _render(shape, travel, Camera(noise=_READ_NOISE, electrons=_ELECTRONS), device)
    targets = []
    for number, part in enumerate(_cut(clean)):
        if np.count_nonzero(part) > 2000:
            targets += _moments(f"light {number + 1} of {_LIGHTS}", clean[part], noisy[part])
    rounded = np.rint(np.clip(noisy, 0, 255))
    targets.append(
        at_most("8 bits: counts that are not the rounded ones", float(np.mean(whole != rounded)), 1e-4)
    )
    return _case(
        "accuracy-twin", f"noise of {count} x {shape[0]} x {shape[1]} samples of the twin's camera", targets
    )


def _render(
    shape: tuple[int, int], travel: NDArray[np.float64], camera: Camera, device: Device
) -> NDArray[np.float64]:
    """Return the frames of a press on the sphere, as float64."""
    size = _WAY / shape[1]
    twin = Twin(
        object="sphere", movement=Vertical(travel), shape=shape, pixel_size=size, camera=camera, device=device
    )
    out = np.empty((len(travel), *shape), camera.dtype)
    twin.read(out)
    return out.astype(np.float64)


def _cut(clean: NDArray[np.float64]) -> list[NDArray[np.bool_]]:
    """Return where samples are of each level of light."""
    ends = np.linspace(clean.min(), clean.max(), _LIGHTS + 1)
    ends[-1] += 1
    return [(clean >= low) & (clean < high) for low, high in pairwise(ends)]


def _moments(where: str, clean: NDArray[np.float64], noisy: NDArray[np.float64]) -> list[Target]:
    """Return targets of the first three moments, each with the slack of four of its standard errors."""
    light, count = clean - Camera().dark, clean.size
    variance = _READ_NOISE**2 + np.maximum(light, 0) / _ELECTRONS
    z = (noisy - clean) / np.sqrt(variance)
    third = float(np.mean(np.maximum(light, 0) / _ELECTRONS**2 / variance**1.5))
    slack = 4 / np.sqrt(count)
    return [
        at_most(f"{where}: mean, in standard errors of it", abs(float(z.mean())) * np.sqrt(count), 4.5),
        within(f"{where}: variance of the expected one", float(z.var()), 1 - 1.6 * slack, 1 + 1.6 * slack),
        within(f"{where}: third moment", float(np.mean(z**3)), third - 4 * slack, third + 4 * slack),
    ]


def _case(name: str, title: str, targets: list[Target]) -> Case:
    return Case(name, title, [], {}, (), tuple(targets))


CASES: Cases = {
    "accuracy-press": run_press,
    "accuracy-normals": run_normals,
    "accuracy-correlation": run_correlation,
    "accuracy-edges": run_edges,
    "accuracy-surfaces": run_surfaces,
    "accuracy-fusion": run_fusion,
    "accuracy-twin": run_twin,
}
