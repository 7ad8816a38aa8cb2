"""The elastomer's modulus, from presses whose force is known by a scale or a weight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.force.normal import press_within
from mirrorskin.engine.press.elastic import LEARNED_AT, fit_press
from mirrorskin.engine.press.press import reconstruct_press
from mirrorskin.engine.streaming import Progress
from mirrorskin.io import Calibrated, Calibration, Gel, InputError, Source, Stiffness

if TYPE_CHECKING:
    from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]

_ENOUGH = 3  # presses whose scatter says how far one is wrong
_MODEL_ERROR = 0.004  # of a load, by splines and cells: measured on the twin with balls and cones
_EXACT = 1e-12  # share of a force to which nothing is known better


class KnownPress(NamedTuple):
    """A press whose force is known."""

    load: float  # force over Young's modulus, mm^2, as the heights have it
    load_sigma: float  # by the noise of the heights, mm^2
    gel_sigma: float  # by what is known of the gel, mm^2
    force: float  # by the scale, N
    force_sigma: float  # of the scale, N


@dataclass(frozen=True, slots=True, eq=False)
class StiffnessFit:
    """What presses of known force show.

    Attributes
    ----------
    stiffness : Stiffness
    residual : ndarray, (presses,), float64
        Forces by the modulus less those of the scale, N.
    held_out : ndarray, (presses,), float64
        The same, each by the modulus of the other presses; NaN of a single press.
    sigma : ndarray, (presses,), float64
        Standard deviations that are expected of the residuals, N.
    """

    stiffness: Stiffness
    residual: Doubles
    held_out: Doubles
    sigma: Doubles


def known_press(
    source: Source,
    calibration: Calibration,
    force: float,
    force_sigma: float = 0.0,
    *,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> KnownPress:
    """Return the load that a press shows by a calibration with a gel, beside the force that a scale read, N.

    InputError where it is no press, has no pixel size or a force that cannot be, or where the contact is not
    found, or lies beyond the picture.
    """
    if source.motion != "vertical":
        raise InputError(f"{source.name} is of {source.motion} motion: give presses of known force")
    if not (math.isfinite(force) and force > 0 and math.isfinite(force_sigma) and force_sigma >= 0):
        raise InputError(f"a force of {force:g} +- {force_sigma:g} N cannot be: give newtons above 0")
    gel = Calibrated(source, calibration).calibration.gel
    if gel is None:
        raise InputError(f"{calibration.name or 'the calibration'} has no gel: calibrate elastic first")
    plain = Calibrated(source, replace(calibration, gel=None, stiffness=None))
    if plain.header.pixel_size is None:
        raise InputError(f"{source.name} has no pixel size: calibrate the scale first, or give --pixel-size")
    result = reconstruct_press(plain, threshold=LEARNED_AT, fill=False, device=device, progress=progress)
    assert result.height is not None
    assert result.height_sigma is not None
    assert result.status is not None
    maps = result.height, result.height_sigma, result.status
    try:
        fit = fit_press(*maps, plain.header.pixel_size, gel, deepest=float(np.max(plain.travel)))
        pressed = press_within(fit)
    except NotConverged as error:
        raise InputError(
            f"{source.name} shows no force: {error}; press otherwise, or leave it out"
        ) from error
    return KnownPress(pressed.load, *fit.load_sigma(pressed), force, force_sigma)


def fit_stiffness(presses: Sequence[KnownPress], gel: Gel) -> StiffnessFit:
    """Find Young's modulus of the elastomer from presses of known force.

    The force is the modulus times the load, by least squares weighted with the errors of load and scale, and
    with a scatter in proportion to the force: as large as makes chi^2 of the residuals their degrees of
    freedom (Paule and Mandel, J. Res. NBS 87, 1982, 377-385), and at least 0.4 %. The scatter holds
    what the presses do not have in common of the gel's errors and of the model's; what they have in common is
    in the modulus. Of fewer than three presses it is the largest share that the gel's errors have of a load.

    InputError without presses, or where the loads or forces are not above 0.
    """
    if not presses:
        raise InputError("a modulus is learned from presses of known force: give at least one")
    load, load_sigma, by_gel, force, reading = np.array(presses, np.float64).T
    if not (load > 0).all():
        raise InputError("a press without load shows no modulus: press deeper")
    modulus = float(np.median(force / load))
    few = len(presses) < _ENOUGH
    scatter = float(np.max(by_gel / load)) if few else _scatter(load, load_sigma, force, reading)
    scatter = max(scatter, _MODEL_ERROR)
    for _ in range(3):  # errors of loads count by the modulus
        sigma = _sigma(modulus, scatter, load, load_sigma, reading)
        modulus, spread = _modulus(load, force, sigma)
    held_out = np.full(len(presses), np.nan)
    for number in range(len(presses) if len(presses) > 1 else 0):
        rest = np.arange(len(presses)) != number
        held_out[number] = _modulus(load[rest], force[rest], sigma[rest])[0] * load[number] - force[number]
    error = float(np.sqrt(np.mean((held_out / force) ** 2)))
    known = Stiffness(modulus, scatter, gel.threshold, error, len(presses), {"modulus": spread})
    return StiffnessFit(known, modulus * load - force, held_out, sigma)


def _modulus(load: Doubles, force: Doubles, sigma: Doubles) -> tuple[float, float]:
    """Return the modulus by weighted least squares, and its standard error."""
    weight = load / sigma**2
    form = float(np.sum(weight * load))
    return float(np.sum(weight * force)) / form, 1 / math.sqrt(form)


def _sigma(modulus: float, scatter: float, load: Doubles, load_sigma: Doubles, reading: Doubles) -> Doubles:
    return np.asarray(np.sqrt(reading**2 + (modulus * load_sigma) ** 2 + (scatter * modulus * load) ** 2))


def _scatter(load: Doubles, load_sigma: Doubles, force: Doubles, reading: Doubles) -> float:
    """Return the scatter at which chi^2 of the residuals is their degrees of freedom, or 0."""
    from scipy.optimize import brentq

    def excess(scatter: float) -> float:
        modulus = float(np.median(force / load))
        for _ in range(3):
            sigma = np.maximum(_sigma(modulus, scatter, load, load_sigma, reading), _EXACT * force)
            modulus = _modulus(load, force, sigma)[0]
        return float(np.sum(((modulus * load - force) / sigma) ** 2)) - (len(load) - 1)

    return 0.0 if excess(0.0) <= 0 else float(brentq(excess, 0.0, 10.0))
