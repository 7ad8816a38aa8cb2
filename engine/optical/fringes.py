"""Fringe patterns, projected or reflected: the phase of each pixel, and its unwrapping over the whole field.

The least-squares fit is that of a rotation: `mirrorskin.engine.correlation.correlation`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, ndtr

from mirrorskin.engine.base.frames import noise_of_residual, thinned
from mirrorskin.engine.base.functions import phase_function
from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.picture import PerPixel
from mirrorskin.engine.correlation.correlation import CorrelationOperation
from mirrorskin.engine.correlation.design_matrix import check_weights, fit_matrix
from mirrorskin.engine.diagnosis.amplitude_blur import add_blur
from mirrorskin.io import InputError, Map, Result
from mirrorskin.io.base.arguments import as_array, as_array_or_number, check_number, checked, in_unit
from mirrorskin.io.base.findings import carried
from mirrorskin.io.model.maps import TABLE
from mirrorskin.io.model.positions import check_phase
from mirrorskin.kernels.array_types import Doubles

_TURN = 2 * np.pi

_ORDER = Map("turns that were added to the wrapped phase", dtype="int32", overview=False)
_RISK = Map("probability that the order is wrong")
_UNWRAPPED = {"phase": Map("phase of the finest fringes over the whole field", "rad", "float64")}
_UNWRAPPED |= {"order": _ORDER, "risk": _RISK}
_STRIPES = {
    "stripe": Map("number of the stripe, from 0", dtype="int32"),
    "risk": Map("upper bound of the probability that the number is wrong by more than 1"),
    "border": Map("number of the stripe that begins at the pixel", dtype="int32", undefined=-1),
    "border_risk": Map("probability that the number is wrong by 1 where there is no border, or the reverse"),
}
_WHOLE_FIELD = 1 + 1e-6  # fringes over the field, up to which a phase is absolute; rounded
_LEAST_SIGMA = 1e-12  # radians
_ANSWERS = "phase", "phase_sigma", "mean", "modulation", "residual"
_MISFIT = 4.0  # standard deviations of noise: maximum residual of samples that follow a cosine of the shift
_NO_STRIPE = -2
_ISOLATED_RISK = 0.5  # of a number that no neighbours have
_UNCLEAR = 0.5  # distance of a bit from the threshold, RMS distances, below which the pixel is on a border


class Fringes(CorrelationOperation):
    """Phase of fringes, projected or reflected, that are shifted by known steps.

    E_k = mean + modulation cos(phase - shift_k) is fitted to each pixel by least squares, for three or more
    different shifts (Bruning et al. 1974, Greivenkamp 1984). The ``phase`` of a frame in ``push`` is the
    shift of its pattern towards larger phases.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> run = engine.Run(engine.optical.Fringes())
    >>> for shift in np.arange(4) * np.pi / 2:
    ...     run.push(np.full((1, 1, 2), 9 + np.cos(0.5 - shift), np.float32), phase=[shift])
    >>> run.result().phase.round(4).tolist()
    [[0.5, 0.5]]
    """

    least_frames = 3
    _more_maps = dict.fromkeys(("phase", "phase_sigma", "modulation"), np.float32)

    noise: ArrayLike | None = option(
        default=None,
        unit="counts",
        within=(0, None),
        help="standard deviation of a sample, a number or a map (H, W)",
        shown_default="estimated from the median residual of the half of the pixels that has more modulation,"
        " which needs four frames or more",
    )

    phase = Map("phase of the fringes, from -pi to pi", "rad", sampling="angle")
    mean = TABLE["mean"]
    modulation = TABLE["modulation"]
    residual = TABLE["residual"]

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare the fit."""
        super().start(shape, dtype)
        self._noise = None if self.noise is None else _map(self.noise, shape, "noise")
        self._weights: list[Doubles] = []

    def push(self, frames: NDArray[Any], *, phase: ArrayLike, frame_weights: ArrayLike | None = None) -> None:
        """Process the next frames, (n, H, W), the shift of the pattern in each, (n,) radians, and weights."""
        shift, weights = check_phase(phase, len(frames), "phase"), check_weights(frame_weights, len(frames))
        self._push(frames, shift, weights)
        self._weights.append(weights)

    def result(self) -> dict[str, Any]:
        """Return phase, mean and modulation of the frames so far."""
        sums, weights = self._frame_sums(), np.concatenate(self._weights)
        used, fit = sums.solve(), sums.maps
        freedom = np.count_nonzero(used) - 3
        residual_noise = math.nan  # noise estimated from the residuals of the half with more modulation
        if freedom > 0:
            parts = map(fit.view, ("cosine_part", "sine_part", "residual"))
            cosine, sine, residual = thinned(*parts)
            square = cosine * cosine + sine * sine
            residual_noise = noise_of_residual(
                residual[square >= np.median(square[np.isfinite(square)])], freedom
            )
        elif self._noise is None:
            raise InputError("3 frames leave no residual to estimate the noise from: specify noise, counts")
        noise = np.asarray(residual_noise if self._noise is None else self._noise, np.float32)
        matrix = fit_matrix(self.positions_so_far("phase")[used], weights[used])
        (cc, cs), (_, ss) = ((matrix @ (matrix / weights[used]).T)[1:, 1:]).tolist()
        # sin p = sine / modulation, likewise the cosine; without modulation there is no error bound. Samples
        # do not follow a cosine where the residual is too large, as at a hot pixel or a moving reflection.
        fit.run(
            "fringes_phase", source="fringes", noise=PerPixel(noise), noise_step=noise.ndim // 2,
            residual_noise=residual_noise, misfit=_MISFIT, cosine_variance=cc, covariance=cs,
            sine_variance=ss,
        )  # fmt: skip
        add_blur(fit, "phase_sigma", ["cosine_part", "sine_part"], "modulation")
        maps = dict(zip(_ANSWERS, fit.take(*_ANSWERS), strict=True))
        return maps if noise.ndim else maps | {"noise": float(noise)}


