"""Turns whose normals and waves are known: equation 10 with noise, and integers that a wave fits exactly."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.accuracy.aims import at_most, tell, within
from mirrorskin.bench.results import Case, Target
from mirrorskin.engine import Correlation, Correlator, correlate, estimate_normals, find_edges
from mirrorskin.kernels.device import Device

TILT = float(np.radians(2.5))
STEPS = 8

# Degrees; a normal at the tilt meets an axis of the body, where linear theory is at its limit.
_BINS = (0, 1), (1, 2), (2.4, 2.6), (3, 5), (5, 10), (10, 20), (20, 35), (35, 50), (50, 58)
_DRAWS, _FEW = 10_000, 2_000
_TURNS = 64  # of a stack of whole counts
_HELD = 1.2e-7  # of a number, that float32 holds
_ROUNDED = 5e-7  # of the largest count, where cosines are rounded to multiples of 2^-17: with uint8
_JUMP = 20.0  # degrees, of a roof

Doubles = NDArray[np.float64]


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


SENSORS = (
    Sensor(12.0, 206.0, 1.0, "uint8"),
    Sensor(150.0, 3438.0, 20.0, "uint16"),
    Sensor(0.0, 286.0, 1.5, "float32"),
)


def phases() -> Doubles:
    """Return the phases of one turn, radians."""
    return np.arange(STEPS, dtype=np.float64) * (2 * np.pi / STEPS)


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
    draws = _FEW if quick else _DRAWS
    slack = 0.02 + 3 / np.sqrt(draws)
    generator = np.random.default_rng(5)
    ends = np.radians(np.array(_BINS))
    zenith = generator.uniform(ends[:, :1], ends[:, 1:], (len(_BINS), draws))
    truth = toward(zenith, generator.uniform(-np.pi, np.pi, zenith.shape))
    targets = []
    for sensor in SENSORS:
        targets += _score_normals(truth, sensor, device, slack)
    return tell("accuracy-normals", f"normals of {draws} draws of equation 10 a bin of zenith", targets)


def _score_normals(truth: Doubles, sensor: Sensor, device: Device, slack: float) -> list[Target]:
    frames = expose(truth, sensor, 6)
    known = {"tilt": TILT, "gain": sensor.gain, "offset": sensor.offset, "noise": sensor.spread}
    found = estimate_normals(frames, phases(), **known, device=device)
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
    return toward(np.full(STEPS, TILT), phases() + np.pi)


def run_correlation(device: Device, quick: bool) -> Case:
    """Hold waves against sums in fractions, and look for drift where a window moves on."""
    shape, turns = ((9, 13), 4) if quick else ((60, 80), _TURNS)
    targets = []
    for kind in ("uint8", "uint16", "float32"):
        frames = _counts(kind, (turns * STEPS, *shape))
        phase = np.tile(phases(), turns)
        targets += _score_waves(f"{kind}, a stack", correlate(frames, phase, device=device), frames)
        window = Correlator(shape, kind, window=STEPS, device=device)
        for number, frame in enumerate(frames):
            window.push(frame[np.newaxis], phase=phase[number : number + 1])
        moved, last = window.result(), frames[-STEPS:]
        targets += _score_waves(f"{kind}, a window", moved, last)
        anew = correlate(last, phases(), device=device)
        drift = max(float(np.max(np.abs(a - b))) for a, b in zip(_parts(moved), _parts(anew), strict=True))
        what = f"{kind}, a window that moved on against a new one: apart, of the largest count"
        targets.append(at_most(what, drift / float(frames.max()), _HELD if kind == "float32" else 0.0))
    return tell("accuracy-correlation", f"waves of {turns} turns against exact sums", targets)


def _score_waves(what: str, found: Correlation, frames: NDArray[Any]) -> list[Target]:
    """Return targets of what float32 holds of a wave, and of the residual, a root of a small difference."""
    apart = [np.max(np.abs(a - b)) for a, b in zip(_parts(found), _waves(frames), strict=True)]
    near = _ROUNDED if frames.dtype == np.uint8 else _HELD
    wave, residual = (float(one) / float(frames.max()) for one in (max(apart[:3]), apart[3]))
    return [
        at_most(f"{what}: mean, cosine and sine, largest error of the largest count", wave, near),
        at_most(f"{what}: residual, largest error of the largest count", residual, 4 * _HELD),
    ]


def _counts(kind: str, shape: tuple[int, int, int]) -> NDArray[Any]:
    """Return frames of any whole counts that the type holds, the extreme ones among them."""
    top = np.iinfo(kind).max if kind != "float32" else 4095
    frames = np.random.default_rng(7).integers(0, top, shape, endpoint=True).astype(kind)
    frames[:, 0, 0] = top
    return frames


def _waves(frames: NDArray[Any]) -> Doubles:
    """Return mean, cosine, sine and residual of whole turns, (4, H, W), from sums of whole numbers."""
    count, samples = len(frames), frames.astype(np.int64)
    total, square = samples.sum(axis=0), (samples**2).sum(axis=0)
    # Samples of one phase are summed first, as whole numbers; eight products are left to round.
    eighths = samples.reshape(-1, STEPS, *samples.shape[1:]).sum(axis=0).astype(np.float64)
    cosine, sine = (2 / count * np.tensordot(wave(phases()), eighths, 1) for wave in (np.cos, np.sin))
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
    return tell("accuracy-edges", f"a ridge of {_JUMP:.0f} degrees, normals as noisy as 1 degree", targets)
