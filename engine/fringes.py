"""Fringe patterns, projected or reflected: the phase of each pixel, and its unwrapping over the whole field.

The least-squares fit is that of a rotation: `mirrorskin.engine.rotation.correlation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy.special import expit, ndtr

from mirrorskin.engine.frames import noise_of_residual
from mirrorskin.engine.rotation.correlation import Correlation, Correlator, correlate
from mirrorskin.engine.rotation.design_matrix import Doubles, fit_matrix
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.io.result import Shown
from mirrorskin.kernels.device import Device

_TURN = 2 * np.pi


@dataclass(frozen=True, slots=True, repr=False)
class Fringes(Shown):
    """The fit E = mean + modulation cos(phase - shift) of each pixel; NaN where a sample was no number.

    Attributes
    ----------
    phase, sigma : ndarray, (H, W), float32
        Radians, -pi to pi, and the standard error; pixels without modulation have NaN and infinity.
    mean, modulation, residual : ndarray, (H, W), float32
        Counts, as in `Correlation`.
    noise : float or ndarray, (H, W)
        Counts: the standard deviation of a sample that ``sigma`` goes by.
    """

    phase: NDArray[np.float32]
    sigma: NDArray[np.float32]
    mean: NDArray[np.float32]
    modulation: NDArray[np.float32]
    residual: NDArray[np.float32]
    noise: float | NDArray[Any]


@dataclass(frozen=True, slots=True, repr=False)
class Unwrapped(Shown):
    """The phase counted on over the whole field.

    Attributes
    ----------
    phase : ndarray, (H, W), float64
        Radians, of the finest fringes; NaN where the phase, its standard error or the stripe is not known.
    sigma : ndarray, (H, W), float32
        Radians: its standard error if the order is right.
    order : ndarray, (H, W), int32
        Turns that were added to the wrapped phase; 0 where that is NaN.
    risk : ndarray, (H, W), float32
        Probability that the order is wrong, 0 to 1; 1 where a phase is missing.
    """

    phase: NDArray[np.float64]
    sigma: NDArray[np.float32]
    order: NDArray[np.int32]
    risk: NDArray[np.float32]

    def safe(self, risk: float = 1e-3) -> NDArray[np.bool_]:
        """Return where the risk is at most so large, (H, W)."""
        return self.risk <= risk


class FringeEstimator(ThreadSafe):
    """An `Estimator` for frames of shifted fringes that come block by block; see `fit_fringes`.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    noise, device
        As for `fit_fringes`.

    Examples
    --------
    >>> fringes = FringeEstimator((1, 2), "float32")
    >>> for shift in np.arange(4) * np.pi / 2:
    ...     fringes.push(np.full((1, 1, 2), 9 + np.cos(0.5 - shift), np.float32), phase=[shift])
    >>> fringes.result().phase.round(4).tolist()
    [[0.5, 0.5]]
    """

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        noise: ArrayLike | None = None,
        device: str | Device | None = None,
    ) -> None:
        self._correlator, self._noise = Correlator(shape, dtype, device=device), noise
        self._shift: Doubles = np.empty(0)

    def push(self, frames: NDArray[Any], *, phase: ArrayLike) -> None:
        """Take in the next frames, (n, H, W), and the shift of each, radians."""
        self._correlator.push(frames, phase=phase)
        self._shift = np.concatenate([self._shift, np.asarray(phase, np.float64)])

    def result(self) -> Fringes:
        """Return the phase of the frames so far."""
        return _fringes_of(self._correlator.result(), self._shift, self._noise)

    def reset(self) -> None:
        """Forget the frames so far."""
        self._correlator.reset()
        self._shift = np.empty(0)


@checked
def fit_fringes(
    frames: NDArray[Any],
    shift: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    device: str | Device | None = None,
) -> Fringes:
    """Fit phase, modulation and mean to frames of fringes that were shifted by known steps.

    Least squares of E_k = mean + modulation cos(phase - shift_k), for three or more different shifts (Bruning
    et al. 1974, Greivenkamp 1984). With C the covariance of cosine and sine for samples of variance 1, and p
    the phase, sigma = noise sqrt(C_cc sin^2 p - 2 C_cs sin p cos p + C_ss cos^2 p) / modulation. For N evenly
    spaced shifts that is noise sqrt(2 / N) / modulation.

    Parameters
    ----------
    frames : ndarray, (N, H, W), uint8, uint16 or float32
        Counts, linear in the light.
    shift : array_like, (N,)
        Radians by which the pattern was moved towards larger phases; the negative of steps that are added.
    noise : float or array_like, (H, W), optional
        Counts: standard deviation of a sample. By default from the median residual of the half of the pixels
        that has more modulation, which needs four frames or more.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Fringes

    Raises
    ------
    mirrorskin.io.InputError
        Frames, shifts or noise that cannot be used, or three frames and no noise.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> shift = np.arange(4) * np.pi / 2
    >>> frames = (100 + 50 * np.cos(0.5 - shift)[:, None, None] * np.ones((2, 3))).astype(np.float32)
    >>> fringes = engine.fit_fringes(frames, shift, noise=2)
    >>> round(float(fringes.phase[0, 0]), 4), round(float(fringes.sigma[0, 0]), 4)
    (0.5, 0.0283)
    """
    return _fringes_of(correlate(frames, shift, device=device), np.asarray(shift, np.float64), noise)


@checked
def unwrap_frequencies(
    phase: ArrayLike, sigma: ArrayLike, frequency: ArrayLike, *, start: float = 0.0
) -> Unwrapped:
    """Unwrap fringes of several frequencies, each with the help of the one before.

    The phase before, times the ratio of the frequencies, predicts the next, and the order is that which comes
    nearest. With d the difference that is left and s its standard error, the neighbouring order is the right
    one with probability 1 / (1 + exp(2 pi (pi - abs(d)) / s^2)); such risks of all steps are added.

    Parameters
    ----------
    phase, sigma : array_like, (F, H, W)
        Radians, wrapped in any way, and their standard errors: `Fringes` from coarse to fine.
    frequency : array_like, (F,)
        Fringes over the field, ascending; all phases are 0 at the same place. The coarsest has one turn at
        most.
    start : float
        Radians: the smallest phase of the coarsest fringe; -pi if phases are 0 in the middle of the field.

    Returns
    -------
    Unwrapped

    Raises
    ------
    mirrorskin.io.InputError
        Arrays of other shapes, or frequencies that are not positive and ascending.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> phase = np.array([1.0, 8.0, 64.0])[:, None, None] % (2 * np.pi)
    >>> engine.unwrap_frequencies(phase, np.full((3, 1, 1), 0.05), [1, 8, 64]).phase.round(4).tolist()
    [[64.0]]
    """
    phases, sigmas, rate = (np.asarray(one, np.float64) for one in (phase, sigma, frequency))
    if phases.ndim != 3 or sigmas.shape != phases.shape or rate.shape != phases.shape[:1] or not len(rate):
        shapes = f"phase {phases.shape}, sigma {sigmas.shape}, frequency {rate.shape}"
        raise InputError(f"{shapes}: (F, H, W), (F, H, W) and (F,) are needed")
    if not (np.all(np.isfinite(rate)) and rate[0] > 0 and np.all(np.diff(rate) > 0)):
        raise InputError(f"frequencies {rate.tolist()}: positive ones from coarse to fine are needed")
    whole = start + np.mod(phases[0] - start, _TURN)
    border = np.minimum(whole - start, start + _TURN - whole)  # beyond it, the field's other end
    risk = ndtr(-border / np.maximum(sigmas[0], 1e-12))
    for finer, ratio in enumerate(rate[1:] / rate[:-1], 1):
        guess, whole = ratio * whole, _nearest(phases[finer], ratio * whole)
        variance = np.maximum(sigmas[finer] ** 2 + (ratio * sigmas[finer - 1]) ** 2, 1e-24)
        risk += expit(-_TURN * (np.pi - np.abs(guess - whole)) / variance)
    return _unwrapped(phases[-1], whole, sigmas[-1], risk)


@checked
def decode_gray(
    frames: NDArray[Any], threshold: ArrayLike, *, noise: ArrayLike
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Read the number of a pixel's stripe from pictures of a reflected binary (Gray) code.

    With c the RMS distance from the threshold over the pictures, less the noise, a bit at the distance d is
    wrong with probability 1 / (1 + exp(2 c d / noise^2)).

    Parameters
    ----------
    frames : ndarray, (B, H, W), integers or floats
        Counts; the first picture has the broadest stripes. A stripe's number n is shown as n ^ (n >> 1).
    threshold : float or array_like, (H, W)
        Counts above which a bit is 1: half of white and black, or the mean of `fit_fringes`.
    noise : float or array_like, (H, W)
        Counts: standard deviation of a sample, such as that of `fit_fringes`.

    Returns
    -------
    stripe : ndarray, (H, W), int32
        From 0 on.
    risk : ndarray, (H, W), float32
        Probability that the number is off by more than one, at most; 1 where a sample is no number.
        On the border of two stripes one bit is uncertain, and takes one for the other: no harm to
        `unwrap_gray`.

    Raises
    ------
    mirrorskin.io.InputError
        No frames, or more than 30, or threshold or noise of another shape.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> stripe = np.arange(8)[None]
    >>> frames = np.stack([(stripe ^ stripe >> 1) >> bit & 1 for bit in (2, 1, 0)]) * 100
    >>> engine.decode_gray(frames, 50, noise=2)[0].tolist()
    [[0, 1, 2, 3, 4, 5, 6, 7]]
    """
    if frames.ndim != 3 or not 0 < len(frames) <= 30:
        raise InputError(f"frames have shape {frames.shape}: 1 to 30 pictures (B, H, W) are needed")
    shape = frames.shape[1:]
    level, spread = _map(threshold, shape, "threshold"), _map(noise, shape, "noise")
    above = frames - level
    stripe = np.zeros(shape, np.int32)
    for bit in above > 0:
        stripe = 2 * stripe + (bit ^ stripe & 1)
    variance = np.maximum(spread**2, 1e-24)
    contrast = np.sqrt(np.maximum(np.mean(above**2, axis=0) - variance, 0))
    risk = np.zeros(shape)
    for left, distance in zip(range(len(frames), 0, -1), np.abs(above), strict=True):
        other = stripe ^ (1 << left) - 1  # if this bit is wrong, so are all after it
        risk += expit(-2 * contrast * distance / variance) * (np.abs(other - stripe) > 1)
    return stripe, _probability(risk)