fit_fringes = phase_function(
    Fringes,
    "fit_fringes",
    """Fit phase, modulation and mean to frames of fringes that were shifted by known steps.

    Least squares of E_k = mean + modulation cos(phase - shift_k), for three or more different shifts (Bruning
    et al. 1974, Greivenkamp 1984). With C the covariance of cosine and sine for samples of variance 1, and p
    the phase, sigma = noise sqrt(C_cc sin^2 p - 2 C_cs sin p cos p + C_ss cos^2 p) / modulation. For N evenly
    spaced shifts that is noise sqrt(2 / N) / modulation.

    Returns
    -------
    Result
        ``phase`` and ``phase_sigma``, radians; ``mean``, ``modulation`` and ``residual``, counts. Pixels
        without modulation, or with a residual of more than four times the noise, have the phase NaN with an
        infinite standard deviation. ``process`` contains the ``noise``, counts, if it is one number.

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
    >>> fringes = engine.optical.fit_fringes(frames, shift, noise=2)
    >>> round(float(fringes.phase[0, 0]), 4), round(float(fringes.phase_sigma[0, 0]), 4)
    (0.5, 0.0283)
    """,
    "Shift of the pattern towards larger phases, radians; the negative of steps that are added.",
)


@checked(frequency=as_array_or_number, start=in_unit("rad", check_number))
def unwrap_frequencies(fringes: Sequence[Maps], frequency: ArrayLike, *, start: float = 0.0) -> Result:
    """Unwrap fringes of several frequencies, each from the next coarser one.

    The coarser phase, times the ratio of the frequencies, predicts the next one, which determines the order.
    With d the remaining difference and s its standard error, the order is right with the probability
    exp(-d^2 / (2 s^2)) over the sum of exp(-(d + 2 pi k)^2 / (2 s^2)) for all orders k. The probabilities
    that it is wrong are added over all steps.

    Parameters
    ----------
    fringes : sequence of Result, mapping, xarray.Dataset or path
        Maps ``phase`` and ``phase_sigma``, (H, W), radians, from coarse to fine fringes, as returned by
        `fit_fringes`. The phase may be wrapped to any interval.
    frequency : array_like, (F,)
        Numbers of fringes over the field, ascending; all phases are 0 at the same position. The coarsest
        pattern has at most one fringe: otherwise the absolute phase is not determined.
    start : float
        Radians: the smallest phase of the coarsest fringe; -pi if phases are 0 in the middle of the field.

    Returns
    -------
    Result
        ``phase``, radians, float64, of the finest fringes; NaN where a phase, its standard deviation or the
        order is unknown. ``phase_sigma`` is its standard deviation if the order is right; ``order`` the turns
        that were added to the wrapped phase; ``risk`` the probability that the order is wrong, and 1 where a
        phase is missing.

    Raises
    ------
    mirrorskin.io.InputError
        Arrays of other shapes; frequencies that are not positive and ascending; or a coarsest pattern of more
        than one fringe.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> wrapped = np.array([1.0, 8.0, 64.0])[:, None, None] % (2 * np.pi)
    >>> fringes = [{"phase": phase, "phase_sigma": [[0.05]]} for phase in wrapped]
    >>> engine.optical.unwrap_frequencies(fringes, [1, 8, 64]).phase.round(4).tolist()
    [[64.0]]
    """
    if not isinstance(fringes, Sequence) or isinstance(fringes, str):
        raise InputError(
            f"fringes are a {type(fringes).__name__}: a list of results, coarse to fine, is needed"
        )
    rate = np.asarray(frequency, np.float64)
    if rate.shape != (len(fringes),) or not len(rate):
        raise InputError(
            f"frequency has shape {rate.shape}: one is needed for each of {len(fringes)} fringes"
        )
    results = _results({f"fringes[{number}]": result for number, result in enumerate(fringes)}, "phase")
    pairs = [_phase_of(result, name) for name, result in results.items()]
    phases, sigmas = zip(*pairs, strict=True)
    if len({phase.shape for phase in phases}) > 1:
        shapes = " and ".join(str(phase.shape) for phase in phases)
        raise InputError(f"fringes have phases of shapes {shapes}: give maps of one size")
    if not (np.all(np.isfinite(rate)) and rate[0] > 0 and np.all(np.diff(rate) > 0)):
        raise InputError(f"frequencies {rate.tolist()}: positive ones from coarse to fine are needed")
    if rate[0] > _WHOLE_FIELD:
        raise InputError(
            f"frequencies {rate.tolist()}: the coarsest pattern has {rate[0]:g} fringes over the field, so"
            " the absolute phase is not determined. Add a pattern of one fringe, or use unwrap_gray"
        )
    whole = start + np.mod(phases[0] - start, _TURN)
    border = np.minimum(whole - start, start + _TURN - whole)  # distance to the field's ends
    spread = np.maximum(sigmas[0], _LEAST_SIGMA)
    risk = ndtr(-border / spread) + ndtr(-(_TURN - border) / spread)
    for finer, ratio in enumerate(rate[1:] / rate[:-1], 1):
        guess, whole = ratio * whole, _nearest(phases[finer], ratio * whole)
        risk += _wrong_order(guess - whole, np.hypot(sigmas[finer], ratio * sigmas[finer - 1]))
    return _unwrapped(phases[-1], whole, sigmas[-1], risk, results)


