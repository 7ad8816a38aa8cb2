"""Exact contact of rigid bodies with an incompressible elastic half-space, pressed and sheared.

The tests' own book of contact mechanics. It shares no code with mirrorskin; all is float64, mm, N, N/mm^2.
E is Young's modulus, G = E / 3 the shear modulus, E* = E / (1 - 0.25) = 4 E / 3 the modulus of contact with a
rigid body. Numbers of equations are those of Johnson, Contact Mechanics (1985).

Bodies of revolution are Sneddon's (1965), written as integrals of one function of the body's profile f(r),
which is 0 at the tip and positive downwards: g(x) = x int_0^x f'(r) / sqrt(x^2 - r^2) dr. With contact radius
a,

- the depth is g(a),
- the force is 2 E* int_0^a (g(a) - g(x)) dx,
- the pressure is E* / pi int_r^a g'(x) / sqrt(x^2 - r^2) dx,
- the surface outside is 2 / pi int_0^a (g(a) - g(x)) / sqrt(r^2 - x^2) dx.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import integrate, special

Map = NDArray[np.float64]
Function = Callable[[Map], Map]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(80)


@dataclass(frozen=True)
class Pressed:
    """A body of revolution at rest in contact of a given radius."""

    radius: float
    depth: float
    force: float
    pressure: Function  # of the distance from the axis, inside the contact
    surface: Function  # mm that the free surface is pushed in, of the distance, outside the contact


def paraboloid(curvature_radius: float, radius: float, modulus: float) -> Pressed:
    """Return Hertz's contact with f = r^2 / (2 R): eq. 3.39 to 3.42."""
    contact_modulus = 4 * modulus / 3
    peak = 2 * contact_modulus * radius / (np.pi * curvature_radius)

    def surface(r: Map) -> Map:
        arc = (2 * radius**2 - r**2) * np.arcsin(radius / r)
        outside: Map = (arc + radius * np.sqrt(r**2 - radius**2)) / (np.pi * curvature_radius)
        return outside

    return Pressed(
        radius,
        depth=radius**2 / curvature_radius,
        force=4 * contact_modulus * radius**3 / (3 * curvature_radius),
        pressure=lambda r: peak * np.sqrt(1 - (r / radius) ** 2),
        surface=surface,
    )


def sphere(ball_radius: float, radius: float, modulus: float) -> Pressed:
    """Return Sneddon's contact with a true ball: g = x artanh(x / R)."""
    contact_modulus = 4 * modulus / 3

    def g(x: Map) -> Map:
        values: Map = x * np.arctanh(x / ball_radius)
        return values

    def slope_over_x(x: Map) -> Map:
        # g' / x; artanh(t) / t goes to 1 at the axis.
        t = np.maximum(x / ball_radius, 1e-9)
        values: Map = (np.arctanh(t) / t + 1 / (1 - t**2)) / ball_radius
        return values

    depth = float(g(np.array(radius)))
    log = np.log((ball_radius + radius) / (ball_radius - radius))
    return Pressed(
        radius,
        depth=depth,
        force=contact_modulus * ((ball_radius**2 + radius**2) / 2 * log - radius * ball_radius),
        pressure=_pressure(slope_over_x, radius, contact_modulus),
        surface=_surface(g, depth, radius),
    )


def cone(steepness: float, radius: float, modulus: float) -> Pressed:
    """Return Love's contact with f = steepness r: section 5.2; the pressure has no bound at the tip."""
    contact_modulus = 4 * modulus / 3
    depth = np.pi * steepness * radius / 2
    return Pressed(
        radius,
        depth=depth,
        force=np.pi * radius**2 * contact_modulus * steepness / 2,
        pressure=lambda r: contact_modulus * steepness / 2 * np.arccosh(radius / r),
        surface=_surface(lambda x: np.pi * steepness * x / 2, depth, radius),
    )


def disc_on_axis(pressure: float, radius: float, depth: float, modulus: float) -> float:
    """Return how deep an even load on a disc pushes in a point on its axis: p a^2 / (2 G s).

    The integral over the disc of Boussinesq's 1 / s + z^2 / s^3 over 4 pi G (eq. 3.19).
    """
    return pressure * radius**2 / (2 * modulus / 3) / float(np.hypot(radius, depth))


def gaussian_load(width: float, depth: float, modulus: float, r: Map) -> Map:
    """Return how deep a pressure exp(-r^2 / (2 width^2)) N/mm^2 pushes in what lies at a depth.

    By Hankel's transform: of the pressure width^2 exp(-q^2 width^2 / 2), of the displacement that times
    (1 + q z) exp(-q z) / (2 G q).
    """

    def at(distance: float) -> float:
        def integrand(q: float) -> float:
            load = width**2 * np.exp(-((q * width) ** 2) / 2)
            decay = (1 + q * depth) * np.exp(-q * depth)
            return float(load * decay * special.j0(q * distance))

        return float(integrate.quad(integrand, 0, 12 / width, limit=400)[0]) / (2 * modulus / 3)

    return np.array([at(distance) for distance in r.ravel()]).reshape(r.shape)


