"""How high the object stands in the sensor's body: coarsely, from the normals of a rotation and the press."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.integration import integrate
from mirrorskin.engine.nearest_fill import fill_with_nearest
from mirrorskin.engine.rotation.design_matrix import Doubles
from mirrorskin.kernels.device import Device

Mask = NDArray[np.bool_]

_CELLS = 512  # along the longer side, at most
_GAP = 0.3  # mm between normals across which the surface goes on
_FILLED = 0.03  # weight of a slope that was filled in
_TOLERANCE = 1e-3


def coarse_heights(
    vectors: NDArray[np.float32],
    contact: NDArray[np.uint8],
    too_level: Mask,
    pixel_size: tuple[float, float],
    press: float,
    device: Device,
) -> Doubles:
    """Return the height of the sheet above its rest plane in the mean pose.

    Slopes are integrated; the highest point of each component is taken to be as high as the body was pressed.
    Where no normal is known, the nearest slope is taken, as over a crease; where that is because the surface
    is too level to be seen, it becomes less towards the middle, as on a ball. Beyond them, the nearest
    height is taken. Heights are finite, from 0 to the press, mm; the press where there is no contact at all.
    """
    from scipy import ndimage

    shape = contact.shape
    step = -(-max(shape) // _CELLS)
    east, north, share, level = _cells(vectors, contact, too_level, step)
    known = share > 0
    if not known.any():
        return np.full(shape, float(press))
    size = step * pixel_size[0], step * pixel_size[1]
    reach = max(1, math.ceil(_GAP / 2 / min(size)))
    around = np.ones((3, 3))
    region = ndimage.binary_fill_holes(ndimage.binary_dilation(known, around, reach))
    inside = known | ndimage.binary_erosion(region, around, reach, border_value=1)
    far, nearest = ndimage.distance_transform_edt(~known, return_indices=True)
    remaining = _remaining(far, region & ~known & (level > 0.5))
    surface = integrate(
        remaining * east[tuple(nearest)],
        remaining * north[tuple(nearest)],
        size,
        mask=region,
        slope_weights=np.where(known, 1.0, _FILLED),
        sigma=False,
        tolerance=_TOLERANCE,
        device=device,
    )
    label = np.where(inside, surface.component, -1)
    tops = ndimage.maximum(surface.height, label, np.arange(surface.component.max() + 1))
    heights = np.where(label >= 0, surface.height - np.asarray(tops)[label], np.nan)
    places = np.meshgrid(*((np.arange(length) + 0.5) / step - 0.5 for length in shape), indexing="ij")
    found = ndimage.map_coordinates(fill_with_nearest(heights), places, order=1, mode="nearest")
    return np.asarray(np.clip(press + found, 0.0, max(press, 0.0)))


def _cells(vectors: NDArray[np.float32], contact: NDArray[np.uint8], too_level: Mask, step: int) -> Doubles:
    """Return means over cells of ``step`` pixels a side, (4, h, w).

    Slopes along x and y, the share of pixels of which they are known, and of those that are too level.
    """
    x, y, z = np.moveaxis(vectors.astype(np.float64), -1, 0)
    known = (contact != 0) & (z > 0)
    flat = np.where(known, z, 1.0)
    maps = np.stack([np.where(known, -x / flat, 0), np.where(known, -y / flat, 0), known, too_level])
    rows, columns = (-(-length // step) * step for length in contact.shape)
    padded = np.pad(maps, ((0, 0), (0, rows - contact.shape[0]), (0, columns - contact.shape[1])))
    means: Doubles = padded.reshape(4, rows // step, step, columns // step, step).mean(axis=(2, 4))
    means[:2] /= np.where(means[2] > 0, means[2], 1)
    return means


def _remaining(far: Doubles, level: Mask) -> Doubles:
    """Return which share of the nearest slope is left in each cell, at its distance."""
    from scipy import ndimage

    hole, count = ndimage.label(level, np.ones((3, 3)))
    deepest = np.concatenate([[np.inf], ndimage.maximum(far, hole, np.arange(1, count + 1))])[hole]
    return np.asarray(1 - np.minimum(far / (deepest + 0.5), 1))
