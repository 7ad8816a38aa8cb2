"""Undistortion: resampling of maps from a camera's pixels to equal pixels on the sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.resample import SamplePoints
from mirrorskin.io import InputError, Lens, Result, pixel_axes
from mirrorskin.io.model.maps import Map
from mirrorskin.io.model.result import map_shape
from mirrorskin.kernels.array_types import Doubles


def picture_places(lens: Lens, x: ArrayLike, y: ArrayLike) -> tuple[Doubles, Doubles]:
    """Return the columns and rows of the picture, from 0, at which points of the sheet are seen.

    Points are in mm from the middle of the undistorted map, y up. NaN for points that the camera cannot see.
    """
    across, up = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    rays = _rays(lens, np.stack([across.ravel(), up.ravel(), np.ones(across.size)]))
    projected = lens.matrix @ distorted(rays, lens.distortion)
    # Written such that a NaN ray remains NaN.
    projected[:, ~(rays[0] ** 2 + rays[1] ** 2 < _fold(lens.distortion))] = np.nan
    return projected[0].reshape(across.shape), projected[1].reshape(across.shape)


def distorted(rays: Doubles, distortion: ArrayLike) -> Doubles:
    """Return rays distorted by OpenCV's model."""
    k1, k2, p1, p2, k3 = np.moveaxis(np.asarray(distortion, np.float64), -1, 0)[..., np.newaxis]
    x, y = rays[..., 0, :], rays[..., 1, :]
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    result = np.ones_like(rays)
    result[..., 0, :] = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    result[..., 1, :] = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return result


