"""How far the normals are off that a fitted wall tells."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mirrorskin.engine.calibration.ball.scene import rotations
from mirrorskin.engine.calibration.wall import curve
from mirrorskin.engine.calibration.wall.fit import WallFit
from mirrorskin.engine.calibration.wall.model import (
    SCALES,
    SENSOR,
    STEPS,
    Met,
    Samples,
    down,
    light_of,
    look,
    meet_balls,
    split,
)
from mirrorskin.io import InputError, Source, pixel_axes

Doubles = NDArray[np.float64]

_SIDE = 5  # places along a side at which errors are worked out
_TURN = 8  # azimuths there
_LEAN = math.radians(2.5)  # of a usual rotation; errors of the normals hardly depend on it
_FRAMES = 8
_STEP = 1e-4  # radians, of differences
_SMALL = 1e-3  # step of a parameter, as a share of its scale
_WILD = 3.0  # times the noise that a sample is taken to be off at most
_RINGS, _OCTANTS = 6, 8  # cells of a press whose mean residual is told from noise


def error_places(source: Source) -> tuple[Doubles, Doubles]:
    """Return places over the picture, (2, n), mm, and azimuths, (n,): every azimuth at every place."""
    pixel_size = source.header.pixel_size
    if pixel_size is None:
        raise InputError(f"{source.name}: its pixel size is not told: give it, as in --pixel-size 0.03mm")
    x, y = pixel_axes(source.shape[1:], pixel_size)
    grid = np.meshgrid(*(np.linspace(axis[0], axis[-1], _SIDE) for axis in (x, y)))
    places = np.repeat(np.stack([axis.ravel() for axis in grid]), _TURN, axis=1)
    return places, np.tile(np.arange(_TURN) * 2 * np.pi / _TURN, _SIDE * _SIDE)


def error_maps(
    fit: WallFit, shape: tuple[int, int], places: Doubles, azimuth: Doubles, zenith: Doubles
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the standard deviations of zenith, and of azimuth times the zenith's sine, (H, W), radians.

    What a fit says of the light of 8 frames is off by its slopes times the parameters' errors, and the normal
    of least squares by what comes of that. The root of the mean square over the azimuths is told; NaN where
    none of them shows the wall.

    Parameters
    ----------
    fit : WallFit
    shape : (int, int)
        Rows and columns of the picture.
    places, azimuth : ndarray
        Of `error_places`.
    zenith : ndarray, (n,), float64
        Of the normals there, radians; NaN where the wall is not seen.
    """
    seen = np.isfinite(zenith)
    slopes = np.full((2, len(zenith), STEPS.stop), np.nan)
    slopes[:, seen] = _normal_slopes(fit, places[:, seen], azimuth[seen], zenith[seen])
    covariance = fit.covariance[: STEPS.stop, : STEPS.stop]
    variance = np.einsum("inp,pq,inq->in", slopes, covariance, slopes).reshape(2, -1, _TURN)
    known = np.isfinite(variance)
    count = np.where(known.any(axis=-1), known.sum(axis=-1), np.nan)
    mean = np.where(known, variance, 0).sum(axis=-1) / count
    coarse = np.sqrt(mean).reshape(2, _SIDE, _SIDE)
    # Rows go down the picture as the coarse ones do: both follow the pixels' axes.
    where = np.meshgrid(*(np.linspace(0, _SIDE - 1, size) for size in shape), indexing="ij")
    zenith_sigma, azimuth_sigma = (
        ndimage.map_coordinates(one, where, order=1, mode="nearest").astype(np.float32) for one in coarse
    )
    return zenith_sigma, azimuth_sigma


