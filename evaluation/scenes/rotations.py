"""Samples of an axial rotation (eq. 10), the lowest possible errors of a normal, and its actual errors.

It shares no code with mirrorskin. All is float64, from first principles, and written to be read: radians,
counts, unit vectors of three numbers, z towards the camera.

A sample is ``offset + gain * angle`` counts and noise, where the angle is that between the normal and the
axis of the body, which leans away from the phase. So each frame tells how far the normal is from a known
point of the sphere, and nothing of the direction: the task is to find a place by its distances from some
places on a small circle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfc

from mirrorskin.engine import Normals, Run
from mirrorskin.engine.base.operation import Plan
from mirrorskin.io import Result
from mirrorskin.io.base.types import PROPERTIES

Map = NDArray[np.float64]

EIGHTHS = tuple(float(step) for step in np.arange(8) * np.pi / 4)
# As measured on somebody's eight lights: 36 to 60 degrees apart.
UNEVEN = tuple(float(step) for step in np.radians([178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4]))
TILT = float(np.radians(2.5))

# Zenith from and to, degrees. Where a sample's axis is near the normal, linear theory is at its limit.
BINS = (
    *((0, 0), (0, 1), (1, 2), (2, 2.25), (2.25, 2.4), (2.4, 2.6), (2.5, 2.5), (2.6, 2.75), (2.75, 3)),
    *((3, 4), (4, 5), (5, 7.5), (7.5, 10), (10, 15), (15, 20), (20, 25), (25, 30), (30, 35), (35, 40)),
    *((40, 45), (45, 50), (50, 55), (55, 60)),
)


@dataclass(frozen=True, slots=True)
class Setup:
    """A sensor on its turn.

    ``gain`` is counts a degree, as people say it; ``noise`` counts, one sigma, before a sample is rounded;
    ``low`` and ``high`` the counts beyond which it is clipped, by default those of the type.
    """

    gain: float = 3.6
    noise: float = 1.0
    offset: float = 12.0
    dtype: str = "uint8"
    phase: tuple[float, ...] = EIGHTHS
    tilt: float = TILT
    low: ArrayLike | None = None
    high: ArrayLike | None = None

    @property
    def slope(self) -> float:
        """Counts a radian."""
        return float(np.degrees(self.gain))

    @property
    def spread(self) -> float:
        """Counts, one sigma of a sample, with what rounding adds."""
        return float(np.hypot(self.noise, 0.0 if self.dtype == "float32" else 1 / np.sqrt(12)))

    @property
    def range(self) -> tuple[ArrayLike, ArrayLike]:
        """The least and the greatest count."""
        ends = (-np.inf, np.inf) if self.dtype == "float32" else (0, np.iinfo(self.dtype).max)
        return ends[0] if self.low is None else self.low, ends[1] if self.high is None else self.high


class Stack(NamedTuple):
    """Frames, (N, bins, draws), and what they show."""

    frames: NDArray[np.generic]
    normals: Map  # (bins, draws, 3), unit
    setup: Setup
    bound: Map  # (bins, draws), radians^2: no unbiased estimate has a smaller mean square error


class Scores(NamedTuple):
    """Of each bin, (bins,)."""

    bound: Map  # RMS, radians
    rms: Map  # radians
    ratio: Map  # of the two
    chi_square: Map  # mean of (error / sigma)^2


# The lab's numbers: 8 bits, 3 to 6 counts a degree, noise 1 to 1.5 counts; and other cameras.
SETUPS = {
    "uint8": Setup(),
    "uint8, noisy": Setup(gain=3.0, noise=1.5, offset=12.0),
    "uint16": Setup(gain=60.0, noise=20.0, offset=150.0, dtype="uint16"),
    "float32": Setup(gain=5.0, noise=1.5, offset=0.0, dtype="float32"),
}


def direction(zenith: ArrayLike, azimuth: ArrayLike) -> Map:
    """Return unit vectors (..., 3)."""
    zenith, azimuth = np.broadcast_arrays(np.asarray(zenith, float), np.asarray(azimuth, float))
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def axes(phase: ArrayLike, tilt: float) -> Map:
    """Return where the body's axis points at each phase, (N, 3): it leans towards the phase + pi."""
    return direction(tilt, np.asarray(phase, float) + np.pi)


def between(first: Map, second: Map) -> Map:
    """Return the angle between vectors (..., 3) of any length; exact for small and large ones."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(first * second, axis=-1)))


def random_normals(draws: int, seed: int, bins: ArrayLike = BINS) -> Map:
    """Draw normals (bins, draws, 3): even in azimuth, and in zenith between the bin's ends."""
    generator = np.random.default_rng([seed, 7])
    ends = np.radians(np.asarray(bins, float))
    zenith = generator.uniform(ends[:, :1], ends[:, 1:], (len(ends), draws))
    return direction(zenith, generator.uniform(-np.pi, np.pi, zenith.shape))


