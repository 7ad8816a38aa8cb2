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


class FollowingHeights:
    """Integrate the newest normals, one solver step at a time; estimates during a step are skipped.

    Attributes
    ----------
    height : ndarray, (H, W), float32, or None
        Heights of the last finished step, mm; NaN where undefined.
    """

    def __init__(self, device: Device, shape: tuple[int, int], pixel_size: ArrayLike) -> None:
        device = device.with_new_queue()
        self._slopes = SlopeKernels(device, shape)
        self._integrator = WarmStartIntegrator(device, shape, pixel_size)
        self._thread = ThreadPoolExecutor(1, "heights")
        self._step: Future[NDArray[np.float32]] | None = None
        self.height: NDArray[np.float32] | None = None
        self._in_step = self._estimates = self._in_height = 0  # numbers of estimates: current, all, shown

    @property
    def lag(self) -> int:
        """Number of estimates of normals since the one that was integrated."""
        return self._estimates - self._in_height

    def follow(self, normals: NormalWindow) -> None:
        """Start a step with the normals that are being estimated, unless one is still running."""
        self.wait(0.0)
        self._estimates += 1
        if self._step is not None:
            return
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

    def _solve(self, typical: float) -> NDArray[Any]:
        self._integrator.push(typical)
        return self._integrator.result()