def rectangle_responses(
    shape: tuple[int, int], pixel_size: tuple[float, float], modulus: float
) -> NDArray[np.float64]:
    """Return, as a matrix, how deep 1 N/mm^2 on one pixel pushes in the centre of every other.

    Each is the integral of 3 / (4 pi E) / distance over a rectangle: along x by its antiderivative, which is
    asinh(x / y), along y by numerical quadrature.
    """
    rows, columns = shape
    half_x, half_y = pixel_size[0] / 2, pixel_size[1] / 2
    lags = np.empty(shape)
    for row, column in np.ndindex(shape):
        x, y = column * pixel_size[0], row * pixel_size[1]

        def along_x(t: float, x: float = x) -> float:
            return float(np.arcsinh((x + half_x) / t) - np.arcsinh((x - half_x) / t))

        if row == 0:  # even in y, and the integrand may have no bound at 0
            lags[row, column] = 2 * integrate.quad(along_x, 0, half_y)[0]
        else:
            lags[row, column] = integrate.quad(along_x, y - half_y, y + half_y)[0]
    r, c = (index.ravel() for index in np.indices((rows, columns)))
    matrix: NDArray[np.float64] = lags[abs(r[:, None] - r), abs(c[:, None] - c)]
    return matrix * 3 / (4 * np.pi * modulus)


@dataclass(frozen=True)
class Pushed:
    """Hertz's contact, pushed sideways without turning back: Cattaneo and Mindlin, section 7.2 (a)."""

    force: float  # along the push
    stick_radius: float


def pushed(hertz: Pressed, friction: float, modulus: float, distance: float) -> Pushed:
    """Return where a push over a distance leads: eq. 7.41 and 7.42, with Poisson ratio 0.5.

    The books leave out that slip is not quite along the push.
    """
    limit = friction * hertz.force
    rest = np.sqrt(max(0.0, 1 - distance / sliding_distance(hertz, friction, modulus)))
    return Pushed(limit * (1 - rest**3), hertz.radius * rest)


def sliding_distance(hertz: Pressed, friction: float, modulus: float) -> float:
    """Return how far Hertz's contact is pushed until it slides as a whole: eq. 7.42."""
    return 3 * friction * hertz.force * 1.5 / (16 * hertz.radius * modulus / 3)


@dataclass(frozen=True)
class Twisted:
    """Hertz's contact, twisted without turning back, with a given radius of what sticks: Lubkin (1951).

    Rigid twists of discs of radius t by phi(t) dt add up to the traction 4 G r / pi times
    int_r^a phi / sqrt(t^2 - r^2) dt. That it be mu p outside the stick radius is Abel's equation, solved by
    phi = mu p(0) / (2 G) E(sqrt(1 - t^2 / a^2)) / t, E being the complete elliptic integral; inside phi = 0.
    """

    angle: float  # int phi dt = mu p(0) / (2 G) (K - E)
    torque: float  # int 16 / 3 G t^3 phi dt


def twisted(hertz: Pressed, friction: float, modulus: float, stick_radius: float) -> Twisted:
    """Return the twist that leaves a disc of a given radius stuck."""
    shear, limit = modulus / 3, friction * float(hertz.pressure(np.zeros(())))
    rest = (stick_radius / hertz.radius) ** 2
    moment = integrate.quad(lambda t: t**2 * special.ellipe(1 - t**2), np.sqrt(rest), 1)[0]
    angle = limit / (2 * shear) * (special.ellipk(1 - rest) - special.ellipe(1 - rest))
    return Twisted(float(angle), 8 / 3 * limit * hertz.radius**3 * float(moment))


def disc_torque(radius: float, modulus: float, angle: float) -> float:
    """Return the torque that twists a stuck disc: 16 / 3 G a^3 angle (Reissner and Sagoci 1944)."""
    return 16 / 3 * modulus / 3 * radius**3 * angle


def traction_response(x: float, y: float, pixel_size: tuple[float, float], modulus: float) -> Map:
    """Return the shift at (x, y) by 1 N/mm^2 on a pixel at the origin: a matrix, shift by traction.

    Cerruti's 1 / r + x x / r^3 times 3 / (4 pi E), integrated over the pixel in polar coordinates about the
    point: a sum over its four sides, each seen from there under its own range of angles.
    """
    half_x, half_y = pixel_size[0] / 2, pixel_size[1] / 2
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]]) - [x, y]
    total = np.zeros((2, 2))
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side = (end - start) / np.linalg.norm(end - start)
        away = start[0] * side[1] - start[1] * side[0]  # signed distance of the side's line from (x, y)
        if away == 0:
            continue
        nearest = np.array([side[1], -side[0]]) * away
        first, last = (np.arctan2((corner - nearest) @ side, abs(away)) for corner in (start, end))
        t = first + (last - first) * (1 + _NODES) / 2
        unit = (nearest[:, None] / abs(away)) * np.cos(t) + side[:, None] * np.sin(t)
        reach = away / np.cos(t) * (last - first) / 2 * _WEIGHTS
        total += np.einsum("n,ijn->ij", reach, np.eye(2)[:, :, None] + unit[:, None] * unit[None])
    return total * 3 / (4 * np.pi * modulus)


def _pressure(slope_over_x: Function, radius: float, contact_modulus: float) -> Function:
    """Return the pressure, with x = sqrt(r^2 + t^2) in the integral: no singularity is left."""

    def pressure(r: Map) -> Map:
        end = np.sqrt(radius**2 - r**2)[..., np.newaxis]
        t = end * (1 + _NODES) / 2
        values = slope_over_x(np.sqrt(r[..., np.newaxis] ** 2 + t**2))
        total: Map = contact_modulus / np.pi * np.sum(end / 2 * _WEIGHTS * values, axis=-1)
        return total

    return pressure


def _surface(g: Function, depth: float, radius: float) -> Function:
    """Return the free surface, with x = r sin t in the integral: no singularity is left."""

    def surface(r: Map) -> Map:
        end = np.arcsin(radius / r)[..., np.newaxis]
        t = end * (1 + _NODES) / 2
        values = depth - g(r[..., np.newaxis] * np.sin(t))
        total: Map = 2 / np.pi * np.sum(end / 2 * _WEIGHTS * values, axis=-1)
        return total

    return surface