def levels(normals: Map, setup: Setup) -> Map:
    """Return the counts without noise, not rounded, (N, ...)."""
    angle = np.stack([_from_axis(normals, axis) for axis in axes(setup.phase, setup.tilt)])
    return setup.offset + setup.slope * angle


def expose(normals: Map, setup: Setup, seed: int) -> NDArray[np.generic]:
    """Return frames (N, ...): noise, then rounding, then clipping."""
    clean = levels(normals, setup)
    counts = clean + np.random.default_rng([seed, 8]).normal(0, setup.noise, clean.shape)
    counts = counts if setup.dtype == "float32" else np.rint(counts)
    return np.clip(counts, *setup.range).astype(setup.dtype)


EXACT: dict[str, Any] = {name: 0.0 for name, prop in PROPERTIES.items() if prop.default is not None}
"""What a header states if nothing is uncertain."""


def estimate(
    frames: NDArray[np.generic], phase: ArrayLike, frame_weights: ArrayLike | None = None, **options: Any
) -> Result:
    """Return the normals of frames that show no surface, whose neighbours are no neighbours: unchecked."""
    run = Run(Plan(Normals(**{"blur": 0.0, **options}), checked=False))
    run.push(frames, phase=phase, frame_weights=frame_weights)
    return run.result()


def estimate_stack(stack: Stack, **options: Any) -> Result:
    """Return the normals of a stack, with the phases, scale and noise of its sensor."""
    setup = stack.setup
    scale = {"tilt": setup.tilt, "zenith_gain": setup.slope, "zenith_offset": setup.offset}
    return estimate(stack.frames, setup.phase, **scale, **{"noise": setup.spread, **options})


def draw(setup: Setup, draws: int, seed: int, bins: ArrayLike = BINS) -> Stack:
    """Return frames of random normals, and the bound of each."""
    normals = random_normals(draws, seed, bins)
    return Stack(expose(normals, setup, seed), normals, setup, bound(normals, setup))


def information(normals: Map, setup: Setup, weights: ArrayLike = 1.0) -> Map:
    """Return Fisher's information on a step in the tangent plane, radians^-2, (..., 2, 2).

    A step p changes the angle from axis a by ``u . p`` with u the unit vector at the normal that points away
    from a. So each sample adds ``(slope / spread)^2 u u^T``, times its weight: what clipping leaves of it.
    """
    right, up = tangents(normals)
    total = np.zeros((*normals.shape[:-1], 2, 2))
    fraction = np.broadcast_to(np.asarray(weights, float), (len(setup.phase), *normals.shape[:-1]))
    for axis, weight in zip(axes(setup.phase, setup.tilt), fraction, strict=True):
        along = np.stack([-(right @ axis), -(up @ axis)], axis=-1)
        away = along / np.linalg.norm(along, axis=-1, keepdims=True)
        total += weight[..., np.newaxis, np.newaxis] * away[..., :, np.newaxis] * away[..., np.newaxis, :]
    return total * (setup.slope / setup.spread) ** 2


def bound(normals: Map, setup: Setup, weights: ArrayLike = 1.0) -> Map:
    """Return the Cramer-Rao bound of the mean square angular error, radians^2, (...)."""
    inverse = np.linalg.inv(information(normals, setup, weights))
    return np.asarray(np.trace(inverse, axis1=-2, axis2=-1))


def clipped_share(normals: Map, setup: Setup) -> Map:
    """Return the share of its information that a sample keeps in spite of clipping, (N, ...).

    A normal variable clipped at z, in sigmas from its mean, tells ``1 - Q(z) - z phi(z)`` by its values this
    side of z and ``phi(z)^2 / Q(z)`` by being beyond; likewise below.
    """
    low, high = setup.range
    half = 0.0 if setup.dtype == "float32" else 0.5  # a count of the end stands for all that is rounded to it
    clean = levels(normals, setup)
    above = _tail(np.asarray((np.asarray(high, float) - half - clean) / setup.spread))
    below = _tail(np.asarray((clean - np.asarray(low, float) - half) / setup.spread))
    return np.asarray(1 - above - below)


def tangents(normals: Map) -> tuple[Map, Map]:
    """Return two unit vectors (..., 3), at right angles to each other and to the normals, which face up."""
    x, y, z = np.moveaxis(normals, -1, 0)
    factor = 1 / (1 + z)
    right = np.stack([1 - x * x * factor, -x * y * factor, -x], axis=-1)
    return right, np.stack([-x * y * factor, 1 - y * y * factor, -y], axis=-1)


