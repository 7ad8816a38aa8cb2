"""Slopes on the device, from normals that are there."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from mirrorskin.engine.frames import SAMPLES
from mirrorskin.engine.integration.inputs import LEAST, MOST
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

_CHUNK, _STRIP = 256, 16  # columns and rows of a work-item that is a core's loop; see slopes.cl
_PARTS = "squares_x", "squares_y"


class SlopeMaps:
    """Turns normals into slopes and weights, as ``find_slopes`` does of one turn, on the device.

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.
    """

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device, self._shape = device, shape
        self._parts = [device.array(name, shape, np.float32) for name in _PARTS]
        for array in self._parts:
            array.upload()
        self.typical = math.nan

    def find(self, tilt: float, normals: Mapping[str, Array], to: Mapping[str, Array]) -> None:
        """Put the work on the device's queue.

        The first time, a weight as there are many is waited for, ``typical``: it bounds weights.

        Parameters
        ----------
        tilt : float
            Half-angle of the precession, radians.
        normals : mapping of str to Array
            ``vectors`` (H, W, 3), ``sigma`` and ``contact`` (H, W), and padding.
        to : mapping of str to Array
            ``dz_dx``, ``dz_dy``, ``weight_x`` and ``weight_y``, (H, W), float32.
        """
        device, (rows, columns) = self._device, self._shape
        pixels = rows * columns
        given = normals["vectors"], normals["sigma"], normals["contact"]
        slopes, weights = (to["dz_dx"], to["dz_dy"]), (to["weight_x"], to["weight_y"])
        width = 8 if device.layout.tile > 1 else 1
        find, weigh = (device.kernel("slopes", f"slopes_{name}", WIDTH=width) for name in ("find", "weigh"))
        least = np.float32(math.sin(tilt) ** 2)
        items = -(-pixels // device.layout.tile)
        find(items, np.int32(pixels), least, *given, *slopes, *self._parts, moved=33 * pixels)
        tile = device.layout.tile
        strip = _STRIP if tile >= _CHUNK else 1
        items = -(-rows // strip) * -(-columns // min(tile, _CHUNK))
        for _ in range(2 if math.isnan(self.typical) else 1):
            typical = 1.0 if math.isnan(self.typical) else self.typical
            free = math.isnan(self.typical)
            bounds = (0.0, math.inf) if free else (LEAST * typical, MOST * typical)
            sizes = np.int32(rows), np.int32(columns), least, *map(np.float32, bounds)
            weigh(items, *sizes, given[1], slopes[0], *self._parts, *weights, moved=24 * pixels)
            if free:
                self.typical = _typical(weights)


def _typical(weights: tuple[Array, Array]) -> float:
    """Return the median of weights above 0, of evenly spread pixels, or NaN where there is none."""
    some = []
    for array in weights:
        step = max(1, math.isqrt(array.host.size // SAMPLES))
        some.append(array.download()[step // 2 :: step, step // 2 :: step].ravel())
    known = np.concatenate(some)
    known = known[known > 0]
    return float(np.median(known)) if known.size else math.nan
