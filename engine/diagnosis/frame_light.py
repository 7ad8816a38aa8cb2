"""Flicker of the light and drift of the dark level in a rotation: a gain and an offset of each frame.

The zenith determines the mean of a pixel's brightness over a turn and, with the tilt, its amplitude. A change
of the light that is common to all pixels contradicts this at pixels that face different directions, so gains
and offsets of the frames are fitted together with the normals of a grid of pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.engine.diagnosis.residual_noise import valid
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma

_MIN_PIXELS, _MIN_FRAMES, _MAX_FRAMES = 64, 7, 128
_STEEP, _UPRIGHT = 1.5, math.radians(80)  # range of zeniths: minimum in tilts, and maximum
_SUSPECT_Z_SCORE = 4.0  # excess of the common variance over that of noise from which on light is fitted
_CLEAR_Z_SCORE = 5.0  # minimum of flicker or drift, standard errors
_FLICKER, _DRIFT = 0.005, 1.0  # minimum flicker, share of the light, and drift, counts of 8 bits
_PRIOR = 0.05, 0.02  # initial standard deviations of gains, and of offsets as a share of the light
_ITERATIONS = 6  # iterations
_FIXED_SIGMA = 1e-6  # standard deviation of gains and offsets that are not fitted
_MAX_MODULATION = 2.0  # maximum amplitude of the zenith of a usable pixel, in tilts
_MAX_GAIN_SIGMA = 0.2  # maximum standard deviation of gains
_MAX_MEAN_DIRECTION = 0.5  # above it pixels face one way, and do not determine the light
_MAX_DISAGREEMENT = 0.5  # between steep and other pixels, as a share of the light's change
_OUTLIER_RATIO = 3.0  # pixels with a larger misfit are excluded; times the usual misfit
_LEAST_NOISE = 1e-3  # counts


@dataclass(frozen=True, slots=True)
class FrameLight:
    """Gains and offsets of the frames of a rotation.

    Attributes
    ----------
    gain : ndarray, (T,), float64
        Light of each frame divided by the mean.
    offset : ndarray, (T,), float64
        Offset of each frame, counts.
    variance : (float, float)
        Coefficients a and b of the variance of normals due to errors of gains and offsets,
        a + b sin(zenith)^2, radians^2.
    flicker, drift : float
        Standard deviation of the light, and range of the smoothed offset, counts; 0 if not significant.
    """

    gain: Doubles
    offset: Doubles
    variance: tuple[float, float]
    flicker: float
    drift: float

    def remove(self, frames: NDArray[Any], first: int, dark: ArrayLike) -> NDArray[np.float32]:
        """Return frames, (n, H, W), from number ``first`` on, in steady light; NaN where clipped."""
        part = slice(first, first + len(frames))
        gain, offset = (values[part, np.newaxis, np.newaxis] for values in (self.gain, self.offset))
        low = np.asarray(dark, np.float64)
        steady = ((frames - offset - low) / gain + low).astype(np.float32)
        return np.where(valid(frames), steady, np.float32(np.nan))

    @property
    def process(self) -> dict[str, str]:
        """Entries of a result's process about the correction."""
        sizes = {"flicker": f"{100 * self.flicker:.2g} %", "drift": f"{self.drift:.2g} counts"}
        return {name: f"{sizes[name]}, corrected" for name in self.kinds}

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of findings that were corrected."""
        return tuple(name for name in ("flicker", "drift") if getattr(self, name) > 0)


def light_sigma(normals: NDArray[np.floating], variance: tuple[float, float]) -> NDArray[np.float32]:
    """Return the standard deviation of normals, (..., 3), because of the light; see `FrameLight.variance`."""
    base, rise = variance
    sine = 1 - normals[..., 2].astype(np.float64) ** 2
    return np.asarray(np.sqrt(np.maximum(base + rise * sine, 0)), np.float32)


def find_frame_light(
    samples: NDArray[Any],
    phase: Doubles,
    tilt: float,
    gain: ArrayLike,
    offset: ArrayLike,
    dark: ArrayLike,
) -> FrameLight | None:
    """Return the light of the frames; None if it is steady, or if the pixels do not show it.

    ``samples`` is (T, n); the zenith's ``gain``, counts/rad, ``offset`` and ``dark`` are numbers or (n,).
    """
    count = len(samples)
    if not _MIN_FRAMES <= count <= _MAX_FRAMES or count != len(phase):
        return None
    whole = valid(samples).all(axis=0)
    scale = [np.broadcast_to(np.asarray(values, np.float64), whole.shape) for values in (gain, offset, dark)]
    whole &= np.isfinite(scale).all(axis=0) & (scale[0] != 0)
    if np.count_nonzero(whole) < _MIN_PIXELS or not _is_suspect(samples[:, whole], phase):
        return None
    counts = samples[:, whole].astype(np.float64)
    per_angle, base, low = (values[whole] for values in scale)
    # Not by lstsq: the threads that it starts for many pixels wait for those of OpenCL.
    wave = np.linalg.pinv(basis(phase)) @ ((counts - base) / per_angle)
    modulation = np.hypot(wave[1], wave[2]) / tilt  # 1 if the response is as stated
    usable = (
        (wave[0] > _STEEP * tilt)
        & (wave[0] < _UPRIGHT)
        & (modulation > 1 / _MAX_MODULATION)
        & (modulation < _MAX_MODULATION)
    )
    facing = np.exp(1j * np.arctan2(wave[2], wave[1]))[usable]
    if np.count_nonzero(usable) < _MIN_PIXELS or abs(np.mean(facing)) > _MAX_MEAN_DIRECTION:
        return None
    if not _is_suspect(counts[:, usable], phase):  # level pixels are not cosines, and may lose contact
        return None
    steep = wave[0] > np.median(wave[0][usable])
    parts = [usable, usable & steep, usable & ~steep]
    chosen = [
        (counts[:, part], phase, tilt, per_angle[part], base[part], low[part], wave[:, part])
        for part in parts
    ]
    whole_fit = _fitted(*chosen[0])
    if whole_fit is None or not whole_fit.free.any():
        return None
    at_steep, at_level = (_fitted(*arguments, whole_fit.free) for arguments in chosen[1:])
    if at_steep is None or at_level is None:
        return None
    # A wrong response differs between zeniths; a change of the light does not.
    middle = float(np.median(counts[:, usable] - low[usable]))
    difference = np.std(at_steep.change(middle) - at_level.change(middle))
    return whole_fit.light() if difference < _MAX_DISAGREEMENT * np.std(whole_fit.change(middle)) else None


def _fitted(
    counts: Doubles, phase: Doubles, tilt: float, gain: Doubles, base: Doubles, dark: Doubles, wave: Doubles,
    free: NDArray[np.bool_] | None = None,
) -> _Fit | None:  # fmt: skip
    """Return the fit of free, or significant, errors to some pixels; None if too few follow it."""
    fit = _Fit(counts, phase, tilt, gain, base, dark, wave)
    if free is not None:
        fit.leave_out(~free)
    fit.keep(fit.misfit < _OUTLIER_RATIO * float(np.median(fit.misfit)))
    for _ in range(_ITERATIONS):
        fit.improve()
        fit.keep(fit.misfit < _OUTLIER_RATIO * float(np.median(fit.misfit)))
        if fit.pixels < _MIN_PIXELS // 3:
            return None
    while free is None and (steady := fit.free & ~fit.significant).any():
        fit.leave_out(steady)
        fit.improve()
        fit.improve()
    return fit


def _is_suspect(samples: NDArray[Any], phase: Doubles) -> bool:
    """Return whether pixels have a common change beyond noise, after a fit of two harmonics each."""
    columns = np.concatenate([basis(phase), basis(2 * phase)[:, 1:]], axis=1)
    if len(phase) <= columns.shape[1] + 1:
        return False
    waves = np.linalg.qr(columns)[0].astype(np.float32)
    counts = samples.astype(np.float32)
    fit = waves @ (waves.T @ counts)
    residual = counts - fit
    freedom = len(phase) - columns.shape[1]
    for common in (fit.mean(axis=0), np.ones(counts.shape[1], np.float32)):
        size = float(np.sum(common**2))
        if size == 0:
            continue
        each = residual @ common / size
        noise = max(mad_sigma((residual - np.outer(each, common)).astype(np.float64)), _LEAST_NOISE)
        usual = noise**2 * len(phase)  # residuals have less than the noise, by the degrees of freedom
        if float(np.sum(each**2)) * size > (1 + _SUSPECT_Z_SCORE * math.sqrt(2 / freedom)) * usual:
            return True
    return False


class _Fit:
    """Gauss-Newton fit of normals of pixels, and of a gain and an offset of each frame."""

    def __init__(
        self, counts: Doubles, phase: Doubles, tilt: float, gain: Doubles, base: Doubles, dark: Doubles,
        wave: Doubles,
    ) -> None:  # fmt: skip
        self._counts, self._phase, self._tilt = counts, phase[:, np.newaxis], tilt
        self._gain, self._base, self._dark = gain, base, dark
        self._zenith, self._azimuth = wave[0].copy(), np.arctan2(wave[2], wave[1])
        self.free: NDArray[np.bool_] = np.array([True, True])  # whether gains and offsets are fitted
        self._light = np.zeros((2, len(phase)))  # excess of the gain, offset
        self._prior = np.array([_PRIOR[0], _PRIOR[1] * float(np.median(counts))])
        self._look()

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return len(self._zenith)

    @property
    def misfit(self) -> Doubles:
        """RMS residual of each pixel, counts."""
        return np.asarray(np.sqrt(np.mean(self._left**2, axis=0)))

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Exclude the other pixels."""
        if chosen.all():
            return
        for name in ("_gain", "_base", "_dark", "_zenith", "_azimuth"):
            setattr(self, name, getattr(self, name)[chosen])
        self._counts = self._counts[:, chosen]
        self._look()

    def _look(self) -> None:
        """Compute the residuals, and the derivatives by normals (2, T, n) and by the light (2, T, n)."""
        sine, cosine = np.sin(self._zenith), np.cos(self._zenith)
        lean, upright = math.sin(self._tilt), math.cos(self._tilt)
        turned = self._azimuth - self._phase
        along = cosine * upright - sine * lean * np.cos(turned)
        angle = np.arccos(np.clip(along, -1, 1))
        down = np.maximum(np.sin(angle), 1e-9)
        by_zenith = (sine * upright + cosine * lean * np.cos(turned)) / down
        by_azimuth = -lean * np.sin(turned) / down  # for a rotation of the normal by an angle
        light = self._base + self._gain * angle - self._dark
        excess, offset = self._light[:, :, np.newaxis]
        rise = self._gain * (1 + excess)
        self._left = self._counts - self._dark - (1 + excess) * light - offset
        self._by_normal = np.stack([rise * by_zenith, rise * by_azimuth])
        self._by_light = np.stack([light, np.ones_like(light)])

    def _normal_equations(self) -> tuple[Doubles, Doubles, Doubles, float]:
        """Return the inverse of the normals' matrices, their products with the light's, and the light's."""
        freedom = self._left.size - 2 * self.pixels - self._light.size
        noise = max(float(np.sum(self._left**2)) / max(freedom, 1), _LEAST_NOISE**2)
        inverses = np.linalg.inv(np.einsum("ati,bti->iab", self._by_normal, self._by_normal))
        frames = self._light.shape[1]
        cross = np.einsum("ati,cti->iact", self._by_normal, self._by_light).reshape(-1, 2, 2 * frames)
        through = inverses @ cross
        both = np.einsum("cti,dti->cdt", self._by_light, self._by_light)
        matrix = np.zeros((2, frames, 2, frames))
        each = np.arange(frames)
        matrix[:, each, :, each] = np.moveaxis(both, 2, 0)
        matrix = matrix.reshape(2 * frames, 2 * frames) - np.einsum("iak,ial->kl", cross, through)
        matrix += np.diag(noise / np.repeat(self._prior**2, frames))
        return inverses, through, matrix, noise

    def improve(self) -> None:
        """Do one step, and update the standard deviations of gains and offsets."""
        inverses, through, matrix, noise = self._normal_equations()
        frames = self._light.shape[1]
        push = np.einsum("ati,ti->ia", self._by_normal, self._left)
        pull = np.einsum("cti,ti->ct", self._by_light, self._left).ravel()
        pull -= np.einsum("iak,ia->k", through, push)
        pull -= noise / np.repeat(self._prior**2, frames) * self._light.ravel()
        step = np.linalg.solve(matrix, pull)
        turn = np.einsum("iab,ib->ia", inverses, push) - through @ step
        self._light += step.reshape(2, frames)
        self._zenith += turn[:, 0]
        self._azimuth += turn[:, 1] / np.maximum(np.sin(self._zenith), 1e-3)
        self._light -= self._light.mean(axis=1, keepdims=True)
        spread = np.diag(np.linalg.inv(matrix)).reshape(2, frames) * noise
        self._prior = np.where(self.free, np.sqrt(np.mean(self._light**2 + spread, axis=1)), _FIXED_SIGMA)
        self._look()

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether flicker and drift are significant, (2,)."""
        *_, matrix, noise = self._normal_equations()
        frames = self._light.shape[1]
        variance = np.diag(np.linalg.inv(matrix)).reshape(2, frames) * noise
        chi2 = np.sum(self._light**2 / variance, axis=1)
        span = max(1.0, float(np.ptp(self._counts)) / 255)
        sizes = np.std(self._light[0]) / _FLICKER, _range(self._light[1]) / (_DRIFT * span)
        return np.asarray((chi2 > frames + _CLEAR_Z_SCORE * math.sqrt(2 * frames)) & (np.array(sizes) > 1))

    def leave_out(self, chosen: NDArray[np.bool_]) -> None:
        """Assume steady light for gains, offsets or both, (2,)."""
        self._light[chosen], self._prior[chosen] = 0.0, _FIXED_SIGMA
        self.free &= ~chosen
        self._look()

    def change(self, level: float) -> Doubles:
        """Return the excess of frames at a level of the light, counts, (T,)."""
        excess, offset = self._light
        return np.asarray(level * excess + offset)

    def light(self) -> FrameLight | None:
        """Return the light; None if it is steady."""
        free = self.free
        if not free.any() or np.std(self._light[0]) > _MAX_GAIN_SIGMA:
            return None
        _, through, matrix, noise = self._normal_equations()
        covariance = np.linalg.inv(matrix) * noise
        excess, offset = self._light * free[:, np.newaxis]
        error = np.einsum("iak,kl,ial->i", through, covariance, through)
        # The means of gains and offsets are assumed to be as in the calibration.
        light = self._by_light[0].mean(axis=0)
        mean = light**2 * np.var(excess) / len(excess) + (_range(offset) / 2) ** 2
        error += mean / self._gain**2
        sine = np.sin(self._zenith) ** 2
        rise, base = np.polyfit(sine, error, 1)
        return FrameLight(
            1 + excess, offset, (float(base), float(rise)), float(np.std(excess)), _range(offset)
        )


def _range(offset: Doubles) -> float:
    """Return the range of smoothed offsets."""
    parts = [float(np.mean(part)) for part in np.array_split(offset, 4)]
    return max(parts) - min(parts)
