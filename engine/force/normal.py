"""Pressure and normal force of a press, in newtons, from the shape that is pressed and Young's modulus."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.force.blocks import BlockErrors, Blocks
from mirrorskin.engine.force.halfspace import MARGIN, HalfSpace, Pressed, load_gradient, press, window_of
from mirrorskin.engine.metrology.patch import noise_length
from mirrorskin.io import InputError, Result, pixel_axes
from mirrorskin.io.base.arguments import check_number, checked, in_unit
from mirrorskin.io.base.findings import carried
from mirrorskin.io.model.result import in_pixels

if TYPE_CHECKING:
    from mirrorskin.engine.press.elastic import PressFit
    from mirrorskin.io import Stiffness

UNCERTAIN = 0.4  # relative standard deviation of the correction for errors of heights
_MAX_OUTSIDE = 0.01  # maximum share of the load outside the picture


@checked(
    travel=in_unit("mm", check_number),
    pixel_size=in_unit("mm"),
    modulus=in_unit("MPa", check_number),
    sigma=in_unit("mm"),
    travel_sigma=in_unit("mm", check_number),
    modulus_sigma=in_unit("MPa", check_number),
    compliance=check_number,
)
def find_force(
    height: Maps,
    travel: float | None = None,
    pixel_size: ArrayLike | None = None,
    modulus: float | None = None,
    *,
    sigma: ArrayLike | None = None,
    travel_sigma: float = 0.0,
    modulus_sigma: float = 0.0,
    compliance: float = 0.0,
) -> Result:
    """Find the pressure on a rigid object of known shape, pressed into the elastomer without friction.

    The elastomer is an incompressible half-space, E* = E / (1 - 1/4) = 4/3 E; the contact is found by
    `mirrorskin.engine.force.halfspace.press`. Errors are propagated to first order: the force changes with a
    height in contact by the pressure there under a flat punch of the contact's shape (Betti's reciprocity).

    Parameters
    ----------
    height : Result, mapping, xarray.Dataset, path or array_like, (H, W)
        Height of the object, mm, and its standard deviation, if available; an array is the height. It is 0
        where the object meets the sheet at travel 0, and NaN where there is no object.
    travel : float, optional
        Downward displacement of the body, mm; by default ``travel`` of the result's ``fitted``.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the result.
    modulus : float, optional
        Young's modulus, MPa; by default that of the result's calibration.
    sigma : array_like, scalar or (H, W), optional
        Independent standard deviations of the heights, mm; NaN is replaced by the value of the nearest pixel.
        By default ``height_sigma`` of the result, or 0, with the correlation of its errors: over
        ``height_correlation`` if the heights are fused, or of all if they are integrated.
    travel_sigma : float
        Standard deviation of the travel, or of an error common to all heights, mm.
    modulus_sigma : float
        Standard deviation of the modulus, MPa; by default that of the calibration if the modulus is.
    compliance : float
        Compliance of the stage times the modulus: mm for each mm^2 of force over modulus, 1/mm, as in
        `io.Gel`.

    Returns
    -------
    Result
        ``pressure``, MPa, 0 where nothing touches; ``contact``; ``force`` and ``force_sigma``, N.

    Raises
    ------
    mirrorskin.io.InputError
        A shape or a number is not possible.
    mirrorskin.engine.NotConverged
        The search for the contact did not converge.

    Examples
    --------
    A ball of 6 mm, 0.5 mm deep in silicone of 0.1 MPa. Hertz's formula, for a paraboloid, gives 0.109 N.

    >>> import numpy as np
    >>> x = np.linspace(-2, 2, 41)
    >>> ball = np.sqrt(9 - x**2 - x[:, np.newaxis] ** 2) - 3
    >>> found = find_force(ball, 0.5, 0.1, modulus=0.1, modulus_sigma=0.002)
    >>> round(found.force, 3), round(found.force_sigma, 3)
    (0.107, 0.002)
    """
    result = as_result(height, "height", pixel_size=pixel_size)
    surface, travel = surface_of(result, travel)
    size = pixel_size_of(result, "height", pixel_size)
    young, young_sigma = modulus_of(result, modulus, modulus_sigma)
    check_bounds(travel_sigma=travel_sigma, modulus_sigma=modulus_sigma, compliance=compliance)
    fitted, own = result.fitted, sigma is None
    errors = np.asarray((0.0 if result.height_sigma is None else result.height_sigma) if own else sigma)
    if errors.shape not in ((), surface.shape):
        raise InputError(f"sigma has shape {errors.shape}: give one number, or one a pixel {surface.shape}")
    space = HalfSpace((surface.shape[0], surface.shape[1]), size)
    lowered = (surface + np.float64(travel)).astype(np.float32)
    pressed = press(space, lowered, compliance)
    gradient = load_gradient(space, pressed.contact, compliance)
    common = math.hypot(travel_sigma, (own and fitted.height_common_sigma) or 0.0) * float(gradient.sum())
    independent = excess = 0.0
    if pressed.load > 0:
        window, _ = window_of(space, pressed.contact, MARGIN)
        variance = np.broadcast_to(errors, space.shape)[window].astype(np.float64) ** 2
        uncertain = BlockErrors(variance, Blocks(space.shape, size, 1), noise_length(result) if own else 0.0)
        independent = math.sqrt(float(uncertain.covariance(gradient[window][np.newaxis])[0, 0]))
        drawn = np.zeros(space.shape, np.float32)
        drawn[window] = uncertain.drawn()
        excess = excess_load(space, lowered, drawn, compliance, pressed, gradient)
    load = pressed.load + pressed.more(gradient) - excess
    terms = young * common, young * independent, young_sigma * load, young * UNCERTAIN * excess
    pressure = (young * pressed.strain * (load / pressed.load if pressed.load else 1)).astype(np.float32)
    force = _force(pressure, pressed.contact, young * load, math.hypot(*terms))
    x, y = pixel_axes((surface.shape[0], surface.shape[1]), size)
    process = {"modulus": float(young), **carried({}, height=result.process)}
    return force.assign(x=x, y=y, process=process).with_fitted(travel=float(travel))


def surface_of(result: Result, travel: float | None) -> tuple[NDArray[Any], float]:
    """Return the heights of a result, (H, W) mm, and the travel, as given or that of the result."""
    if result.height is None:
        raise InputError("height has no map of that name: give the result of a press, or an array (H, W)")
    surface = np.asarray(result.height)
    if surface.ndim != 2 or 0 in surface.shape:
        raise InputError(f"heights have shape {surface.shape}: one map (H, W) is needed")
    if travel is None:
        travel = result.fitted.travel
        if travel is None:
            raise InputError("travel is missing: specify by how many millimetres the body is lowered")
    if in_pixels(result):
        raise InputError("heights are in pixels: specify pixel_size, in millimetres")
    if not math.isfinite(travel):
        raise InputError(f"travel {travel:g} is not possible: give a finite number")
    return surface, travel


def excess_load(
    space: HalfSpace,
    surface: NDArray[np.float32],
    errors: NDArray[np.float32],
    compliance: float,
    pressed: Pressed,
    gradient: NDArray[Any],
) -> float:
    """Return the increase of the load due to errors of heights, of which some are drawn, mm^2.

    Peaks increase the load more than dents decrease it. Errors of the same size are added with both signs,
    which cancels linear terms; the mean change of the load approximates the change that the heights already
    contain (SIMEX, Cook and Stefanski 1994).
    """
    if not errors[pressed.contact].any():
        return 0.0
    both = [press(space, moved, compliance, pressed) for moved in (surface - errors, surface + errors)]
    mean = sum(each.load + each.more(gradient) for each in both) / 2
    return min(mean - pressed.load - pressed.more(gradient), pressed.load / 2)


def _force(pressure: NDArray[np.float32], contact: NDArray[np.bool_], force: float, sigma: float) -> Result:
    return Result(pressure=pressure, contact=contact.astype(np.uint8), force=force, force_sigma=sigma)


def modulus_of(result: Result, modulus: float | None, modulus_sigma: float) -> tuple[float, float]:
    """Return Young's modulus and its standard deviation, as given, or from a result's calibration."""
    if modulus is not None:
        return check_modulus(modulus), modulus_sigma
    stiffness = None if result.calibration is None else result.calibration.stiffness
    if stiffness is None:
        raise InputError("modulus is missing: specify Young's modulus, MPa, or calibrate force")
    return stiffness.modulus, modulus_sigma or math.sqrt(stiffness.covariance[0, 0])


def check_modulus(modulus: float) -> float:
    """Return Young's modulus, or raise InputError if it is not possible."""
    if not 1e-9 < modulus < 1e9:
        raise InputError(
            f"a modulus of {modulus:g} MPa is not possible: give Young's modulus, above 0, as in 0.1 MPa"
        )
    return modulus


