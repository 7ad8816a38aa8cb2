"""Growth of the contact with travel: lock-in detection of brightness in a dithering press."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import reference_pair
from mirrorskin.engine.base.functions import travel_function
from mirrorskin.engine.base.options import option
from mirrorskin.engine.correlation.correlation import Correlate, CorrelationOperation
from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.engine.press.crossing import PressOperation
from mirrorskin.engine.vibration.frequency import estimate_frequency
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.arguments import check_pixel_size
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.model.maps import TABLE
from mirrorskin.io.model.positions import check_strokes
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.io import Source

_SINUSOID = 0.9  # minimum share of the travel's variance in its first harmonic
_PERIODS = 2  # minimum number of periods of the dither


@dataclass(frozen=True, slots=True, eq=False)
class TravelWave:
    """The first harmonic of a travel: s = mean + amplitude cos(phase)."""

    phase: Doubles  # (T,), radians
    mean: float  # mm
    amplitude: float  # mm


class Growth(CorrelationOperation):
    """Growth of the contact with travel, from a press that dithers about a mean.

    At the mean travel s0, the share of full light of a pixel, (E - dark) / (bright - dark), has the
    derivative G with respect to travel. To first order in the dither's amplitude d, its component in phase
    with the travel is G d, which is fitted. If a pixel turns light abruptly within the dither, this component
    is not a derivative, but the sum over the border of the contact is (dA/ds) d for any shape of the border,
    with A the area of full light.

    ``azimuth`` is the phase lag of the light behind the travel. ``process`` contains the mean ``travel`` and
    the ``travel_amplitude``, mm, and with a pixel size ``area_growth``, the sum over all pixels, mm^2 of full
    light per mm of travel, and its standard deviation ``area_growth_sigma``.

    The frames are needed twice, unless the travel is available in advance.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> travel = 1 + 0.02 * np.cos(0.7 * np.arange(90))
    >>> frames = (100 + 300 * (travel - 1)[:, None, None] * np.ones((2, 3))).astype(np.float32)
    >>> result = engine.run(frames, engine.vibration.Growth(dark=0, bright=200), travel=travel)
    >>> round(result.process["travel_amplitude"], 3)
    0.02
    """

    motions = ("vertical",)
    usual_findings = ("no response",)  # it may be smaller than the noise of a frame

    dark: ArrayLike | None = PressOperation.dark
    bright: ArrayLike | None = PressOperation.bright
    pixel_size: tuple[float, float] | None = option(
        default=None,
        unit="mm",
        help="size of a pixel along x and y, mm, for the growth of the area",
        shown_default="that of the recording",
        python_only=True,
    )
    travel_wave: TravelWave | None = option(
        default=None,
        help="first harmonic of the travel, if it is available in advance",
        shown_default="estimated from the travel of all frames in a first pass",
        python_only=True,
    )

    mean, cosine, sine = Correlate.mean, Correlate.cosine, Correlate.sine
    modulation, azimuth, residual = Correlate.modulation, Correlate.azimuth, Correlate.residual
    growth = TABLE["growth"]
    growth_sigma = TABLE["growth"].deviation("growth")

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's levels, pixel size and travel, where none are given."""
        changes: dict[str, Any] = {
            name: getattr(source.header, name)
            for name in ("dark", "bright", "pixel_size")
            if getattr(self, name) is None
        }
        travel: Doubles | None = getattr(source, "travel", None)
        if self.travel_wave is None and travel is not None:
            changes["travel_wave"] = first_harmonic(travel, source.shape[0])
        return self.with_options(**changes)

    @property
    def passes(self) -> int:
        """Number of times that all frames are pushed: twice if the travel is not available in advance."""
        return 2 if self.travel_wave is None else 1

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        super().start(shape, dtype)
        self._pixel_size = None if self.pixel_size is None else check_pixel_size(self.pixel_size)
        if not isinstance(self.travel_wave, TravelWave | None):
            raise InputError(f"travel_wave is a {type(self.travel_wave).__name__}: a TravelWave is needed")
        self._levels = reference_pair(self.dark, self.bright, shape, dtype)
        self._wave = self.travel_wave

    def start_second_pass(self) -> None:
        """Estimate the first harmonic of the travel of all frames."""
        self._wave = first_harmonic(self.positions_so_far("travel"), self.count)

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Process the next frames, (n, H, W), and the travel of each, (n,) mm."""
        check_strokes(travel, len(frames), "travel")
        if self._wave is None:  # in the first pass
            return
        phase = self._wave.phase[self.count : self.count + len(frames)]
        if len(phase) < len(frames):
            raise InputError(f"there are more than the {len(self._wave.phase)} frames whose travel was known")
        self._push(frames, phase, np.ones(len(frames)))

    def result(self) -> Result:
        """Return the growth and the correlation with the travel's first harmonic."""
        assert self._wave is not None  # after the first pass
        fit, wave = self._fit(), self._wave
        dark, bright = self._levels
        per_count = 1 / ((bright - dark) * wave.amplitude)
        growth = fit.cosine * per_count
        sigma = fit.residual * math.sqrt(2 / self.count) * per_count
        process: dict[str, ProcessValue] = {"travel": wave.mean, "travel_amplitude": wave.amplitude}
        if self._pixel_size is not None:
            pixel = math.prod(self._pixel_size)
            process["area_growth"] = pixel * float(np.nansum(growth))
            process["area_growth_sigma"] = pixel * math.sqrt(float(np.nansum(sigma**2)))
        return fit.assign(
            growth=growth.astype(np.float32),
            growth_sigma=sigma.astype(np.float32),
            process={**fit.process, **process},
        )


find_growth = travel_function(
    Growth,
    "find_growth",
    """Compute the growth of the contact with travel, from a stack of a dithering press; see `Growth`.

    Returns
    -------
    Result
        ``growth``, 1/mm: share of full light that a pixel gains for each mm of travel, in phase with it; NaN
        where references or samples are missing. Also the correlation with the travel's phase.

    Raises
    ------
    mirrorskin.io.InputError
        Frames or references that cannot be used, or a travel that does not dither.

    Examples
    --------
    >>> import numpy as np
    >>> travel = 1 + 0.02 * np.cos(0.7 * np.arange(90))
    >>> frames = (100 + 300 * (travel - 1)[:, None, None] * np.ones((2, 3))).astype(np.float32)
    >>> round(float(find_growth(frames, travel, dark=0, bright=200).growth[0, 0]), 3)
    1.5
    """,
    "Millimetres; several periods of nearly a sinusoid.",
)


def first_harmonic(travel: ArrayLike | None, frames: int) -> TravelWave:
    """Return the first harmonic of a travel; InputError if it does not dither."""
    values = check_strokes(travel, frames, "travel")
    frame = np.arange(frames, dtype=np.float64)
    try:
        frequency = estimate_frequency(values, frame).hertz  # per frame
    except InputError as error:
        raise InputError(f"travel does not dither about a mean: {error}") from None
    phase = 2 * math.pi * frequency * frame
    mean, cosine, sine = np.linalg.lstsq(basis(phase), values, rcond=None)[0]
    sinusoidal = np.var(basis(phase) @ [0, cosine, sine]) >= _SINUSOID * np.var(values)
    if not sinusoidal or frequency * frames < _PERIODS:
        raise InputError("travel does not dither about a mean: several periods of one sinusoid are needed")
    return TravelWave(phase - math.atan2(sine, cosine), float(mean), math.hypot(cosine, sine))