@checked
def unwrap_gray(
    phase: ArrayLike,
    sigma: ArrayLike,
    stripe: ArrayLike,
    risk: ArrayLike,
    *,
    width: float = np.pi,
    start: float = 0.0,
) -> Unwrapped:
    """Unwrap fringes by the numbers of stripes that are narrower than a fringe.

    The order is that by which the phase comes nearest to the middle of the stripe. With stripes of half a
    fringe, a number that is off by one on the border of two stripes does no harm.

    Parameters
    ----------
    phase, sigma : array_like, (H, W)
        Radians: those of `Fringes`.
    stripe, risk : array_like, (H, W)
        Those of `decode_gray`.
    width : float
        Radians of phase that a stripe is wide, above 0 and at most pi.
    start : float
        Radians: the phase where stripe 0 begins.

    Returns
    -------
    Unwrapped
        Its risk is that of the stripe and that of a phase whose error leads to the next order.

    Raises
    ------
    mirrorskin.io.InputError
        Arrays of other shapes, or another width.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> true = np.linspace(0.1, 25, 6)[None]
    >>> stripe, sigma = true // np.pi, np.full(true.shape, 0.05)
    >>> engine.unwrap_gray(true % (2 * np.pi), sigma, stripe, 0 * true).phase.round(2).tolist()
    [[0.1, 5.08, 10.06, 15.04, 20.02, 25.0]]
    """
    wrapped, errors, number, wrong = (np.asarray(one, np.float64) for one in (phase, sigma, stripe, risk))
    if wrapped.ndim != 2 or {errors.shape, number.shape, wrong.shape} != {wrapped.shape}:
        shapes = ", ".join(str(one.shape) for one in (wrapped, errors, number, wrong))
        raise InputError(f"phase, sigma, stripe and risk have shapes {shapes}: (H, W) of each is needed")
    if not 0 < width <= np.pi:
        raise InputError(f"width {width}: stripes of at most half a fringe, pi, are needed")
    middle = start + (number + 0.5) * width
    whole = _nearest(wrapped, middle)
    error = (np.pi - np.abs(whole - middle)) / np.maximum(errors, 1e-12)
    return _unwrapped(wrapped, whole, errors, wrong + ndtr(-error))


