"""Planes through height maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.measure.association import associate
from mirrorskin.engine.measure.cloud import Cloud, degrees, spread
from mirrorskin.engine.measure.quantity import Quantity
from mirrorskin.io import InputError

Doubles = NDArray[np.float64]

_POINTS = 3
_LEVEL = 1e-12  # slope
_ANYWHERE = math.pi / math.sqrt(3)  # standard deviation of any angle, radians


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """The plane that fits a height map.

    Attributes
    ----------
    tilt : Quantity
        Between its normal and z, degrees.
    azimuth : Quantity
        Of the direction in which it falls, counter-clockwise from x, degrees.
    offset : Quantity
        Its height at x = y = 0, mm.
    rms : Quantity
        Root mean square of the distances that are left, of outliers too, µm.
    residual : ndarray, (H, W), float64
        Distances from it, mm, positive on the camera's side; NaN where there is no height.
    outliers : int
        Pixels that did not count.
    birge : float
        Residual over what standard deviations make it; see `Association`.
    """

    tilt: Quantity
    azimuth: Quantity
    offset: Quantity
    rms: Quantity
    residual: Doubles
    outliers: int
    birge: float

    def quantities(self) -> dict[str, Quantity]:
        """Return what it tells, by name."""
        return {
            "plane tilt": self.tilt,
            "plane azimuth": self.azimuth,
            "plane height at centre": self.offset,
            "plane residual RMS": self.rms,
        }


def fit_plane(height: ArrayLike, x: ArrayLike, y: ArrayLike, sigma: ArrayLike | None = None) -> Plane:
    """Fit a plane to a height map by least squares.

    Parameters
    ----------
    height : array_like, (H, W)
        Millimetres; NaN where there is none.
    x, y : array_like, (W,) and (H,)
        Millimetres of the pixel centres.
    sigma : array_like, (H, W), optional
        Standard deviations of the heights, mm; see `associate` for how they weigh.

    Returns
    -------
    Plane
        Uncertainties are those of `covariance`; to that of its height comes the mean standard deviation of
        the heights, which may all be wrong together.

    Raises
    ------
    InputError
        Fewer than three pixels, or all of them in one line.
    """
    cloud, form = Cloud.of(height, x, y, sigma), _Form()
    found = associate(form, cloud.points, cloud.sigma) if cloud.sigma.size >= _POINTS else None
    if found is None:
        raise InputError("no plane fits: at least three pixels that are not in one line are needed")
    offset, p, q = found.parameters
    slope = math.hypot(p, q)
    level = slope < _LEVEL
    cos, sin = (1.0, 0.0) if level else (p / slope, q / slope)
    along, across = spread(found.covariance, 0, cos, sin), spread(found.covariance, 0, -sin, cos)
    # A level plane falls nowhere: its azimuth is anything within half a turn.
    turn = _ANYWHERE if level else min(across / slope, _ANYWHERE)
    distance = form.distance(cloud.points, found.parameters) / math.sqrt(1 + slope**2)
    residual, rms = cloud.residual(distance)
    return Plane(
        degrees(math.atan(slope), along / (1 + slope**2)),
        degrees(0.0 if level else math.atan2(-q, -p), turn),
        Quantity(float(offset), math.hypot(spread(found.covariance, 1, 0, 0), cloud.common), "mm"),
        rms,
        residual,
        int(np.count_nonzero(~found.kept)),
        found.birge,
    )


class _Form:
    """Planes by offset and slopes along x and y; distances are along z, as errors are.

    All are the same multiple of the orthogonal ones.
    """

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