def error_left(samples: Samples, fit: WallFit, noise: Doubles) -> tuple[float, float]:
    """Return the RMS error of the zenith that the fit leaves on the balls, and its upper end, radians.

    Told by the mean residuals of cells, octants of some rings of each ball, whose noise averages out. The
    first is what is left beyond noise, 0 where that is none; the upper end is what one standard error of its
    square more would be, which noise never lets be 0.
    """
    named, steps, centres = split(fit.parameters)
    met = meet_balls(samples, named, centres)
    coefficients = curve.from_steps(fit.rising) @ steps
    flat = np.hypot(met.normal[0], met.normal[1])
    steeper = np.cos(_STEP) * met.normal + np.sin(_STEP) * np.stack(
        [*(met.normal[:2] * met.normal[2] / np.maximum(flat, _STEP)), -flat]
    )
    light = light_of(met, named, coefficients)
    slope = (light_of(met._replace(normal=steeper), named, coefficients) - light) / _STEP
    turn = np.arctan2(met.normal[1], met.normal[0]) / (2 * np.pi) + 0.5
    octant = np.minimum((turn * _OCTANTS).astype(np.intp), _OCTANTS - 1)
    ring = np.minimum((flat / flat.max() * _RINGS).astype(np.intp), _RINGS - 1)
    cell = (samples.press[samples.pose] * _RINGS + ring) * _OCTANTS + octant
    off = np.clip(samples.light - light, -_WILD * noise, _WILD * noise)
    summed = np.ones_like(light), off, noise**2, slope**2
    count, left, expected, steep = (np.bincount(cell, values) for values in summed)
    # A mean's square less what noise makes of it, summed over samples.
    known = count > 0
    share = expected[known] / count[known]
    excess = max(0.0, float(np.sum(left[known] ** 2 / count[known] - share)))
    # The square of a normal number of variance v has variance 2 v^2.
    chance = math.sqrt(2 * float(np.sum(share**2)))
    over = max(float(np.sum(steep)), 1e-12)
    return math.sqrt(excess / over), math.sqrt((excess + chance) / over)


def _normal_slopes(fit: WallFit, places: Doubles, azimuth: Doubles, zenith: Doubles) -> Doubles:
    """Return how zenith, and azimuth times its sine, change with the parameters, (2, n, STEPS.stop)."""
    parameters = fit.parameters[: STEPS.stop]

    def light(values: Doubles, theta: Doubles, phi: Doubles) -> Doubles:
        return _turned_light(values, fit.rising, places, theta, phi)

    across = _STEP / np.sin(zenith)
    design = np.stack(
        [
            light(parameters, zenith + _STEP, azimuth) - light(parameters, zenith - _STEP, azimuth),
            light(parameters, zenith, azimuth + across) - light(parameters, zenith, azimuth - across),
        ],
        axis=-1,
    ) / (2 * _STEP)
    by_parameter = np.zeros((*design.shape[:2], len(parameters)))
    scales = [*(SCALES[name] for name in SENSOR), *([1.0] * (STEPS.stop - STEPS.start))]
    for number, step in enumerate(_SMALL * np.array(scales)):
        moved = np.repeat(parameters[np.newaxis], 2, axis=0)
        moved[:, number] += step, -step
        by_parameter[..., number] = (light(moved[0], zenith, azimuth) - light(moved[1], zenith, azimuth)) / (
            2 * step
        )
    return np.asarray(np.moveaxis(-np.linalg.pinv(design, rcond=1e-6) @ by_parameter, 1, 0), np.float64)


def _turned_light(
    parameters: Doubles, rising: bool, places: Doubles, zenith: Doubles, azimuth: Doubles
) -> Doubles:
    """Return the light of normals at places on the rest plane in the frames of a rotation, (n, frames)."""
    named, steps, _ = split(parameters)
    phase = np.arange(_FRAMES) * 2 * np.pi / _FRAMES
    turns = rotations(_LEAN * np.stack([np.cos(phase), np.sin(phase)], axis=1))
    upright = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    normal = np.moveaxis(turns @ upright, 0, -1).reshape(3, -1)
    from_axis, lean = look(np.repeat(places, _FRAMES, axis=1), named)
    met = Met(from_axis[0], from_axis[1], np.zeros(from_axis.shape[1]), down(lean), normal)
    return light_of(met, named, curve.from_steps(rising) @ steps).reshape(-1, _FRAMES)
