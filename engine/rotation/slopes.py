"""From normals to slopes, and how sure those are along x and y."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float32]

_STEEPEST = math.radians(80.0)  # zenith beyond which a slope would grow without bounds
_AROUND = 5  # pixels across, from which the meridian's direction is taken
_WIDEST = 0.5  # radians: standard deviation of an azimuth beyond which its mean cosine is no longer made good


@dataclass(frozen=True, slots=True)
class Slopes:
    """How much the surface rises along x, and along y, which runs up the picture.

    Attributes
    ----------
    dz_dx, dz_dy : ndarray, (H, W), float32
        Without unit; NaN where there is none.
    weights : ndarray, (2, H, W), float32
        Inverse variances of both; 0 where there is none.
    """

    dz_dx: Floats
    dz_dy: Floats
    weights: Floats

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where there are slopes, (H, W)."""
        return np.asarray(self.weights[0] > 0)


def find_slopes(
    vectors: NDArray[np.float32],
    sigma: NDArray[np.float32],
    contact: NDArray[np.uint8],
    tilt: float | None,
    turns: int = 1,
    white: NDArray[np.float32] | None = None,
) -> Slopes:
    """Turn the normals of a rotation into slopes, -n_x / n_z and -n_y / n_z.

    *How sure they are.* Samples are distances from the axis, which goes round on a circle of radius d: they
    tell a zenith far better than an azimuth. Of the information of samples evenly round the circle the share
    that is across the meridian is ::

        q = 1/2 within the circle,  sin(d)^2 / (2 sin(zenith)^2) without

    so the variance sigma^2 of an angular error is sigma^2 q along the meridian, sigma^2 (1 - q) across. An
    error along it changes the slope by 1/cos(zenith)^2, one across it by 1/cos(zenith). Along x and y these
    two are mixed; that their errors go together is not told.

    *Bias.* An azimuth that is uncertain by s makes the mean of its vectors shorter by exp(-s^2 / 2), and
    a surface of them flatter. Slopes are made longer by as much.

    Parameters
    ----------
    vectors : ndarray, (H, W, 3), float32
        Unit normals; NaN where there is none.
    sigma : ndarray, (H, W), float32
        Their RMS angular error, radians.
    contact : ndarray, (H, W), uint8
        0 where they mean nothing.
    tilt : float or None
        Half-angle d of the precession, radians. None: errors are the same in all directions.
    turns : int
        Of how many turns the normals are the mean.
    white : ndarray, (H, W), float32, optional
        What to weigh slopes by instead of ``sigma``, where errors of neighbours are alike: those independent
        errors of which as much is left in a mean over many pixels.

    Returns
    -------
    Slopes
        Finite: a surface steeper than 80 degrees is taken to be as steep as that.
    """
    nx, ny, nz = np.moveaxis(vectors, -1, 0)
    white = sigma if white is None else white
    known = (contact != 0) & (nz > 0) & (sigma > 0) & (sigma < np.inf) & (white > 0) & (white < np.inf)
    nx, ny, nz, sigma, white = (np.where(known, one, np.float32(1)) for one in (nx, ny, nz, sigma, white))
    nz = np.maximum(nz, np.float32(math.cos(_STEEPEST)))
    longer = np.exp(0.5 * _turned(nx, ny, sigma, tilt, turns))
    nothing = np.float32(np.nan)
    variances = _variances(nx, ny, nz, white, tilt, known)
    return Slopes(
        dz_dx=np.where(known, -longer * nx / nz, nothing).astype(np.float32),
        dz_dy=np.where(known, -longer * ny / nz, nothing).astype(np.float32),
        weights=np.stack([np.where(known, 1 / one, 0) for one in variances]).astype(np.float32),
    )


def _share_along(nx: Floats, ny: Floats, tilt: float | None) -> Floats:
    """Return the share of an angular error's variance that is along the meridian."""
    if tilt is None:
        return np.full(nx.shape, 0.5, np.float32)
    least = math.sin(tilt) ** 2
    return np.asarray(0.5 * least / np.maximum(nx * nx + ny * ny, least), np.float32)


def _turned(nx: Floats, ny: Floats, sigma: Floats, tilt: float | None, turns: int = 1) -> Floats:
    """Return the variance of the azimuth in one turn, radians^2, within bounds; 0 without a tilt."""
    if tilt is None:
        return np.zeros(nx.shape, np.float32)
    outside = np.maximum(nx * nx + ny * ny, math.sin(tilt) ** 2)
    variance = turns * (1 - _share_along(nx, ny, tilt)) * sigma**2 / outside
    return np.asarray(np.minimum(variance, _WIDEST**2), np.float32)


def _east(nx: Floats, ny: Floats, known: NDArray[np.bool_], turned: Floats) -> Floats:
    """Return the square of the azimuth's cosine, from the normals around.

    By its own azimuth, a slope that noise has made shorter would be given another weight than one that it has
    made longer, and the weighted mean would be wrong. Squares do not mind which way a ridge faces. Noise of
    the azimuth, of the variance ``turned``, makes their means more alike, by exp(-2 turned).
    """
    x, y = (ndimage.uniform_filter(np.where(known, n * n, 0), _AROUND, mode="constant") for n in (nx, ny))
    least = np.finfo(np.float32).tiny
    east = (x + least) / (x + y + 2 * least)
    return np.asarray(np.clip(0.5 + (east - 0.5) * np.exp(2 * turned), 0, 1), np.float32)


def _variances(
    nx: Floats, ny: Floats, nz: Floats, sigma: Floats, tilt: float | None, known: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Return the variances of the slopes along x and y."""
    share, turned = _share_along(nx, ny, tilt), _turned(nx, ny, sigma, tilt)
    # An azimuth that is off by e makes a slope shorter by e^2 / 2 of it, besides what it does across.
    along = share * (sigma / nz**2) ** 2 + (nx * nx + ny * ny) / nz**2 * turned**2 / 2
    across = (1 - share) * (sigma / nz) ** 2
    east = _east(nx, ny, known, turned)
    along_x, along_y = east * along + (1 - east) * across, (1 - east) * along + east * across
    return along_x.astype(np.float32), along_y.astype(np.float32)
