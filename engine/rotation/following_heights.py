"""Heights that follow the normals while the body moves, in a separate thread and on a separate queue."""

from __future__ import annotations

import math
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.normals_to_height import SlopeKernels
from mirrorskin.engine.integration.warm_start import WarmStartIntegrator
from mirrorskin.engine.rotation.normals_window import NormalWindow
from mirrorskin.kernels.device import Device

Part = tuple[slice, slice]

_GRID = 64  # pixels of which the borders of a part are multiples
_ALIGNED = 8  # pixels of which its width is a multiple
_SMALLER = 0.7  # area relative to that of the present part below which a smaller one is worth a new start
_PATIENCE = 8  # steps for which contact stays in a smaller part before it is used; they double if it leaves


class FollowingHeights:
    """Integrate the newest normals, one solver step at a time; estimates during a step are skipped.

    Only the part of the picture around the contact is integrated. Where contact leaves it, heights start
    anew.

    Attributes
    ----------
    height : ndarray, (H, W), float32, or None
        Heights of the last finished step, mm; NaN where undefined.
    """

    def __init__(self, device: Device, shape: tuple[int, int], pixel_size: ArrayLike) -> None:
        self._device, self._shape, self._pixel_size = device.with_new_queue(), shape, pixel_size
        self._patience, self._smaller = _PATIENCE, 0
        self._use((slice(0, shape[0]), slice(0, shape[1])), math.nan)
        self._thread = ThreadPoolExecutor(1, "heights")
        self._step: Future[NDArray[np.float32]] | None = None
        self.height: NDArray[np.float32] | None = None
        self._in_step = self._estimates = self._in_height = 0  # numbers of estimates: current, all, shown

    @property
    def lag(self) -> int:
        """Number of estimates of normals since the one that was integrated."""
        return self._estimates - self._in_height

    def follow(self, normals: NormalWindow, contact: NDArray[np.uint8]) -> None:
        """Start a step with the estimated normals and their contact, unless one is still running."""
        self.wait(0.0)
        self._estimates += 1
        if self._step is not None:
            return
        self._choose_part(contact)
        maps = {name: normals.maps.array(name) for name in ("vectors", "sigma", "contact")}
        for array in maps.values():  # this queue waits for the estimate
            array.arrived = array.latest
        self._slopes.find(normals.model.tilt, maps, self._integrator.maps)
        for array in maps.values():  # the next estimate waits for the slopes
            array.arrived = array.latest
        self._in_step = self._estimates
        self._step = self._thread.submit(self._solve, self._slopes.typical)

    def wait(self, seconds: float) -> None:
        """Wait for the running step, with a timeout, and take its heights."""
        if self._step is not None:
            finished, _ = wait_for([self._step], None if seconds == math.inf else max(0.0, seconds))
            if finished:
                step, self._step = self._step, None
                self.height, self._in_height = step.result(), self._in_step

    def _use(self, part: Part, typical: float) -> None:
        """Integrate a part of the picture from now on."""
        shape = part[0].stop - part[0].start, part[1].stop - part[1].start
        self._part = part
        self._slopes = SlopeKernels(self._device, part, self._shape[1], typical)
        self._integrator = WarmStartIntegrator(self._device, shape, self._pixel_size)

    def _choose_part(self, contact: NDArray[np.uint8]) -> None:
        """Use another part if contact has left the present one, or has been in a smaller one for long."""
        needed = part_around(contact)
        if needed is None:
            return
        if not all(a.start <= b.start and b.stop <= a.stop for a, b in zip(self._part, needed, strict=True)):
            self._patience *= 2
            self._smaller = 0
            self._use(needed, self._slopes.typical)
            return
        self._smaller = self._smaller + 1 if _area(needed) < _SMALLER * _area(self._part) else 0
        if self._smaller >= self._patience:
            self._smaller = 0
            self._use(needed, self._slopes.typical)

    def _solve(self, typical: float) -> NDArray[Any]:
        self._integrator.push(typical)
        inside = self._integrator.result()
        if inside.shape == self._shape:
            return inside
        height = np.full(self._shape, np.nan, np.float32)
        height[self._part] = inside
        return height


def part_around(contact: NDArray[np.uint8]) -> Part | None:
    """Return the part of a picture that contains its contact, in steps of a grid; None without contact.

    If it is narrower than the picture, its width is a multiple of 8.
    """
    slices = []
    for axis, size in zip((1, 0), contact.shape, strict=True):
        places = np.flatnonzero(contact.any(axis=axis))
        if not places.size:
            return None
        start, stop = int(places[0]) // _GRID * _GRID, min(size, (int(places[-1]) // _GRID + 1) * _GRID)
        slices.append(slice(start, stop))
    rows, columns = slices
    unaligned = (columns.start - columns.stop) % _ALIGNED
    return rows, slice(max(0, columns.start - unaligned), columns.stop)


def _area(part: Part) -> int:
    rows, columns = part
    return int((rows.stop - rows.start) * (columns.stop - columns.start))
