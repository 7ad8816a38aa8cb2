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
from mirrorskin.engine.press.press import Press
from mirrorskin.engine.streaming import Progress
from mirrorskin.io import Calibrated, Calibration, Gel, InputError, Source, Stiffness

if TYPE_CHECKING:
    from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]

_PRIOR = 6.0  # standard errors of the gel's numbers that they may well be off
_MODEL_ERROR = 0.003  # of a load, by splines and cells: measured on the twin with balls and cones
_EXACT = 1e-12  # share of a force to which nothing is known better


class KnownPress(NamedTuple):
    """A press whose force is known."""

    load: float  # force over Young's modulus, mm^2, as the heights have it
    load_sigma: float  # by the noise of the heights, mm^2
    by_gel: Doubles  # (3,): what a standard error of each of the gel's numbers changes, mm^2
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
    press = Press(threshold=LEARNED_AT, fill=False, device=device)
    result = press.run(plain, progress, undistort=False)
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
    return KnownPress(pressed.load, *fit.load_errors(pressed), force, force_sigma)


def fit_stiffness(presses: Sequence[KnownPress], gel: Gel) -> StiffnessFit:
    """Find Young's modulus of the elastomer from presses of known force.

    A force is the modulus times the load. Loads are wrong by what the gel's numbers are wrong by, in a way of
    its own at each press: so three shifts of these are found as well, with a standard deviation of six of
    their standard errors beforehand (those are of one or two balls, and not much is known of their errors).
    It is linear least squares, weighted by the errors of load and scale and by a scatter in proportion to the
    force, at least 0.3 % and as large as makes chi^2 its degrees of freedom (Paule and Mandel, J. Res. NBS
    87, 1982, 377-385).

    InputError without presses, or where the loads are not above 0.
    """
    if not presses:
        raise InputError("a modulus is learned from presses of known force: give at least one")
    table = _Presses(
        np.array([[one.load, *one.by_gel] for one in presses], np.float64),
        *np.array([[one.load_sigma, one.force, one.force_sigma] for one in presses], np.float64).T,
    )
    if not (table.terms[:, 0] > 0).all():
        raise InputError("a press without load shows no modulus: press deeper")
    scatter = max(table.scatter(), _MODEL_ERROR)
    found, covariance, _ = table.solve(scatter)
    held_out = np.full(len(presses), np.nan)
    for number in range(len(presses) if len(presses) > 1 else 0):
        others = table.but(number).solve(scatter)[0]
        held_out[number] = table.terms[number] @ others - table.force[number]
    modulus = float(found[0])
    shift = tuple((found[1:] / modulus).tolist())
    error = float(np.sqrt(np.mean((held_out / table.force) ** 2)))
    known = Stiffness(modulus, shift, covariance, scatter, gel.threshold, error, len(presses))
    residual = table.terms @ found - table.force
    return StiffnessFit(known, residual, held_out, table.sigma(scatter, modulus))


class _Presses(NamedTuple):
    """Presses as rows: loads and their changes by the gel, (n, 4), mm^2; the rest (n,)."""

    terms: Doubles
    load_sigma: Doubles
    force: Doubles
    reading: Doubles

    def but(self, number: int) -> _Presses:
        """Return all presses but one."""
        return _Presses(*(np.delete(part, number, axis=0) for part in self))

    def sigma(self, scatter: float, modulus: float) -> Doubles:
        """Return the standard deviations that are expected of the residuals, N."""
        own = self.reading**2 + (modulus * self.load_sigma) ** 2
        return np.asarray(np.sqrt(own + (scatter * modulus * self.terms[:, 0]) ** 2))

    def solve(self, scatter: float) -> tuple[Doubles, Doubles, float]:
        """Return the modulus and its products with the gel's shifts, their covariance, and chi^2."""
        usual = float(np.median(self.force / self.terms[:, 0]))
        sigma = np.maximum(self.sigma(scatter, usual), _EXACT * self.force)
        before = np.hstack([np.zeros((3, 1)), np.eye(3) / (_PRIOR * usual)])
        rows = np.vstack([self.terms / sigma[:, np.newaxis], before])
        values = np.append(self.force / sigma, np.zeros(3))
        # Loads and their changes differ by orders of magnitude.
        scale = np.linalg.norm(rows, axis=0)
        inverse = np.linalg.pinv(rows / scale) / scale[:, np.newaxis]
        found = inverse @ values
        return found, inverse @ inverse.T, float(np.sum((rows @ found - values) ** 2))

    def scatter(self) -> float:
        """Return the scatter at which chi^2 is the degrees of freedom, or 0."""
        from scipy.optimize import brentq

        def excess(scatter: float) -> float:
            return self.solve(scatter)[2] - (len(self.force) - 1)

        if len(self.force) == 1 or excess(0.0) <= 0:
            return 0.0
        return float(brentq(excess, 0.0, 10.0))