@checked(frames=as_array, threshold=as_array_or_number, noise=as_array_or_number)
def decode_gray(frames: NDArray[Any], threshold: ArrayLike, *, noise: ArrayLike) -> Result:
    """Read the number of a pixel's stripe from pictures of a reflected binary (Gray) code.

    With c the RMS distance from the threshold over the pictures, minus the noise, a bit at the distance d is
    wrong with probability 1 / (1 + exp(2 c d / noise^2)). A pixel whose number differs from those of all
    neighbours but one by more than 1, as because of a hot sample, is wrong with a probability of 0.5 or more.

    Parameters
    ----------
    frames : ndarray, (B, H, W), integers or floats
        Counts; the first picture has the broadest stripes. A stripe's number n is shown as n ^ (n >> 1).
    threshold : float or array_like, (H, W)
        Counts above which a bit is 1: the mean of white and black, or ``mean`` of `fit_fringes`.
    noise : float or array_like, (H, W)
        Standard deviation of a sample, counts, such as ``noise`` of `fit_fringes`.

    Returns
    -------
    Result
        ``stripe``, int32, from 0. ``risk`` is an upper bound of the probability that the number is wrong by
        more than 1, and 1 where a sample is not a number. On the border of two stripes one bit is uncertain,
        so either number may be returned: ``border`` is then the larger of the two, and -1 elsewhere.
        ``border_risk`` is the probability that noise creates or hides a border.

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
    >>> engine.optical.decode_gray(frames, 50, noise=2).stripe.tolist()
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
    risk, border_risk = np.zeros(shape), np.zeros(shape)
    border = np.full(shape, -1, np.int32)
    false_border = ndtr(-(1 - _UNCLEAR) * contrast / np.sqrt(variance))
    for bits_left, distance in zip(range(len(frames), 0, -1), np.abs(above), strict=True):
        other = stripe ^ (1 << bits_left) - 1  # if this bit is wrong, all later ones are
        far, wrong = np.abs(other - stripe) > 1, expit(-2 * contrast * distance / variance)
        unclear = ~far & (distance < _UNCLEAR * contrast)
        border = np.where(unclear, np.maximum(stripe, other), border)
        risk += wrong * far
        border_risk += (wrong * ~unclear + false_border) * ~far
    risk = np.where(_isolated(stripe), np.maximum(risk, _ISOLATED_RISK), risk)  # as of a hot sample
    return Result(
        stripe=stripe,
        risk=_probability(risk),
        border=border,
        border_risk=_probability(border_risk),
        declarations=_STRIPES,
    )


@checked(width=in_unit("rad", check_number), start=in_unit("rad", check_number))
def unwrap_gray(fringes: Maps, stripes: Maps, *, width: float = np.pi, start: float = 0.0) -> Result:
    """Unwrap fringes by the numbers of stripes that are as wide as a fringe, or narrower.

    The order is chosen such that the phase is nearest to the middle of the stripe. With stripes of half a
    fringe, an error of one in the number at the border of two stripes does not matter. With wider stripes,
    the order of a pixel on a border is chosen such that the phase is nearest to the border.

    Parameters
    ----------
    fringes : Result, mapping, xarray.Dataset or path
        Maps ``phase`` and ``phase_sigma``, (H, W), radians, as returned by `fit_fringes`.
    stripes : Result, mapping, xarray.Dataset or path
        Maps ``stripe`` and ``risk``, (H, W), as returned by `decode_gray`; for stripes wider than half a
        fringe also its ``border`` and ``border_risk``.
    width : float
        Width of a stripe, radians of phase, above 0 and at most 2 pi.
    start : float
        Phase at the start of stripe 0, radians.

    Returns
    -------
    Result
        The maps of `unwrap_frequencies`. The risk is the risk of the stripe plus the probability that the
        error of the phase leads to the adjacent order.

    Raises
    ------
    mirrorskin.io.InputError
        Arrays of other shapes, or another width.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> true = np.linspace(0.1, 25, 6)[None]
    >>> fringes = {"phase": true % (2 * np.pi), "phase_sigma": np.full(true.shape, 0.05)}
    >>> stripes = {"stripe": true // np.pi, "risk": 0 * true}
    >>> engine.optical.unwrap_gray(fringes, stripes).phase.round(2).tolist()
    [[0.1, 5.08, 10.06, 15.04, 20.02, 25.0]]

    Stripes as wide as a fringe, with a pixel on a border whose number is wrong:

    >>> true = np.array([[0.1, 6.3, 12.0]])
    >>> fringes = {"phase": true % (2 * np.pi), "phase_sigma": np.full(true.shape, 0.05)}
    >>> stripes = {"stripe": [[0, 0, 1]], "risk": 0 * true, "border": [[-1, 1, -1]], "border_risk": 0 * true}
    >>> engine.optical.unwrap_gray(fringes, stripes, width=2 * np.pi).phase.round(2).tolist()
    [[0.1, 6.3, 12.0]]
    """
    results = _results({"fringes": fringes}, "phase") | _results({"stripes": stripes}, "stripe")
    wrapped, errors = _phase_of(results["fringes"], "fringes")
    number, wrong = _maps_of(results["stripes"], "stripes", "stripe", "risk")
    if number.shape != wrapped.shape:
        raise InputError(f"stripes have shape {number.shape}, fringes {wrapped.shape}: give maps of one size")
    if not 0 < width <= _TURN * (1 + 1e-9):
        raise InputError(f"width {width}: stripes of at most a fringe, 2 pi, are needed")
    guess = start + (number + 0.5) * width
    if width > np.pi:
        border, border_risk = _maps_of(results["stripes"], "stripes", "border", "border_risk")
        guess = np.where(border < 0, guess, start + border * width)
        wrong = wrong + border_risk
    whole = _nearest(wrapped, guess)
    error = (np.pi - np.abs(whole - guess)) / np.maximum(errors, 1e-12)
    return _unwrapped(wrapped, whole, errors, wrong + ndtr(-error), results)


def _isolated(stripe: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return the pixels with five neighbours or more of which one at most has the number, within 1."""
    wide, (rows, columns) = np.pad(stripe, 1, constant_values=_NO_STRIPE), stripe.shape
    alike, known = np.zeros(stripe.shape, np.uint8), np.zeros(stripe.shape, np.uint8)
    for down, right in np.ndindex(3, 3):
        other = wide[down : down + rows, right : right + columns]
        alike += np.abs(other - stripe) <= 1
        known += other != _NO_STRIPE
    return (alike <= 2) & (known > 5)  # with itself


def _results(inputs: Mapping[str, Maps], quantity: str) -> dict[str, Result]:
    """Return inputs as results, by their names."""
    return {name: as_result(maps, name, quantity=quantity) for name, maps in inputs.items()}


def _phase_of(fringes: Result, name: str) -> tuple[Doubles, Doubles]:
    """Return a phase and its standard deviation, (H, W)."""
    return _maps_of(fringes, name, "phase", "phase_sigma")


def _maps_of(result: Result, name: str, *quantities: str) -> tuple[Doubles, Doubles]:
    """Return two maps of one size, (H, W), float64."""
    missing = [quantity for quantity in quantities if quantity not in result]
    if missing:
        raise InputError(
            f"{name} has no {' and no '.join(missing)}: maps {' and '.join(quantities)} are needed"
        )
    first, second = (np.asarray(result[quantity], np.float64) for quantity in quantities)
    if first.ndim != 2 or second.shape != first.shape:
        shapes = f"{quantities[0]} {first.shape} and {quantities[1]} {second.shape}"
        raise InputError(f"{name} has {shapes}: (H, W) of both is needed")
    return first, second


def _nearest(phase: Doubles, guess: Doubles) -> Doubles:
    """Return a phase plus the turns that bring it nearest to a prediction."""
    return np.asarray(phase + _TURN * np.rint((guess - phase) / _TURN))


def _wrong_order(difference: Doubles, sigma: Doubles) -> Doubles:
    """Return the probability that another order than the nearest is right, for differences within +- pi.

    The sum over all orders is that of five if sigma is less than 3, otherwise that of its Fourier series.
    """
    sigma = np.maximum(sigma, _LEAST_SIGMA)
    with np.errstate(over="ignore", invalid="ignore"):
        others = np.sum(
            [np.exp(-_TURN * k * (_TURN * k + 2 * difference) / 2 / sigma / sigma) for k in (-2, -1, 1, 2)],
            axis=0,
        )
        waves = sum(2 * np.exp(-((m * sigma) ** 2) / 2) * np.cos(m * difference) for m in (1, 2))
        nearest = np.exp(-((difference / sigma) ** 2) / 2) * np.sqrt(_TURN) / (sigma * (1 + waves))
        wrong: Doubles = np.where(sigma < 3, others / (1 + others), 1 - nearest)
    return np.where(np.isinf(sigma), 1.0, wrong)


def _unwrapped(
    wrapped: Doubles, whole: Doubles, sigma: Doubles, risk: Doubles, inputs: Mapping[str, Result]
) -> Result:
    """Return an unwrapped phase with its order and risk, and the findings of the inputs."""
    process = carried({}, **{name: result.process for name, result in inputs.items()})
    order = np.nan_to_num(np.rint((whole - wrapped) / _TURN)).astype(np.int32)
    with np.errstate(over="ignore"):
        error = sigma.astype(np.float32)
    valid = np.isfinite(whole) & np.isfinite(error)
    phase, error, wrong = (np.where(valid, values, np.nan) for values in (whole, error, risk))
    maps = {"phase": phase, "phase_sigma": error.astype(np.float32), "order": order}
    return Result(maps, risk=_probability(wrong), process=process, declarations=_UNWRAPPED)


def _probability(sum_of_risks: Doubles) -> NDArray[np.float32]:
    return np.nan_to_num(np.minimum(sum_of_risks, 1), nan=1).astype(np.float32)


def _map(values: ArrayLike, shape: tuple[int, ...], name: str) -> Doubles:
    """Return a number or a map of this shape as float64."""
    array = np.asarray(values, np.float64)
    if array.shape not in ((), shape) or (name == "noise" and np.any(array < 0)):
        wrong = "is below 0" if array.shape in ((), shape) else f"has shape {array.shape}"
        raise InputError(f"{name} {wrong}: counts are needed, one number or a map {shape}")
    return array
