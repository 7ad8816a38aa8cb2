"""Planes, spheres and polynomials through height maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.metrology.fitting import PointCloud, monomials
from mirrorskin.engine.metrology.quantity import Quantity, degrees
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

MAX_DEGREE = 4
"""Highest degree of polynomials."""

_LEVEL = 1e-12  # slope below which a plane counts as level
_ANY_ANGLE = math.pi / math.sqrt(3)  # standard deviation of a uniformly distributed angle, radians
_FLATTEST = 1e-9  # sagitta over extent, below which a surface counts as flat


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """The plane that fits a height map.

    Attributes
    ----------
    tilt : Quantity
        Between its normal and z, degrees.
    azimuth : Quantity
        Direction of descent, counter-clockwise from x, degrees.
    offset : Quantity
        Height at x = y = 0, mm.
    rms : Quantity
        Root mean square of the residual, outliers included, µm.
    residual : ndarray, (H, W), float64
        Distances from the plane, mm, positive on the camera's side; NaN without a height.
    outliers : int
        Number of outliers, which a robust fit ignores.
    birge : float
        Residual over that predicted by the standard deviations; see `Fit`.
    """

    tilt: Quantity
    azimuth: Quantity
    offset: Quantity
    rms: Quantity
    residual: Doubles
    outliers: int
    birge: float

    def quantities(self) -> dict[str, Quantity]:
        """Return its quantities by name."""
        return {
            "plane tilt": self.tilt,
            "plane azimuth": self.azimuth,
            "plane height at centre": self.offset,
            "plane residual RMS": self.rms,
        }


def fit_plane(
    height: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    sigma: ArrayLike | None = None,
    *,
    noise_length: float | None = None,
    robust: bool = False,
) -> Plane:
    """Fit a plane to a height map, (H, W) mm with NaN where undefined, by least squares.

    Pixel centres are at ``x``, (W,), and ``y``, (H,), mm. ``sigma``, (H, W) mm, are the heights' standard
    deviations, which determine weights as in `PointCloud.fit`. Uncertainties are from `covariance`. The mean
    standard deviation is added to that of the height, because heights may have a common error. If errors of
    heights are correlated over a ``noise_length``, mm, infinity for integrated slopes, uncertainties are at
    least those that follow from ``sigma``; see `mirrorskin.engine.measure`. Of independent errors, of length
    0, only a share is common. All points count, unless the fit is ``robust``: see `PointCloud.fit`.

    Examples
    --------
    >>> round(fit_plane([[0, 1], [0, 1]], x=[0, 1], y=[1, 0]).tilt.value, 6)
    45.0
    """
    cloud, form = PointCloud.of(height, x, y, sigma, noise_length), _PlaneForm()
    fit = cloud.fit(form, robust=robust) if cloud.sigma.size >= 3 else None
    if fit is None:
        raise InputError("no plane fits: at least three pixels that are not in one line are needed")
    offset, p, q = fit.parameters
    slope = math.hypot(p, q)
    level = slope < _LEVEL
    cos, sin = (1.0, 0.0) if level else (p / slope, q / slope)
    along, across = fit.sigma(0, cos, sin), fit.sigma(0, -sin, cos)
    azimuth_sigma = _ANY_ANGLE if level else min(across / slope, _ANY_ANGLE)
    distance = form.distance(cloud.points, fit.parameters) / math.sqrt(1 + slope**2)
    residual, rms = cloud.residual(distance)
    return Plane(
        tilt=degrees(math.atan(slope), along / (1 + slope**2)),
        azimuth=degrees(0.0 if level else math.atan2(-q, -p), azimuth_sigma),
        offset=Quantity(float(offset), math.hypot(fit.sigma(1, 0, 0), cloud.common_sigma), "mm"),
        rms=rms,
        residual=residual,
        outliers=int(np.count_nonzero(~fit.kept)),
        birge=fit.birge,
    )


class _PlaneForm:
    """Planes with the parameters offset and slopes along x and y; distances are along z, as errors are."""

    lift, degree = 0, 1

    def start(self) -> Doubles:
        return np.zeros(3)

    def distance(self, points: Doubles, parameters: Doubles) -> Doubles:
        x, y, z = points
        offset, p, q = parameters
        return np.asarray(z - offset - p * x - q * y)

    def jacobian(self, points: Doubles, parameters: Doubles) -> Doubles:
        x, y, _ = points
        return np.stack([-np.ones_like(x), -x, -y])


@dataclass(frozen=True, slots=True, eq=False)
class Polynomial:
    """The polynomial of x and y that fits a height map.

    Attributes
    ----------
    degree : int
    rms : Quantity
        Root mean square of the residual, outliers included, µm.
    range : Quantity
        Height of its highest point over its lowest one on the measured pixels, mm.
    residual : ndarray, (H, W), float64
        Distances from it along z, mm; NaN without a height.
    shapes, errors : list of ndarray, (H, W), float64
        Its terms without the constant; and its errors, mm, each of one standard uncertainty and independent.
    outliers, birge
        See `Plane`.
    """

    degree: int
    rms: Quantity
    range: Quantity
    residual: Doubles
    shapes: list[Doubles]
    errors: list[Doubles]
    outliers: int
    birge: float

    def quantities(self) -> dict[str, Quantity]:
        """Return its quantities by name."""
        return {"polynomial height range": self.range, "polynomial residual RMS": self.rms}


def fit_polynomial(
    height: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    sigma: ArrayLike | None = None,
    *,
    degree: int,
    noise_length: float | None = None,
    robust: bool = False,
) -> Polynomial:
    """Fit a polynomial with all products of x and y up to a degree, 1 to 4; see `fit_plane`.

    Examples
    --------
    >>> x = np.linspace(-1, 1, 9)
    >>> bowl = fit_polynomial(x**2 + 2 * x[:, None] ** 4, x, -x, degree=4)
    >>> round(bowl.range.value, 6), round(bowl.rms.value, 6)
    (3.0, 0.0)
    """
    if degree not in range(1, MAX_DEGREE + 1):
        raise InputError(f"degree {degree}: a whole number from 1 to {MAX_DEGREE} is needed")
    cloud = PointCloud.of(height, x, y, sigma, noise_length)
    form = _PolynomialForm.of(cloud.points, degree)
    count = form.start().size
    fit = cloud.fit(form, robust=robust) if cloud.sigma.size >= count else None
    if fit is None:
        raise InputError(
            f"no polynomial of degree {degree} fits: at least {count} pixels are needed, in an area"
        )
    distance = form.distance(cloud.points, fit.parameters)
    residual, rms = cloud.residual(distance)
    fitted = cloud.points[2] - distance
    lowest, highest = int(np.argmin(fitted)), int(np.argmax(fitted))
    at = form.jacobian(cloud.points[:, [lowest, highest]], fit.parameters)
    across, up = np.meshgrid(np.asarray(x, np.float64), np.asarray(y, np.float64))
    every = np.stack([across.ravel(), up.ravel(), 0 * up.ravel()])
    terms = -form.jacobian(every, fit.parameters).reshape(count, *up.shape)
    variances, directions = np.linalg.eigh(np.nan_to_num(fit.covariance))
    errors = (directions * np.sqrt(np.maximum(variances, 0))).T @ terms.reshape(count, -1)
    return Polynomial(
        degree=degree,
        rms=rms,
        range=Quantity(float(fitted[highest] - fitted[lowest]), fit.sigma(*(at[:, 1] - at[:, 0])), "mm"),
        residual=residual,
        shapes=list(terms[1:]),
        errors=list(errors.reshape(terms.shape)),
        outliers=int(np.count_nonzero(~fit.kept)),
        birge=fit.birge,
    )


@dataclass(frozen=True, slots=True)
class _PolynomialForm:
    """Polynomials of a degree; distances are along z. Places are scaled to -1 to 1."""

    degree: int
    middle: Doubles  # (2,), mm
    reach: Doubles
    lift: int = 0

    @classmethod
    def of(cls, points: Doubles, degree: int) -> _PolynomialForm:
        """Scale by the extent of the points."""
        if not points.shape[1]:
            return cls(degree, np.zeros(2), np.ones(2))
        low, high = points[:2].min(axis=1), points[:2].max(axis=1)
        return cls(degree, (low + high) / 2, np.where(high > low, (high - low) / 2, 1.0))

    def start(self) -> Doubles:
        return np.zeros((self.degree + 1) * (self.degree + 2) // 2)

    def distance(self, points: Doubles, parameters: Doubles) -> Doubles:
        return np.asarray(points[2] + parameters @ self.jacobian(points, parameters))

    def jacobian(self, points: Doubles, parameters: Doubles) -> Doubles:
        x, y = (points[:2] - self.middle[:, np.newaxis]) / self.reach[:, np.newaxis]
        return -np.stack([term for power in range(self.degree + 1) for term in monomials(x, y, power)])


@dataclass(frozen=True, slots=True, eq=False)
class Sphere:
    """The sphere that fits a height map: a ball, or a hollow, whose centre is on the camera's side.

    Attributes
    ----------
    radius : Quantity
        Millimetres.
    x, y, z : Quantity
        Centre, mm.
    top : Quantity
        Height of the point nearest to the camera, or of a hollow's farthest point, mm.
    rms, residual, outliers, birge
        See `Plane`.
    hollow : bool
    """

    radius: Quantity
    x: Quantity
    y: Quantity
    z: Quantity
    top: Quantity
    rms: Quantity
    residual: Doubles
    outliers: int
    hollow: bool
    birge: float

    def quantities(self) -> dict[str, Quantity]:
        """Return its quantities by name."""
        return {
            "sphere radius": self.radius,
            "sphere centre x": self.x,
            "sphere centre y": self.y,
            "sphere centre z": self.z,
            "sphere bottom" if self.hollow else "sphere top": self.top,
            "sphere residual RMS": self.rms,
        }


def fit_sphere(
    height: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    sigma: ArrayLike | None = None,
    *,
    noise_length: float | None = None,
    robust: bool = True,
) -> Sphere:
    """Fit a sphere to a height map by least squares of the distances from it; see `fit_plane`.

    By default the fit is robust.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(-1, 1, 9)
    >>> round(fit_sphere(np.sqrt(25 - x**2 - x[:, None] ** 2), x, -x).radius.value, 6)
    5.0
    """
    cloud = PointCloud.of(height, x, y, sigma, noise_length)
    form = _SphereForm.of(cloud.points)
    fit = None if form is None else cloud.fit(form, robust=robust)
    if form is None or fit is None:
        raise InputError("no sphere fits: a curved surface of at least four pixels is needed")
    x_centre, y_centre, z_centre, radius = map(float, fit.parameters)
    sigmas = np.sqrt(np.diag(fit.covariance))
    residual, rms = cloud.residual(form.distance(cloud.points, fit.parameters))
    top_sigma = math.hypot(fit.sigma(0, 0, 1, form.side), cloud.common_sigma)
    return Sphere(
        radius=Quantity(radius, float(sigmas[3]), "mm"),
        x=Quantity(x_centre, float(sigmas[0]), "mm"),
        y=Quantity(y_centre, float(sigmas[1]), "mm"),
        z=Quantity(z_centre, math.hypot(sigmas[2], cloud.common_sigma), "mm"),
        top=Quantity(z_centre + form.side * radius, top_sigma, "mm"),
        rms=rms,
        residual=residual,
        outliers=int(np.count_nonzero(~fit.kept)),
        hollow=form.side < 0,
        birge=fit.birge,
    )


@dataclass(slots=True)
class _SphereForm:
    """Spheres with the parameters centre and radius; the side is 1 for a ball, -1 for a hollow."""

    side: int
    first: Doubles
    lift: int = 2
    degree: int = 1

    @classmethod
    def of(cls, points: Doubles) -> _SphereForm | None:
        """Start from a fitted paraboloid, which approximates a sphere's cap."""
        if points.shape[1] < 4:
            return None
        x, y, z = points
        rows = np.stack([np.ones_like(x), x, y, x * x + y * y])
        scale = np.abs(rows).max(axis=1)
        if not np.all(scale > 0):
            return None
        rows /= scale[:, np.newaxis]
        offset, p, q, bend = np.linalg.pinv(rows @ rows.T, hermitian=True) @ (rows @ z) / scale
        extent = float(max(np.ptp(x), np.ptp(y)))
        if not abs(bend) * extent > _FLATTEST:
            return None
        centre = np.array([-p / (2 * bend), -q / (2 * bend)])
        top = offset + (p * centre[0] + q * centre[1]) / 2
        return cls(-int(np.sign(bend)), np.array([*centre, top + 0.5 / bend, abs(0.5 / bend)]))

    def start(self) -> Doubles:
        return self.first

    def distance(self, points: Doubles, parameters: Doubles) -> Doubles:
        return np.asarray(self.side * (_length(points - parameters[:3, np.newaxis]) - parameters[3]))

    def jacobian(self, points: Doubles, parameters: Doubles) -> Doubles:
        rows = np.empty((4, points.shape[1]))
        np.subtract(points, parameters[:3, np.newaxis], out=rows[:3])
        rows[:3] /= -self.side * _length(rows[:3])
        rows[3] = -self.side
        return rows


def _length(vectors: Doubles) -> Doubles:
    """Return the lengths, (n,), of vectors, (3, n)."""
    return np.asarray(np.sqrt(np.einsum("kn,kn->n", vectors, vectors)))