def _fringes_of(fit: Correlation, shift: Doubles, noise: ArrayLike | None) -> Fringes:
    """Return phases and their standard errors of a fit."""
    if noise is None:
        if fit.frames < 4:
            raise InputError("3 frames leave no residual to tell the noise from: give noise, in counts")
        strong = fit.modulation >= np.nanmedian(fit.modulation)
        counts = np.asarray(noise_of_residual(fit.residual[strong], fit.frames - 3))
    else:
        counts = _map(noise, fit.mean.shape, "noise")
    matrix, phase = fit_matrix(shift), fit.azimuth
    (cc, cs), (_, ss) = (matrix @ matrix.T)[1:, 1:]
    cosine, sine = np.cos(phase, dtype=np.float64), np.sin(phase, dtype=np.float64)
    spread = counts * np.sqrt(cc * sine**2 - 2 * cs * sine * cosine + ss * cosine**2)
    still = fit.modulation == 0
    sigma = np.where(still, np.inf, spread / np.where(still, 1, fit.modulation)).astype(np.float32)
    kept = counts if counts.ndim else float(counts)
    return Fringes(phase, sigma, fit.mean, fit.modulation, fit.residual, kept)


def _nearest(phase: Doubles, guess: Doubles) -> Doubles:
    """Return a phase plus the turns that bring it nearest to a guess."""
    return np.asarray(phase + _TURN * np.rint((guess - phase) / _TURN))


def _unwrapped(wrapped: Doubles, whole: Doubles, sigma: Doubles, risk: Doubles) -> Unwrapped:
    order = np.nan_to_num(np.rint((whole - wrapped) / _TURN)).astype(np.int32)
    with np.errstate(over="ignore"):
        error = sigma.astype(np.float32)
    known = np.isfinite(whole) & np.isfinite(error)
    phase, error, wrong = (np.where(known, one, np.nan) for one in (whole, error, risk))
    return Unwrapped(phase, error.astype(np.float32), order, _probability(wrong))


def _probability(sum_of_risks: Doubles) -> NDArray[np.float32]:
    return np.nan_to_num(np.minimum(sum_of_risks, 1), nan=1).astype(np.float32)


def _map(values: ArrayLike, shape: tuple[int, ...], name: str) -> Doubles:
    """Return a number or a map of this shape as float64."""
    found = np.asarray(values, np.float64)
    if found.shape not in ((), shape) or (name == "noise" and np.any(found < 0)):
        wrong = "is below 0" if found.shape in ((), shape) else f"has shape {found.shape}"
        raise InputError(f"{name} {wrong}: counts are needed, one number or a map {shape}")
    return found
