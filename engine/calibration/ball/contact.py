"""How a body gives way to a ball, in closed form: how far it is pressed, and how steep the mirror is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Doubles = NDArray[np.float64]

_NODES = 24
_THINNEST = 1e-3  # radii of the ball: the depth of a mirror on the very surface


def sphere_travel(touch: ArrayLike, radius: float, compliance: float = 0.0) -> Doubles:
    """Return how far a ball must be pressed for a touch of some radius, mm.

    The depth is ``a artanh(a / R)``, and the force over Young's modulus ``4/3 ((a^2 + R^2) artanh(a / R) -
    a R)``, by which the stage gives way as well (Sneddon, Int. J. Eng. Sci. 3, 1965, 47-57, at Poisson ratio
    0.5).

    Parameters
    ----------
    touch : array_like
        Radius of the touch a, mm, below the ball's.
    radius : float
        Of the ball R, mm.
    compliance : float
        Of the stage, 1/mm; see `Gel`.
    """
    a = np.asarray(touch, np.float64)
    steep = np.arctanh(a / radius)
    return np.asarray(a * steep + compliance * 4 / 3 * ((a**2 + radius**2) * steep - a * radius))


def sphere_slope(distance: ArrayLike, touch: ArrayLike, radius: float, sheet: float = 0.0) -> Doubles:
    """Return how steep the mirror is under a ball and around it.

    A ball's press is one of flat punches of growing radius x, each pressed on by g'(x) dx, g(x) = x
    artanh(x / R). Of a punch pressed by 1 the harmonic continuation of the surface's displacement to the
    depth z is ::

        U = 2 / pi arcsin(2 x / (sqrt((r - x)^2 + z^2) + sqrt((r + x)^2 + z^2)))

    and the displacement of an incompressible body is U - z dU/dz (Johnson, Contact Mechanics, 1985, 3.8).

    Parameters
    ----------
    distance : array_like, (n,)
        From the ball's axis r, mm.
    touch : array_like, (n,)
        Radius of the touch a, mm, below the ball's.
    radius : float
        Of the ball R, mm.
    sheet : float
        How deep the mirror lies below the surface z, mm.
    """
    r, a = np.broadcast_arrays(np.asarray(distance, np.float64), np.asarray(touch, np.float64))
    depth = max(sheet, _THINNEST * radius)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    share, weights = (nodes + 1) / 2, weights / 2
    near, rest = np.minimum(r, a)[..., np.newaxis], np.maximum(a - r, 0.0)[..., np.newaxis]
    # Punches about as wide as the place is far make its slope: nodes crowd there.
    x = np.concatenate([near - near * share**2, near + rest * share**2], axis=-1)
    width = np.concatenate([2 * near * share * weights, 2 * rest * share * weights], axis=-1)
    part = x / radius
    pressed = width * (np.arctanh(part) + part / (1 - part**2))
    delay = depth / 2
    below, here, above = (_punch_slope(r[..., np.newaxis], x, depth + step) for step in (delay, 0.0, -delay))
    return np.asarray(np.sum(pressed * (here - depth * (below - above) / (2 * delay)), axis=-1))


def _punch_slope(r: Doubles, x: Doubles, z: float) -> Doubles:
    """Return -dU/dr of a punch of radius x, 1/mm."""
    inner, outer = np.hypot(r - x, z), np.hypot(r + x, z)
    mean = (inner + outer) / 2
    rise = ((r - x) / inner + (r + x) / outer) / 2
    return np.asarray(2 / np.pi * x * rise / (mean * np.sqrt(np.maximum(mean**2 - x**2, 0.0))))
