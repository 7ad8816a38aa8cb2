"""Coarse height of the object in the sensor's body, from the normals of a rotation and the press."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.integration.arrays import integrate_arrays
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

Mask = NDArray[np.bool_]
_CELLS = 512  # maximum number of cells along the longer side
_GAP = 0.3  # mm: gaps between normals that are filled
_FILLED = 0.03  # weight of a filled slope relative to others
_TOLERANCE = 1e-3


def coarse_heights(
    vectors: NDArray[np.float32],
    contact: NDArray[np.uint8],
    too_level: Mask,
    pixel_size: tuple[float, float],
    press: float,
    device: Device,
) -> Doubles:
    """Return the height of the sheet above its rest plane in the mean pose, (H, W), mm, from 0 to the press.

    Slopes are integrated; the highest point of each component is assumed to be at the depth of the press.
    Pixels without a normal get the nearest slope, as at a crease. Where the surface is too level to be
    visible, this slope decreases towards the middle, as on a ball. Outside the contact, the nearest height is
    used. Without any contact, all heights equal the press.
    """
    import cv2
    from scipy import ndimage

    shape = contact.shape
    step = -(-max(shape) // _CELLS)
    east, north, coverage, level = _cells(vectors, contact, too_level, step)
    valid = coverage > 0
    if not valid.any():
        return np.full(shape, float(press))
    size = step * pixel_size[0], step * pixel_size[1]
    reach = max(1, math.ceil(_GAP / 2 / min(size)))
    around = np.ones((3, 3))
    region = ndimage.binary_fill_holes(ndimage.binary_dilation(valid, around, reach))
    inside = valid | ndimage.binary_erosion(region, around, reach, border_value=1)
    far, nearest = ndimage.distance_transform_edt(~valid, return_indices=True)
    unlit = region & ~valid & (level > 0.5)
    count, hole = cv2.connectedComponents(unlit.view(np.uint8), connectivity=8)
    deepest = np.append(np.inf, ndimage.maximum(far, hole, np.arange(1, count)))[hole]
    remaining = np.asarray(1 - np.minimum(far / (deepest + 0.5), 1))  # of the nearest slope
    surface = integrate_arrays(
        remaining * east[tuple(nearest)],
        remaining * north[tuple(nearest)],
        size,
        mask=region,
        slope_weights=np.where(valid, 1.0, _FILLED),
        sigma=False,
        tolerance=_TOLERANCE,
        device=device,
    )
    label = np.where(inside, surface.component, -1)
    tops = ndimage.maximum(surface.height, label, np.arange(surface.component.max() + 1))
    heights = np.where(label >= 0, surface.height - np.asarray(tops)[label], np.nan)
    places = np.meshgrid(*((np.arange(length) + 0.5) / step - 0.5 for length in shape), indexing="ij")
    interpolated = ndimage.map_coordinates(fill_with_nearest(heights), places, order=1, mode="nearest")
    return np.asarray(np.clip(press + interpolated, 0.0, max(press, 0.0)))


def _cells(vectors: NDArray[np.float32], contact: NDArray[np.uint8], too_level: Mask, step: int) -> Doubles:
    """Return means over cells of ``step`` pixels a side, (4, h, w).

    These are the slopes along x and y, the share of pixels with a slope, and the share of too level pixels.
    """
    x, y, z = np.moveaxis(vectors.astype(np.float64), -1, 0)
    valid = (contact != 0) & (z > 0)
    flat = np.where(valid, z, 1.0)
    maps = np.stack([np.where(valid, -x / flat, 0), np.where(valid, -y / flat, 0), valid, too_level])
    rows, columns = (-(-length // step) * step for length in contact.shape)
    padded = np.pad(maps, ((0, 0), (0, rows - contact.shape[0]), (0, columns - contact.shape[1])))
    means: Doubles = padded.reshape(4, rows // step, step, columns // step, step).mean(axis=(2, 4))
    means[:2] /= np.where(means[2] > 0, means[2], 1)
    return means