def check_bounds(**values: float) -> None:
    """Raise InputError for a number below 0, or one that is not finite."""
    for name, value in values.items():
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{name} {value:g} is not possible: give 0 or more")


def force_of_press(fit: PressFit, stiffness: Stiffness | float) -> Result:
    """Return the force of a press whose surface was fitted to the onsets, at the greatest travel.

    A stiffness calibrated by presses of known force corrects errors of the gel's shape; with a specified
    modulus, these errors are propagated. NotConverged if much of the load is outside of the picture.
    """
    pressed = press_within(fit)
    load_sigma, by_gel = fit.load_errors(pressed)
    if isinstance(stiffness, float):
        modulus = stiffness
        force, spread = modulus * pressed.load, modulus * math.hypot(load_sigma, *by_gel)
    else:
        modulus = stiffness.modulus
        force = modulus * (pressed.load + float(np.sum(by_gel * stiffness.gel_shift)))
        terms = np.append(pressed.load, by_gel)
        learned = math.sqrt(np.einsum("i,ij,j", terms, stiffness.covariance, terms))
        spread = math.hypot(modulus * load_sigma, learned, stiffness.scatter * force)
    pressure = (force / pressed.load * fit.on_pixels(pressed.strain)).astype(np.float32)
    contact = fit.on_pixels(pressed.contact.astype(np.float64)) >= 0.5
    return _force(np.where(contact, pressure, np.float32(0)), contact, force, spread)


def press_within(fit: PressFit) -> Pressed:
    """Return the press at the greatest travel; NotConverged if much of its load is outside of the picture."""
    pressed = fit.pressed()
    if not pressed.load > 0:
        raise NotConverged("nothing touches")
    inside = float(fit.scene.cells.inside(pressed.strain).sum()) * fit.scene.space.pixel_area
    if pressed.load - inside > _MAX_OUTSIDE * pressed.load:
        raise NotConverged(f"{1 - inside / pressed.load:.0%} of the load lies beyond the picture")
    return pressed
