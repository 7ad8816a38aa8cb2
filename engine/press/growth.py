"""How fast contact grows: brightness locked in to the travel of a press that dithers about a mean."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import reference_pair
from mirrorskin.engine.rotation.correlation import Correlation, correlate
from mirrorskin.engine.rotation.design_matrix import Doubles, basis
from mirrorskin.engine.rotation.frequency import estimate_frequency
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.io.positions import check_strokes

_SINUSOID = 0.9  # share of the travel's variance that its first harmonic has at least

_PERIODS = 2  # of the dither, at least


class TravelWave(NamedTuple):
    """The first harmonic of a travel: s = mean + amplitude cos(phase)."""

    phase: Doubles  # (T,), radians, from 0 on
    mean: float  # mm
    amplitude: float  # mm


@dataclass(frozen=True, slots=True)
class Growth:
    """How the share of light grows with travel.

    Attributes
    ----------
    growth, sigma : ndarray, (H, W), float32
        1/mm: share of full light that a pixel gains for each mm of travel, in phase with it, and the standard
        deviation. NaN where references or samples are missing.
    lag : ndarray, (H, W), float32
        Radians by which the light comes after the travel.
    travel, amplitude : float
        Millimetres: mean and amplitude of the dither.
    area, area_sigma : float or None
        The sum over all pixels: mm^2 of full light for each mm of travel; None without a pixel size.
    """

    growth: NDArray[np.float32]
    sigma: NDArray[np.float32]
    lag: NDArray[np.float32]
    travel: float
    amplitude: float
    area: float | None = None
    area_sigma: float | None = None

    @classmethod
    def of(
        cls,
        wave: Correlation,
        travel: TravelWave,
        dark: ArrayLike | None,
        bright: ArrayLike | None,
        dtype: np.dtype[Any],
        pixel_size: tuple[float, float] | None,
    ) -> Growth:
        """Scale the fit of the travel's phases."""
        low, high = reference_pair(dark, bright, (wave.mean.shape[0], wave.mean.shape[1]), dtype)
        per_count = 1 / ((high - low) * travel.amplitude)
        growth = wave.cosine * per_count
        sigma = wave.residual * math.sqrt(2 / wave.frames) * per_count
        area = area_sigma = None
        if pixel_size is not None:
            pixel = math.prod(pixel_size)
            area = pixel * float(np.nansum(growth))
            area_sigma = pixel * math.sqrt(float(np.nansum(sigma**2)))
        return cls(
            growth.astype(np.float32),
            sigma.astype(np.float32),
            wave.azimuth,
            travel.mean,
            travel.amplitude,
            area,
            area_sigma,
        )


@checked
def find_growth(
    frames: NDArray[Any],
    travel: ArrayLike,
    *,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    pixel_size: tuple[float, float] | None = None,
    device: Any = None,
) -> Growth:
    """Find how fast contact grows with travel, from a stack of a dithering press.

    At the mean travel s0 the share of full light of a pixel, (E - dark) / (bright - dark), has the derivative
    G by travel. To first order of the dither's amplitude d its part in phase with the travel is G d: this is
    fitted. A pixel that turns light at once, at a travel in reach of the dither, has a part that is no
    derivative; but its sum over the border is (dA/ds) d as well, A being the area of full light, whichever
    shape the border has.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts.
    travel : array_like, (T,)
        Millimetres; several periods of nearly a sinusoid.
    dark, bright : array_like, scalar or (H, W), optional
        As for `mirrorskin.engine.find_onset`.
    pixel_size : (float, float), optional
        Millimetres, for the growth of the area.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Raises
    ------
    mirrorskin.io.InputError
        Frames or references that cannot be used, or a travel that is no dither.

    Examples
    --------
    >>> import numpy as np
    >>> travel = 1 + 0.02 * np.cos(0.7 * np.arange(90))
    >>> frames = (100 + 300 * (travel - 1)[:, None, None] * np.ones((2, 3))).astype(np.float32)
    >>> round(float(find_growth(frames, travel, dark=0, bright=200).growth[0, 0]), 3)
    1.5
    """
    if frames.ndim != 3:
        raise InputError(f"frames of shape {frames.shape}: (T, H, W) is needed")
    wave = travel_wave(travel, len(frames))
    fit = correlate(frames, wave.phase, device=device)
    return Growth.of(fit, wave, dark, bright, frames.dtype, pixel_size)


def travel_wave(travel: ArrayLike | None, frames: int) -> TravelWave:
    """Return the first harmonic of a travel; InputError if it is no dither."""
    values = check_strokes(travel, frames, "travel")
    frame = np.arange(frames, dtype=np.float64)
    try:
        each = estimate_frequency(values, frame).hertz
    except InputError as error:
        raise InputError(f"travel does not dither about a mean: {error}") from None
    turn = 2 * math.pi * each * frame
    mean, cosine, sine = np.linalg.lstsq(basis(turn), values, rcond=None)[0]
    amplitude = math.hypot(cosine, sine)
    alike = np.var(basis(turn) @ [0, cosine, sine]) >= _SINUSOID * np.var(values)
    if not alike or each * frames < _PERIODS:
        raise InputError("travel does not dither about a mean: several periods of one sinusoid are needed")
    return TravelWave(turn - math.atan2(sine, cosine), float(mean), amplitude)