def scores(vectors: NDArray[np.floating], sigma: NDArray[np.floating] | None, stack: Stack) -> Scores:
    """Score answers (bins, draws, 3) and their sigmas, radians; a missing answer makes its bin NaN."""
    square = between(np.asarray(vectors, float), stack.normals) ** 2
    best, rms = np.sqrt(stack.bound.mean(axis=-1)), np.sqrt(square.mean(axis=-1))
    stated = np.full_like(square, np.nan) if sigma is None else np.asarray(sigma, float)
    return Scores(best, rms, rms / best, np.mean(square / stated**2, axis=-1))


def mean_error(vectors: NDArray[np.floating], stack: Stack) -> Map:
    """Return the mean error in standard errors, (bins, 2): a sound estimate has less than 4 in magnitude.

    It is measured along and across the direction in which the normal leans, in coordinates in which an error
    of the azimuth, large far from the axis, does not look like one of the zenith: there zenith and azimuth,
    at less than twice the tilt those of the normal's shadow on the picture.
    """
    measured, true = np.asarray(vectors, float), stack.normals
    zenith, azimuth = angles(true)
    found_zenith, found_azimuth = angles(measured)
    turned = found_azimuth - azimuth
    turned = np.arctan2(np.sin(turned), np.cos(turned))
    steep = zenith > 2 * stack.setup.tilt
    shadow, sine = np.sin(found_zenith), np.sin(zenith)
    along = np.where(steep, found_zenith - zenith, shadow * np.cos(turned) - sine)
    across = np.where(steep, sine * turned, shadow * np.sin(turned))
    error = np.stack([along, across], axis=-1)
    spread = error.std(axis=1, ddof=1) / np.sqrt(error.shape[1])
    return np.asarray(error.mean(axis=1) / spread)


def angles(normals: Map) -> tuple[Map, Map]:
    """Return zenith and azimuth of vectors (..., 3)."""
    x, y, z = np.moveaxis(normals, -1, 0)
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)


class Paper(NamedTuple):
    """What eq. 16 to 22 of the paper make of a stack; maps, radians."""

    zenith: Map
    azimuth: Map
    modulation: Map


def paper(frames: NDArray[np.generic], setup: Setup) -> Paper:
    """Take the time average for the zenith, and the correlations with sine and cosine for the azimuth.

    By least squares, which for phases evenly round the circle are those sums.
    """
    phase = np.asarray(setup.phase)
    angle = (np.asarray(frames, float) - setup.offset) / setup.slope
    waves = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1)
    mean, cosine, sine = np.tensordot(np.linalg.pinv(waves), angle, axes=1)
    return Paper(mean, np.arctan2(sine, cosine), np.hypot(cosine, sine))


def tilt_bound(normals: Map, setup: Setup) -> float:
    """Return the Cramer-Rao bound of one tilt behind all samples, sigma in radians, all normals unknown too.

    By differences: what a change of the tilt does to the samples that no move of the normals could do.
    """
    step = 1e-5
    right, up = tangents(normals)
    changes = [
        (levels(normals + step * tangent, setup) - levels(normals - step * tangent, setup)) / (2 * step)
        for tangent in (right, up)
    ]
    wider, narrower = (replace(setup, tilt=setup.tilt + change) for change in (step, -step))
    tilting = (levels(normals, wider) - levels(normals, narrower)) / (2 * step)
    moves = np.moveaxis(np.stack(changes, axis=-1), 0, -2)  # (..., N, 2)
    tilting = np.moveaxis(tilting, 0, -1)[..., np.newaxis]
    explained = moves @ (np.linalg.pinv(moves) @ tilting)
    return float(setup.spread / np.sqrt(np.sum((tilting - explained) ** 2)))


def waves(shape: tuple[int, int], pixel: tuple[float, float]) -> Map:
    """Return the normals of a wavy surface, (H, W, 3), seen by pixels of a width and a height, mm."""
    rows, columns = shape
    x = (np.arange(columns) - (columns - 1) / 2) * pixel[0]
    y = ((rows - 1) / 2 - np.arange(rows)) * pixel[1]
    u, v = np.meshgrid(2 * np.pi * x / 1.6, 2 * np.pi * y / 1.9)
    slope = 0.8 * np.cos(u) * np.cos(v) + 0.1, -0.7 * np.sin(u) * np.sin(v)
    normal = np.stack([-slope[0], -slope[1], np.ones_like(u)], axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def _from_axis(normals: Map, axis: Map) -> Map:
    """Return the angle between unit vectors, by the sides of a rhombus: exact for small and large ones."""
    apart, together = (np.sqrt(np.sum((normals + sign * axis) ** 2, axis=-1)) for sign in (-1, 1))
    return np.asarray(2 * np.arctan2(apart, together))


def _tail(z: Map) -> Map:
    """Return the share of a sample's information that is lost where it is clipped beyond z sigmas."""
    z = np.clip(z, -30, 30)  # where all is clipped, or nothing
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    beyond = erfc(z / np.sqrt(2)) / 2
    return np.asarray(beyond + z * density - density**2 / beyond)
