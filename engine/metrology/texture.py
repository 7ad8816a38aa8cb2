"""Texture of a surface: the areal parameters of ISO 25178-2 with their standard uncertainties."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.metrology import areal
from mirrorskin.engine.metrology.filters import Gaussian
from mirrorskin.engine.metrology.fitting import find_uncertain
from mirrorskin.engine.metrology.noise import realisations
from mirrorskin.engine.metrology.parameters import PARAMETERS
from mirrorskin.engine.metrology.propagation import (
    ANY_DIRECTION,
    EDGES,
    HOPELESS,
    LEVEL,
    NOISE,
    NOISE_BIAS,
    NoiseChanges,
    add_noise,
    change,
    difference,
    with_clean,
)
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]
FORM, DIRECTION = "form", "no direction"
"""Contributions to an uncertainty, besides those of the noise."""

SMOOTH = "the texture cannot be distinguished from a smooth one"
"""What a note says if the texture may be noise alone."""

DRAWS = 24
"""Realisations of the noise; half as many for maps with many pixels."""

_MAX_DRAWN_PIXELS = 500_000  # pixels
_CORRELATED = 8  # realisations from which the autocorrelation of the noise is computed
# Factors on the change by the filters' ends, for a chi-square of about 1 (test_uncertainty.py).
_EDGE_FACTORS = {"Sal": 1.8}
_DOMINATES = 0.5  # share of Sq^2 that is noise, from which on noise determines the parameters
_ISOTROPIC = 0.5  # texture aspect ratio above which a texture has no direction


@dataclass(frozen=True, slots=True, eq=False)
class Roughness:
    """Areal parameters of ISO 25178-2 over the definition area: the known pixels.

    Attributes
    ----------
    parameters : dict of str to Quantity
        By name, as in `PARAMETERS`; also "Sq of noise", the Sq of a perfect surface that is measured and
        filtered in the same way, and each parameter "without noise", such as "Sq without noise", the square
        root of the difference of the squares.
    budget : dict of str to dict of str to float
        Contributions to the standard uncertainty of each parameter, in its unit.
    pixels, left_out, uncertain : int
        Numbers of known pixels that count, that are too near to an end or a hole for the filters, and that
        are ignored because their standard deviation is much larger than that of others.
    notes : list of str
        What the noise does to the parameters.
    smooth : bool
        Whether the texture may be noise alone: Sq^2 exceeds that of the noise by less than two standard
        uncertainties.
    """

    parameters: dict[str, Quantity]
    budget: dict[str, dict[str, float]]
    pixels: int
    left_out: int
    uncertain: int
    notes: list[str] = field(default_factory=list)
    smooth: bool = False

    @property
    def sa(self) -> Quantity:
        """Arithmetical mean height, µm."""
        return self.parameters["Sa"]

    @property
    def sq(self) -> Quantity:
        """Root mean square height, µm."""
        return self.parameters["Sq"]

    @property
    def sz(self) -> Quantity:
        """Maximum height, µm."""
        return self.parameters["Sz"]


def roughness(
    residual: ArrayLike,
    pixel_size: tuple[float, float],
    *,
    s_filter: float | None = None,
    l_filter: float | None = None,
    sigma: ArrayLike | None = None,
    noise_length: float = 0.0,
    form: Sequence[ArrayLike] = (),
    form_errors: Sequence[ArrayLike] = (),
) -> Roughness:
    """Return the texture parameters of a surface from its residual, with their standard uncertainties.

    Parameters
    ----------
    residual : array_like, (H, W)
        Distances from the form, mm; NaN where undefined.
    pixel_size : (float, float)
        Along x and y, mm.
    s_filter, l_filter : float, optional
        Nesting indices, mm, of the Gaussian filters (ISO 16610-61) that remove shorter, and longer waves. At
        ends and holes they are regression filters (ISO 16610-71); see `Gaussian`.
    sigma : array_like, (H, W), optional
        Standard deviations of the heights, mm.
    noise_length : float, optional
        Length over which the errors of heights are correlated, mm: 0 for independent ones, infinity for those
        of integrated slopes.
    form : sequence of array_like, (H, W)
        Shapes that were removed with the form, such as x and y of a plane: they are removed from the noise.
    form_errors : sequence of array_like, (H, W)
        Errors of the form, mm, each of one standard uncertainty.

    Returns
    -------
    Roughness
        Parameters are those of the surface including its noise, as other programs compute them. Their
        uncertainty contains the random change by noise, and its mean change, from realisations of the noise
        that are added to the surface.

    Raises
    ------
    InputError
        No pixel is left; a filter is shorter than two pixels.

    Examples
    --------
    >>> roughness([[0.001, -0.001], [-0.001, 0.001]], pixel_size=(0.1, 0.1)).sq.value
    1.0
    """
    height = np.asarray(residual, np.float64)
    measured = np.isfinite(height)
    if not measured.any():
        raise InputError("there is no height to measure the roughness of")
    spread = np.full_like(height, np.nan) if sigma is None else np.asarray(sigma, np.float64)
    uncertain = find_uncertain(spread, measured)
    box = _bounding_box(measured & ~uncertain)
    height, spread = height[box], spread[box]
    form, form_errors = ([np.asarray(map_, np.float64)[box] for map_ in maps] for maps in (form, form_errors))
    chain = _Chain.of((measured & ~uncertain)[box], pixel_size, s_filter, l_filter, form)
    texture = chain.filtered(height)
    evaluate = _Evaluation(chain.kept, pixel_size)
    values = evaluate(texture)
    noise = None
    if np.isfinite(spread[chain.measured]).all():
        noise = _noise_changes(chain, evaluate, texture, values, (spread, pixel_size, noise_length))
    systematic = {
        EDGES: _edge_changes(chain, evaluate, height, values),
        FORM: change(evaluate, texture, [chain.filtered(error) for error in form_errors]),
    }
    parameters, budget = {}, {}
    for name, value in values.items():
        parts = {cause: changes[name] for cause, changes in systematic.items() if name in changes}
        if name == "Std" and values["Str"] > _ISOTROPIC:
            parts = {DIRECTION: ANY_DIRECTION}
        if noise is not None:
            parts = {NOISE: noise.random[name], NOISE_BIAS: noise.bias[name]} | parts
        spread_of = math.sqrt(sum(part**2 for part in parts.values())) if noise is not None else math.nan
        parameters[name] = Quantity(value, spread_of, PARAMETERS[name].unit)
        budget[name] = parts
    if noise is not None:
        parameters = with_clean(parameters, budget, noise)
    return Roughness(
        parameters,
        budget,
        int(np.count_nonzero(chain.kept)),
        int(np.count_nonzero(chain.measured & ~chain.kept)),
        int(np.count_nonzero(uncertain)),
        [] if noise is None else _notes(parameters, noise),
        noise is not None and not noise.significant,
    )


def _bounding_box(measured: Mask) -> tuple[slice, slice]:
    """Return the rows and columns that contain all measured pixels."""
    rows, columns = np.flatnonzero(measured.any(axis=1)), np.flatnonzero(measured.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


class FormRemoval:
    """What the removal of a form leaves of noise: the part that is orthogonal to the form's shapes."""

    def __init__(self, measured: Mask, form: Sequence[ArrayLike]) -> None:
        rows = [np.ones(np.count_nonzero(measured))]
        rows += [np.asarray(shape, np.float64)[measured] for shape in form]
        shapes, _ = np.linalg.qr(np.stack(rows).T)
        self._known, self._shapes = measured, np.ascontiguousarray(shapes.T)

    def __call__(self, noise: Doubles) -> Doubles:
        """Return the rest of noise, (H, W); 0 where heights are not known."""
        inside = noise[self._known]
        rest = np.zeros_like(noise, np.float64)
        # Not by BLAS, whose threads take as long as this one and do not make it faster.
        shares = np.einsum("kn,n->k", self._shapes, inside)
        rest[self._known] = inside - np.einsum("k,kn->n", shares, self._shapes)
        return rest