def _fold(distortion: Doubles) -> float:
    """Return the squared radius at which the distorted radius stops growing."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    ahead = roots.real[(abs(roots.imag) <= 1e-9 * abs(roots)) & (roots.real > 0)]
    return float(ahead.min(initial=math.inf))


def _rays(lens: Lens, points: Doubles) -> Doubles:
    """Return the rays, (3, n), to points of the sheet; NaN for points behind the camera."""
    whole = lens.camera @ lens.matrix
    normalised = np.linalg.solve(whole, points)
    # The picture's centre is in front of the camera.
    ahead = normalised[2] * np.linalg.solve(whole, [0.0, 0.0, 1.0])[2] > 0
    return np.asarray(normalised / np.where(ahead, normalised[2], np.nan))


Maps = dict[str, NDArray[Any]]

_BAND = 1 << 14  # pixels that are resampled at once


def undistort(result: Result, lens: Lens, origin: tuple[int, int] | None = None) -> Result:
    """Resample the maps of a result from the camera's pixels to equal pixels on the sheet.

    Each map is sampled according to its declaration; see `mirrorskin.io.Map`. Numbers are interpolated
    between four pixels. The result is undefined where the nearest pixel is undefined. Of the other three,
    pixels that are undefined or have another label are excluded: heights are not interpolated between
    components, nor other maps across the border of contact. Integers, such as codes and components, are taken
    from the nearest pixel. Positions that the camera did not see are undefined. If a position coincides with
    a pixel within a millionth of a pixel, its value is copied.

    Directions are normalised after interpolation. They are not rotated: a normal is estimated from
    brightness, in the directions of the sensor's light, and does not depend on its position in the picture.
    The axes of the map are parallel to those of the picture at its centre. Zenith and azimuth are computed
    from the normals; without normals, azimuths are interpolated along the shorter arc.

    Standard deviations are interpolated like numbers: this is correct if neighbours have a common error, and
    too large, never too small, if their errors are independent.

    The integration of normals in the camera's pixels assumes pixels of equal size. If this is too inaccurate,
    undistort only the normals, and integrate them on the sheet.

    Parameters
    ----------
    result : Result
        Maps in the camera's pixels, also for each turn.
    lens : Lens
    origin : (int, int), optional
        Row and column of the maps' first pixel in the full picture; by default from the region in ``fitted``
        of the result. The same region of the undistorted maps is returned.

    Raises
    ------
    mirrorskin.io.InputError
        The maps do not fit the lens, or have already been undistorted.
    """
    if result.fitted.undistorted:
        raise InputError("these maps were undistorted before, which is done once: take them as they are")
    maps = result.maps()
    if not maps:
        raise InputError("there are no maps to undistort: reconstruct first")
    *turns, rows, columns = map_shape(result)
    declared = {name: result.declaration(name) for name in maps}
    if any(
        maps[name].ndim > len(turns) + 2 + bool(declaration.components)
        for name, declaration in declared.items()
    ):
        raise InputError("displacements of each frame cannot be undistorted: leave per_frame out")
    region = result.fitted.region
    row, column = (region.origin if region else (0, 0)) if origin is None else origin
    if min(row, column) < 0 or row + rows > lens.shape[0] or column + columns > lens.shape[1]:
        raise InputError(
            f"maps of {columns} x {rows} pixels from column {column}, row {row} on are not in the picture of "
            f"{lens.shape[1]} x {lens.shape[0]} that the lens is of: calibrate again"
        )
    across, up = pixel_axes(lens.shape, lens.pixel_size)
    x, y = across[column : column + columns], up[row : row + rows]
    undistorted = {name: np.empty_like(values) for name, values in maps.items()}
    height = max(1, _BAND // columns)
    for band in (slice(first, min(first + height, rows)) for first in range(0, rows, height)):
        pixels = picture_places(lens, *np.meshgrid(x, y[band]))
        points = SamplePoints.at(pixels[0].ravel() - column, pixels[1].ravel() - row, (rows, columns))
        turn: Any
        for turn in range(turns[0]) if turns else [...]:
            resampled = _resampled({name: values[turn] for name, values in maps.items()}, declared, points)
            for name, values in resampled.items():
                target = undistorted[name][turn][band]
                target[...] = values.reshape(target.shape)
    return result.assign(undistorted, x=x, y=y).with_fitted(undistorted=True)


def _resampled(maps: Maps, declared: Mapping[str, Map], points: SamplePoints) -> Maps:
    """Return all maps of one picture at points, (n,) or (n, components)."""
    labels = {declaration.within for declaration in declared.values() if declaration.within in maps}
    same = {name: points.same_label(maps[name]) for name in labels}
    resampled = {name: _sample(values, declared[name], same, points) for name, values in maps.items()}
    return resampled | _directions(maps, resampled, points)


def _sample(
    values: NDArray[Any], declared: Map, same: Mapping[str, NDArray[np.bool_]], points: SamplePoints
) -> NDArray[Any]:
    """Return one map at points, according to its declaration; ``same`` are neighbours with equal labels."""
    count = same.get(declared.within)
    if values.dtype.kind != "f" or declared.sampling == "nearest":
        outside = declared.undefined_value if values.dtype.kind == "f" else int(declared.undefined or 0)
        return points.nearest_values(values, outside)
    if declared.undefined is not None:  # interpolation skips NaN
        with_nan = np.where(values == declared.undefined, values.dtype.type(np.nan), values)
        sampled = _sample(with_nan, msgspec.structs.replace(declared, undefined=None), same, points)
        return np.where(np.isnan(sampled), values.dtype.type(declared.undefined), sampled)
    if declared.sampling == "direction":
        return points.interpolate_vectors(values, count)
    if declared.components:
        parts = [points.interpolate(part, count) for part in np.moveaxis(values, -1, 0)]
        return np.stack(parts, axis=-1)
    if declared.sampling == "angle":
        return points.interpolate_angles(values, count)
    return points.interpolate(values, count)


def _directions(maps: Maps, resampled: Maps, points: SamplePoints) -> Maps:
    """Return zenith and azimuth, if available, of the resampled normals; those at pixels do not change."""
    if "normals" not in maps:
        return {}
    x, y, z = resampled["normals"].T
    across = np.hypot(x, y)
    level = np.where(across == 0, np.float32(np.nan), np.float32(0))
    angles = {"zenith": np.arctan2(across, z), "azimuth": np.arctan2(y, x) + level}
    return {
        name: np.where(points.on_pixel, points.nearest_values(maps[name], np.nan), angle)
        for name, angle in angles.items()
        if name in maps
    }
