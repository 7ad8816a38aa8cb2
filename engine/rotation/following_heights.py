"""Heights that follow normals at their own rate, in a separate thread and on a separate queue."""

from __future__ import annotations

import math
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.warm_start import WarmStartIntegrator
from mirrorskin.engine.rotation.normals_to_height import SlopeKernels
from mirrorskin.engine.rotation.normals_window import NormalWindow
from mirrorskin.kernels.device import Device


class FollowingHeights:
    """Follow the newest normals for which there was time, one step of a solver each.

    Attributes
    ----------
    height : ndarray, (H, W), float32, or None
        The heights of the last step that is done, mm; NaN where there is no answer.
    lag : int
        Estimates of normals since the one that they are of.
    """

    def __init__(self, device: Device, shape: tuple[int, int], pixel_size: ArrayLike) -> None:
        beside = device.beside()
        self._slopes = SlopeKernels(beside, shape)
        self._integrator = WarmStartIntegrator(beside, shape, pixel_size)
        self._thread = ThreadPoolExecutor(1, "heights")
        self._step: Future[NDArray[np.float32]] | None = None
        self.height: NDArray[np.float32] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the heights so far."""
        if self._step is not None:
            wait_for([self._step])
        self._step, self.height = None, None
        self._taken = self._seen = self._known = 0  # estimates: of the step, in all, of the heights
        self._slopes.typical = math.nan
        self._integrator.reset()

    @property
    def lag(self) -> int:
        """Estimates of normals since the one that the heights are of."""
        return self._seen - self._known

    def follow(self, normals: NormalWindow) -> None:
        """Begin a step towards the normals that are being estimated, unless one is still under way."""
        self.wait(0.0)
        self._seen += 1
        if self._step is not None:
            return
        maps = {name: normals.on_device(name) for name in ("vectors", "sigma", "contact")}
        for array in maps.values():  # which the other queue has to wait for
            array.arrived = array.last_use
        self._slopes.find(normals.model.tilt, maps, self._integrator.maps)
        for array in maps.values():  # and the next estimate for this
            array.arrived = array.last_use
        self._taken = self._seen
        self._step = self._thread.submit(self._go, self._slopes.typical)

    def wait(self, seconds: float) -> None:
        """Wait for the step under way, for so long at most, and take its heights."""
        if self._step is not None:
            done, _ = wait_for([self._step], None if seconds == math.inf else max(0.0, seconds))
            if done:
                step, self._step = self._step, None
                self.height, self._known = step.result(), self._taken

    def _go(self, typical: float) -> NDArray[Any]:
        self._integrator.push(typical)
        return self._integrator.result()
