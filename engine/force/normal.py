"""Pressure and normal force of a press, in newtons, from the shape that is pressed and Young's modulus."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.halfspace import HalfSpace, Pressed, load_gradient, press
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked

if TYPE_CHECKING:
    from mirrorskin.engine.press.elastic import PressFit
    from mirrorskin.io import Stiffness

_BEYOND = 0.01  # of the load that may lie beyond the picture


@dataclass(frozen=True, slots=True, eq=False)
class Force:
    """The normal force of a press.

    Attributes
    ----------
    pressure : ndarray, (H, W), float32
        MPa; 0 where nothing touches.
    contact : ndarray, (H, W), bool
        Where sensor and object touch.
    force, sigma : float
        Newtons, and the standard deviation that is expected.
    """

    pressure: NDArray[np.float32]
    contact: NDArray[np.bool_]
    force: float
    sigma: float


@checked
def find_force(
    height: ArrayLike,
    travel: float,
    pixel_size: ArrayLike,
    modulus: float,
    *,
    sigma: ArrayLike = 0.0,
    travel_sigma: float = 0.0,
    modulus_sigma: float = 0.0,
    compliance: float = 0.0,
) -> Force:
    """Find the pressure on a rigid object of known shape, pressed into the elastomer without friction.

    The elastomer is an incompressible half-space, E* = E / (1 - 1/4) = 4/3 E; the contact is found by
    `mirrorskin.engine.press.halfspace.press`. Errors are propagated to first order: the force changes with a
    height in contact by the pressure there under a flat punch of the contact's shape (Betti's reciprocity).

    Parameters
    ----------
    height : array_like, (H, W)
        Of the object, mm: 0 where it meets the sheet at travel 0; NaN where there is none.
    travel : float
        By how much the body is lowered, mm.
    pixel_size : float or (float, float)
        Millimetres, along x and y.
    modulus : float
        Young's, MPa.
    sigma : array_like, scalar or (H, W)
        Standard deviation of each height, mm, independent of the others'.
    travel_sigma : float
        That of the travel, or of an error that all heights have in common, mm.
    modulus_sigma : float
        That of the modulus, MPa.
    compliance : float
        Of the stage, times the modulus: mm for each mm^2 of force over modulus, 1/mm, as `io.Gel` has it.

    Returns
    -------
    Force

    Raises
    ------
    mirrorskin.io.InputError
        A shape or a number that cannot be.
    mirrorskin.engine.NotConverged
        The contact was not found.

    Examples
    --------
    A ball of 6 mm, 0.5 mm deep in silicone of 0.1 MPa; by Hertz, who takes it for a paraboloid, 0.109 N.

    >>> import numpy as np
    >>> x = np.linspace(-2, 2, 41)
    >>> ball = np.sqrt(9 - x**2 - x[:, np.newaxis] ** 2) - 3
    >>> found = find_force(ball, 0.5, 0.1, modulus=0.1, modulus_sigma=0.002)
    >>> round(found.force, 3), round(found.sigma, 3)
    (0.107, 0.002)
    """
    surface, size = np.asarray(height, np.float64), check_pixel_size(pixel_size)
    if surface.ndim != 2 or 0 in surface.shape:
        raise InputError(f"heights have shape {surface.shape}: one map (H, W) is needed")
    _check(travel=(travel, -math.inf), travel_sigma=(travel_sigma, 0.0), modulus_sigma=(modulus_sigma, 0.0))
    _check(compliance=(compliance, 0.0))
    check_modulus(modulus)
    errors = np.asarray(sigma, np.float64)
    if errors.shape not in ((), surface.shape):
        raise InputError(f"sigma has shape {errors.shape}: give one number, or one a pixel {surface.shape}")
    space = HalfSpace((surface.shape[0], surface.shape[1]), size)
    found = press(space, surface + travel, compliance)
    gradient = load_gradient(space, found.contact, compliance)
    common = travel_sigma * float(gradient.sum())
    independent = float(np.sqrt(np.sum(np.where(found.contact, errors * gradient, 0.0) ** 2)))
    spread = math.hypot(modulus * common, modulus * independent, modulus_sigma * found.load)
    return Force((modulus * found.strain).astype(np.float32), found.contact, modulus * found.load, spread)


def check_modulus(modulus: float) -> float:
    """Return Young's modulus, or raise InputError where it cannot be."""
    if not 1e-9 < modulus < 1e9:
        raise InputError(
            f"a modulus of {modulus:g} MPa cannot be: give Young's modulus, above 0, as in 0.1 MPa"
        )
    return modulus


def _check(**values: tuple[float, float]) -> None:
    for name, (value, least) in values.items():
        if not (math.isfinite(value) and value >= least):
            bound = "a finite number" if least == -math.inf else f"{least:g} or more"
            raise InputError(f"{name} {value:g} cannot be: give {bound}")


def force_of_press(fit: PressFit, known: Stiffness | float) -> Force:
    """Return the force of a press whose surface was fitted to the onsets, at the greatest travel.

    Presses of known force correct for the gel's errors, and tell what is left; with a modulus that is merely
    given, these errors are propagated. NotConverged where much of the load lies beyond
    the picture.
    """
    pressed = press_within(fit)
    own, by_gel = fit.load_errors(pressed)
    if isinstance(known, float):
        modulus = known
        force, spread = modulus * pressed.load, modulus * math.hypot(own, *by_gel)
    else:
        modulus = known.modulus
        force = modulus * (pressed.load + float(np.sum(by_gel * known.gel_shift)))
        terms = np.append(pressed.load, by_gel)
        learned = math.sqrt(np.einsum("i,ij,j", terms, known.covariance, terms))
        spread = math.hypot(modulus * own, learned, known.scatter * force)
    pressure = (force / pressed.load * fit.on_pixels(pressed.strain)).astype(np.float32)
    contact = fit.on_pixels(pressed.contact.astype(np.float64)) >= 0.5
    return Force(np.where(contact, pressure, np.float32(0)), contact, force, spread)


def press_within(fit: PressFit) -> Pressed:
    """Return the press at the greatest travel; NotConverged where its load is not all in the picture."""
    pressed = fit.pressed()
    if not pressed.load > 0:
        raise NotConverged("nothing touches")
    inside = float(fit.scene.cells.inside(pressed.strain).sum()) * fit.scene.space.pixel_area
    if pressed.load - inside > _BEYOND * pressed.load:
        raise NotConverged(f"{1 - inside / pressed.load:.0%} of the load lies beyond the picture")
    return pressed
