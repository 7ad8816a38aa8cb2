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
from mirrorskin.engine.metrology.propagation import EDGES, NOISE, NOISE_BIAS, add_noise, with_clean
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_MICROMETRES = 1e3  # per mm
_MIN_SAMPLES = 8  # smallest number of samples of a profile
_HALF = 0.4  # standard deviation of an element's length over twice that of its peak
INCOMPLETE = "no complete element"
"""Contribution to an uncertainty."""
_DISCRIMINATION = 0.1  # share of Rz that a peak or a pit must exceed to be one


@dataclass(frozen=True, slots=True)
class _Profile:
    """The samples of a section that count, the filters, and the lengths over which Rz is averaged."""

    kept: Mask
    step: float  # mm
    short: Gaussian | None
    long: Gaussian | None
    section_lengths: int

    @classmethod
    def of(cls, measured: Mask, step: float, s_filter: float | None, l_filter: float | None) -> _Profile:
        """Prepare the filters; InputError if fewer than eight samples are left."""
        kept, filters = measured, []
        for cutoff in (s_filter, l_filter):
            gaussian = None if cutoff is None else Gaussian.of(kept, (step,), cutoff)
            kept = kept if gaussian is None else gaussian.covered
            if gaussian is not None and np.count_nonzero(measured) >= _MIN_SAMPLES and not kept.any():
                raise InputError(
                    f"a cutoff of {cutoff:g} mm is too long for this section: choose a shorter one"
                )
            filters.append(gaussian)
        if np.count_nonzero(kept) < _MIN_SAMPLES:
            raise InputError(f"a profile needs at least {_MIN_SAMPLES} measured samples")
        count = 1 if l_filter is None else max(int(np.count_nonzero(kept) * step / l_filter), 1)
        return cls(kept, step, filters[0], filters[1], count)

    def filtered(self, heights: Doubles, *, level: bool = False) -> Doubles:
        """Return the profile with the mean 0, (n,); 0 where left out."""
        if self.short is not None:
            heights = self.short.long_waves(heights, level=level)
        if self.long is not None:
            heights = heights - self.long.long_waves(heights, level=level)
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
            "Sm": self.spacing(profile, _DISCRIMINATION * height)[0],
        }
        kind = "P" if self.long is None else "R"
        return {f"{kind}{name}": value for name, value in parameters.items()}

    def spacing(self, profile: Doubles, min_rise: float) -> tuple[float, bool]:
        """Return the mean length of the profile elements, mm, and whether one is complete.

        An element is a peak and the pit next to it, between two crossings of the mean line in the same
        direction; rises and falls count alike, so that the profile may begin with either. Peaks and pits that
        do not exceed ``min_rise`` do not count (crossing-the-line segmentation). If no element is complete,
        it is twice the length of the peak or pit that is; NaN if there is none.
        """
        total, count = 0.0, 0
        halves: list[float] = []
        breaks = np.flatnonzero(np.diff(self.kept.astype(np.int8)))
        for part in np.split(np.arange(profile.size), breaks + 1):
            if self.kept[part[0]]:
                both = [_rises(sign * profile[part], min_rise) for sign in (1, -1)]
                for crossings in both:
                    if crossings.size > 1:
                        total += float(crossings[-1] - crossings[0])
                        count += crossings.size - 1
                halves.extend(np.diff(np.sort(np.concatenate(both))))
        if count:
            return self.step * total / count, True
        return (2 * self.step * float(np.mean(halves)) if halves else math.nan), False


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
    heights: Doubles,
    step: float,
    *,
    s_filter: float | None = None,
    l_filter: float | None = None,
    errors: Iterable[Doubles] = (),
) -> tuple[dict[str, Quantity], dict[str, dict[str, float]]]:
    """Return the parameters of ISO 21920-2 of a section, and the contributions to their uncertainties.

    Parameters
    ----------
    heights : ndarray, (n,)
        Distances from the form at equal steps along the section, mm; NaN where undefined.
    step : float
        Between samples, mm.
    s_filter : float, optional
        Nesting index of the Gaussian filter (ISO 16610-21) that removes shorter waves, mm.
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
    profile = _Profile.of(measured, step, s_filter, l_filter)
    texture = profile.filtered(heights)
    values = profile.evaluate(texture)
    drawn = [profile.filtered(np.where(measured, error, 0.0)) for error in errors]
    parameters, budget = {}, {}
    changes = None
    if drawn:
        root = next(name for name in values if name[1:] == "q")
        changes = add_noise(values, root, profile.evaluate, texture, profile.kept, drawn)
    ends: dict[str, float] = {}
    if profile.short is not None or profile.long is not None:
        other = profile.evaluate(profile.filtered(heights, level=True))
        ends = {name: abs(other[name] - value) for name, value in values.items()}
    depth = next(value for name, value in values.items() if name[1:] == "z") / _MICROMETRES
    _, complete = profile.spacing(texture, _DISCRIMINATION * depth)
    for name, value in values.items():
        parts = {EDGES: ends[name]} if math.isfinite(ends.get(name, math.nan)) else {}
        if changes is not None:
            parts |= {NOISE: changes.random[name], NOISE_BIAS: changes.bias[name]}
        if name[1:] == "Sm" and not complete:
            parts[INCOMPLETE] = _HALF * value
        spread = math.nan if changes is None else math.sqrt(sum(part**2 for part in parts.values()))
        parameters[name] = Quantity(value, spread, PARAMETERS[name].unit)
        budget[name] = parts
    return parameters if changes is None else with_clean(parameters, budget, changes), budget
