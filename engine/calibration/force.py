"""The elastomer's modulus, from presses whose force is measured by a scale or a weight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.running import Progress
from mirrorskin.engine.calibration.sources import pixel_size_of
from mirrorskin.engine.force.normal import press_within
from mirrorskin.engine.press.elastic import LEARNED_AT, fit_press
from mirrorskin.engine.press.press import Press
from mirrorskin.io import Calibrated, Calibration, Gel, InputError, Source, Stiffness
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.kernels.device import Device


_PRIOR = 6.0  # prior standard deviation of the gel's parameters, in their standard errors
_MODEL_ERROR = 0.003  # relative error of a load due to splines and cells, for balls and cones of the twin
_EXACT = 1e-12  # minimum relative standard deviation of a force


class KnownPress(NamedTuple):
    """A press with a measured force."""

    load: float  # force divided by Young's modulus, from the heights, mm^2
    load_sigma: float  # standard deviation due to the noise of the heights, mm^2
    by_gel: Doubles  # (3,): change of the load per standard error of each of the gel's parameters, mm^2
    force: float  # reading of the scale, N
    force_sigma: float  # standard deviation of the reading, N


@dataclass(frozen=True, slots=True, eq=False)
class StiffnessFit:
    """A modulus and its residuals.

    Attributes
    ----------
    stiffness : Stiffness
    residual : ndarray, (presses,), float64
        Forces computed with the modulus minus readings of the scale, N.
    held_out : ndarray, (presses,), float64
        The same with the modulus fitted to the other presses; NaN for a single press.
    sigma : ndarray, (presses,), float64
        Expected standard deviations of the residuals, N.
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
    """Return the load of a press, computed with a calibrated gel, and the force measured by a scale.

    Parameters
    ----------
    source : Source
        The press.
    calibration : Calibration
    force, force_sigma : float
        Force at the end of the press and its standard deviation, N.
    device : str or Device, optional
    progress : callable, optional
        Called with the number of frames so far.

    Raises
    ------
    mirrorskin.io.InputError
        The source is not a press or has no pixel size, the force is not above 0, or the contact is not found
        or extends beyond the picture.
    """
    if source.motion != "vertical":
        raise InputError(f"{source.name} is of {source.motion} motion: give presses of known force")
    if not (math.isfinite(force) and force > 0 and math.isfinite(force_sigma) and force_sigma >= 0):
        raise InputError(f"force {force:g} ± {force_sigma:g} N: give newtons above 0")
    gel = Calibrated(source, calibration).calibration.gel
    if gel is None:
        raise InputError(f"{calibration.name or 'the calibration'} has no gel: calibrate elastic first")
    plain = Calibrated(source, replace(calibration, gel=None, stiffness=None))
    pixel_size = pixel_size_of(plain)
    press = Press(threshold=LEARNED_AT, fill=False, device=device)
    result = press.run(plain, progress, undistort=False)
    maps = [result[name] for name in ("height", "height_sigma", "status")]
    try:
        fit = fit_press(maps[0], maps[1], maps[2], pixel_size, gel, deepest=float(np.max(plain.travel)))
        pressed = press_within(fit)
    except NotConverged as error:
        message = f"{source.name} shows no force: {error}; press otherwise, or leave it out"
        raise InputError(message) from error
    return KnownPress(pressed.load, *fit.load_errors(pressed), force, force_sigma)


def fit_stiffness(presses: Sequence[KnownPress], gel: Gel) -> StiffnessFit:
    """Fit Young's modulus of the elastomer to presses of measured force.

    A force is the modulus times the load. Errors of the gel's parameters change each load differently, so
    three shifts of these parameters are fitted as well. Their prior standard deviation is six of their
    standard errors, which are estimated from one or two balls and are uncertain themselves. The linear least
    squares are weighted by the errors of load and scale, and by a relative scatter of the force: at least
    0.3 %, and large enough that chi^2 equals its degrees of freedom (Paule and Mandel, J. Res. NBS 87, 1982,
    377-385).

    Raises
    ------
    mirrorskin.io.InputError
        There are no presses, or a load is not above 0.
    """
    if not presses:
        raise InputError("a modulus is learned from presses of measured force: give at least one")
    table = _Presses(
        np.array([[press.load, *press.by_gel] for press in presses], np.float64),
        *np.array([[press.load_sigma, press.force, press.force_sigma] for press in presses], np.float64).T,
    )
    if not (table.terms[:, 0] > 0).all():
        raise InputError("a press without load shows no modulus: press deeper")
    scatter = max(table.scatter(), _MODEL_ERROR)
    solution, covariance, _ = table.solve(scatter)
    held_out = np.full(len(presses), np.nan)
    for number in range(len(presses) if len(presses) > 1 else 0):
        others = _Presses(*(np.delete(part, number, axis=0) for part in table)).solve(scatter)[0]
        held_out[number] = table.terms[number] @ others - table.force[number]
    modulus = float(solution[0])
    shift = tuple((solution[1:] / modulus).tolist())
    error = float(np.sqrt(np.mean((held_out / table.force) ** 2)))
    stiffness = Stiffness(modulus, shift, covariance, scatter, gel.threshold, error, len(presses))
    residual = table.terms @ solution - table.force
    return StiffnessFit(stiffness, residual, held_out, table.sigma(scatter, modulus))


class _Presses(NamedTuple):
    """The presses of a fit."""

    terms: Doubles  # (n, 4): loads and their changes by the gel, mm^2
    load_sigma: Doubles  # (n,): mm^2
    force: Doubles  # (n,): N
    force_sigma: Doubles  # (n,): N

    def sigma(self, scatter: float, modulus: float) -> Doubles:
        """Return the expected standard deviations of the residuals, N."""
        variance = self.force_sigma**2 + (modulus * self.load_sigma) ** 2
        return np.asarray(np.sqrt(variance + (scatter * modulus * self.terms[:, 0]) ** 2))

    def solve(self, scatter: float) -> tuple[Doubles, Doubles, float]:
        """Return the modulus and its products with the shifts, (4,), their covariance, and chi^2."""
        usual = float(np.median(self.force / self.terms[:, 0]))
        sigma = np.maximum(self.sigma(scatter, usual), _EXACT * self.force)
        prior = np.hstack([np.zeros((3, 1)), np.eye(3) / (_PRIOR * usual)])
        rows = np.vstack([self.terms / sigma[:, np.newaxis], prior])
        values = np.append(self.force / sigma, np.zeros(3))
        # Columns are scaled, because loads and their changes differ by orders of magnitude.
        scale = np.linalg.norm(rows, axis=0)
        inverse = np.linalg.pinv(rows / scale) / scale[:, np.newaxis]
        solution = inverse @ values
        return solution, inverse @ inverse.T, float(np.sum((rows @ solution - values) ** 2))

    def scatter(self) -> float:
        """Return the scatter at which chi^2 equals the degrees of freedom, or 0."""
        from scipy.optimize import brentq

        def excess(scatter: float) -> float:
            return self.solve(scatter)[2] - (len(self.force) - 1)

        if len(self.force) == 1 or excess(0.0) <= 0:
            return 0.0
        return float(brentq(excess, 0.0, 10.0))