@dataclass(frozen=True, slots=True)
class _Chain:
    """What is done to heights, and to their noise alike: form removal of the noise, S-filter, L-filter."""

    measured: Mask
    kept: Mask
    short: Gaussian | None
    long: Gaussian | None
    form: FormRemoval

    @classmethod
    def of(
        cls,
        measured: Mask,
        pixel_size: tuple[float, float],
        s_filter: float | None,
        l_filter: float | None,
        form: Sequence[ArrayLike],
    ) -> _Chain:
        sizes, kept = pixel_size[::-1], measured
        filters = []
        for cutoff in (s_filter, l_filter):
            gaussian = None if cutoff is None else Gaussian.of(kept, sizes, cutoff)
            kept = kept if gaussian is None else gaussian.covered
            if not kept.any():
                raise InputError(
                    f"a cutoff of {cutoff:g} mm is too long for this surface: choose a shorter one"
                )
            filters.append(gaussian)
        return cls(measured, kept, filters[0], filters[1], FormRemoval(measured, form))

    def filtered(self, height: Doubles, *, level: bool = False) -> Doubles:
        """Return the waves between both filters, with the mean 0, (H, W); 0 where left out."""
        if self.short is not None:
            height = self.short.long_waves(height, level=level)
        if self.long is not None:
            height = height - self.long.long_waves(height, level=level)
        return np.where(self.kept, height - np.mean(height[self.kept]), 0.0)

    @property
    def filters(self) -> bool:
        """Whether there is any filter."""
        return self.short is not None or self.long is not None


