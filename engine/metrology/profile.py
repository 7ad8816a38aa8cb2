"""Profile parameters of ISO 21920-2 along a section, with their standard uncertainties."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology.areal import shape_of
from mirrorskin.engine.metrology.filters import Gaussian
from mirrorskin.engine.metrology.parameters import PARAMETERS
from mirrorskin.engine.metrology.propagation import NOISE, NOISE_BIAS, add_noise
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_MICROMETRES = 1e3  # per mm
_MIN_SAMPLES = 8  # smallest number of samples of a profile
_DISCRIMINATION = 0.1  # share of Rz that a peak or a pit must exceed to be one


@dataclass(frozen=True, slots=True)
class _Profile:
    """The samples of a section that count, the filter, and the lengths over which Rz is averaged."""

    kept: Mask
    step: float  # mm
    long: Gaussian | None
    section_lengths: int

    @classmethod
    def of(cls, measured: Mask, step: float, l_filter: float | None) -> _Profile:
        """Prepare the filter; InputError if fewer than eight samples are left."""
        long = None if l_filter is None else Gaussian.of(measured, (step,), l_filter)
        kept = measured if long is None else long.covered
        if np.count_nonzero(kept) < _MIN_SAMPLES:
            raise InputError(f"a profile needs at least {_MIN_SAMPLES} measured samples")
        count = 1 if l_filter is None else max(int(np.count_nonzero(kept) * step / l_filter), 1)
        return cls(kept, step, long, count)

    def filtered(self, heights: Doubles) -> Doubles:
        """Return the profile with the mean 0, (n,); 0 where left out."""
        if self.long is not None:
            heights = heights - self.long.long_waves(heights)
        return np.where(self.kept, heights - np.mean(heights[self.kept]), 0.0)

    def evaluate(self, profile: Doubles) -> dict[str, float]:
        """Return the parameters of a filtered profile."""
        values = profile[self.kept]
        root = math.sqrt(float(np.mean(values**2)))
        skewness, kurtosis = shape_of(values, root)
        ranges = [float(np.ptp(part)) for part in np.array_split(values, self.section_lengths)]
        height = float(np.mean(ranges))
        parameters = {
            "a": _MICROMETRES * float(np.mean(np.abs(values))),
            "q": _MICROMETRES * root,
            "z": _MICROMETRES * height,
            "t": _MICROMETRES * float(np.ptp(values)),
            "sk": skewness,
            "ku": kurtosis,
            "Sm": self._spacing(profile, _DISCRIMINATION * height),
        }
        kind = "P" if self.long is None else "R"
        return {f"{kind}{name}": value for name, value in parameters.items()}

    def _spacing(self, profile: Doubles, min_rise: float) -> float:
        """Return the mean distance between rises through the mean line, mm; NaN with fewer than two.

        Peaks and pits that do not exceed ``min_rise`` do not count (crossing-the-line segmentation).
        """
        total, count = 0.0, 0
        breaks = np.flatnonzero(np.diff(self.kept.astype(np.int8)))
        for part in np.split(np.arange(profile.size), breaks + 1):
            if self.kept[part[0]]:
                rises = _rises(profile[part], min_rise)
                if rises.size > 1:
                    total += float(rises[-1] - rises[0])
                    count += rises.size - 1
        return self.step * total / count if count else math.nan


def _rises(values: Doubles, min_rise: float) -> Doubles:
    """Return where a profile rises through 0 from below ``-min_rise`` to above ``min_rise``, in samples."""
    clear = np.flatnonzero(np.abs(values) > min_rise)
    up = np.flatnonzero(np.diff(np.sign(values[clear])) > 0)
    rises = []
    for before, after in zip(clear[up], clear[up + 1], strict=True):
        crossing = before + np.flatnonzero(values[before:after] <= 0)[-1]
        low, high = values[crossing], values[crossing + 1]
        rises.append(crossing - low / (high - low))
    return np.array(rises)


def profile_parameters(
    heights: Doubles, step: float, *, l_filter: float | None = None, errors: Iterable[Doubles] = ()
) -> tuple[dict[str, Quantity], dict[str, dict[str, float]]]:
    """Return the parameters of ISO 21920-2 of a section, and the contributions to their uncertainties.

    Parameters
    ----------
    heights : ndarray, (n,)
        Distances from the form at equal steps along the section, mm; NaN where undefined.
    step : float
        Between samples, mm.
    l_filter : float, optional
        Nesting index of the Gaussian filter (ISO 16610-21) that separates roughness from longer waves, mm.
        With it, R-parameters are returned, of all section lengths that fit; without it, P-parameters of the
        primary profile.
    errors : iterable of ndarray, (n,)
        Realisations of the noise of the heights, mm. Without any, uncertainties are unknown.

    Raises
    ------
    InputError
        Fewer than eight samples are left.

    Examples
    --------
    >>> wave = 0.001 * np.sin(np.arange(100) * np.pi / 10 + 0.1)
    >>> found, _ = profile_parameters(wave, 0.05)
    >>> print(round(found["Pq"].value, 3), round(found["PSm"].value, 6))
    0.707 1.0
    """
    measured = np.isfinite(heights)
    profile = _Profile.of(measured, step, l_filter)
    texture = profile.filtered(heights)
    values = profile.evaluate(texture)
    drawn = [profile.filtered(np.where(measured, error, 0.0)) for error in errors]
    parameters, budget = {}, {}
    changes = None
    if drawn:
        root = next(name for name in values if name[1:] == "q")
        changes = add_noise(values, root, profile.evaluate, texture, profile.kept, drawn)
    for name, value in values.items():
        parts = {} if changes is None else {NOISE: changes.random[name], NOISE_BIAS: changes.bias[name]}
        spread = math.nan if changes is None else math.sqrt(sum(part**2 for part in parts.values()))
        parameters[name] = Quantity(value, spread, PARAMETERS[name].unit)
        budget[name] = parts
    return parameters, budget
