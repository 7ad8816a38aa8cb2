"""Planes and spheres through height maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.metrology.fitting import PointCloud
from mirrorskin.engine.metrology.quantity import Quantity, degrees
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

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
        Number of ignored pixels.
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
) -> Plane:
    """Fit a plane to a height map, (H, W) mm with NaN where undefined, by least squares.

    Pixel centres are at ``x``, (W,), and ``y``, (H,), mm. ``sigma``, (H, W) mm, are the heights' standard
    deviations, which determine weights as in `PointCloud.fit`. Uncertainties are from `covariance`. The mean
    standard deviation is added to that of the height, because heights may have a common error. If errors of
    heights are correlated over a ``noise_length``, mm, infinity for integrated slopes, uncertainties are at
    least those that follow from ``sigma``; see `mirrorskin.engine.measure`. Of independent errors, of length
    0, only a share is common.

    Examples
    --------
    >>> round(fit_plane([[0, 1], [0, 1]], x=[0, 1], y=[1, 0]).tilt.value, 6)
    45.0
    """
    cloud, form = PointCloud.of(height, x, y, sigma, noise_length), _PlaneForm()
    fit = cloud.fit(form) if cloud.sigma.size >= 3 else None
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

    lift = 0

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
) -> Sphere:
    """Fit a sphere to a height map by least squares of the distances from it; see `fit_plane`.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(-1, 1, 9)
    >>> round(fit_sphere(np.sqrt(25 - x**2 - x[:, None] ** 2), x, -x).radius.value, 6)
    5.0
    """
    cloud = PointCloud.of(height, x, y, sigma, noise_length)
    form = _SphereForm.of(cloud.points)
    fit = None if form is None else cloud.fit(form)
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