class _Evaluation:
    """All parameters of a texture, (H, W), that is 0 where left out and has the mean 0."""

    def __init__(self, kept: Mask, pixel_size: tuple[float, float]) -> None:
        self._kept, self._pixel_size = kept, pixel_size
        self._slopes = areal.Slopes.of(kept)
        self.correlation = areal.Autocorrelation(kept, pixel_size)
        self._spectrum = areal.AngularSpectrum(kept, pixel_size)

    def __call__(self, texture: Doubles) -> dict[str, float]:
        values = texture[self._kept]
        parameters = areal.height_parameters(values) | areal.functional_parameters(values)
        parameters |= self._slopes.hybrid_parameters(texture, self._pixel_size)
        parameters |= self.correlation.lengths(self.correlation.of(texture))
        parameters["Std"] = self._spectrum.direction(texture)
        return {name: parameters[name] for name in PARAMETERS if name in parameters}


def _edge_changes(
    chain: _Chain, evaluate: _Evaluation, height: Doubles, values: Mapping[str, float]
) -> dict[str, float]:
    """Return by how much parameters depend on how the filters continue at ends and holes.

    Planes take up too much there, and means too little: values with a surface that continues are between.
    """
    if not chain.filters:
        return {}
    other = evaluate(chain.filtered(height, level=True))
    return {
        name: _EDGE_FACTORS.get(name, 1.0) * abs(difference(name, other[name], value))
        for name, value in values.items()
    }


def _noise_changes(
    chain: _Chain,
    evaluate: _Evaluation,
    texture: Doubles,
    values: Mapping[str, float],
    noise: tuple[Doubles, tuple[float, float], float],
) -> NoiseChanges:
    """Return how noise, of given sigma, pixel size and length, changes the parameters."""
    count = DRAWS if np.count_nonzero(chain.kept) <= _MAX_DRAWN_PIXELS else DRAWS // 2
    correlation = evaluate.correlation
    total = np.zeros(1)

    def errors() -> Iterator[Doubles]:
        nonlocal total
        for number, realisation in enumerate(realisations(noise[0], chain.measured, *noise[1:], count)):
            error = chain.filtered(chain.form(realisation))
            if number < _CORRELATED:
                total = total + correlation.of(error) / _CORRELATED
            yield error

    changes = add_noise(values, "Sq", evaluate, texture, chain.kept, errors())
    # The autocorrelation is the sum of those of surface and noise.
    cleaned = correlation.lengths(correlation.of(texture) - total)
    rest = max(1 - changes.noise_ratio, 1 - HOPELESS)
    for name, value in cleaned.items():  # the random error is larger relative to what is left
        bias, random = values[name] - value, changes.random[name]
        changes.bias[name] = math.hypot(bias, random * math.sqrt(rest**-2 - 1))
        changes.clean[name] = value, math.hypot(random / rest, 2 * LEVEL * bias)
    return changes


def _notes(parameters: Mapping[str, Quantity], noise: NoiseChanges) -> list[str]:
    """Return comments where noise determines the parameters."""
    measured, level = parameters["Sq"].value, noise.level
    levels = f"Sq is {measured:.3g} µm, and that of the noise {level:.3g} µm"
    if level > measured:
        return [
            f"{levels}: {SMOOTH}. Standard deviations of heights"
            " are too large here, or describe errors that neighbours share"
        ]
    if not noise.significant:
        return [f"{levels}: {SMOOTH}"]
    if level**2 > _DOMINATES * measured**2:
        return [f"{levels}: noise determines the texture; values 'without noise' are the surface's own"]
    return []
