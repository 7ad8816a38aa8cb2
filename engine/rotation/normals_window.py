"""Normals of an endless rotation, from a window of the last frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.frames import thinned
from mirrorskin.engine.correlation.correlation import WindowSums
from mirrorskin.engine.correlation.design_matrix import TurnFit, check_phases, turn_fit
from mirrorskin.engine.rotation.normals_kernel import NormalKernel, TurnModel
from mirrorskin.io import InputError, Result
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.engine.base.operation import Operation


class NormalWindow:
    """Normals of a window of the last frames on the device, for `mirrorskin.engine.Normals`.

    Noise and tilt are estimated from the first full window, unless they are given. The frames are in a ring
    buffer on the device that the correlation uses as well. Normals and correlation are bitwise equal to the
    results of ``estimate_normals`` and ``correlate`` for the same frames.

    Attributes
    ----------
    maps : Picture
        Maps of the last estimate, named as in `MAPS`. Mean and residual are of the correlation if that was
        computed later.
    length, count : int
        Number of frames of the window, and of all frames so far.
    """

    def __init__(self, operation: Operation, kernel: NormalKernel, length: int) -> None:
        self.length, self.count, self._kernel, self._model = length, 0, kernel, kernel.model
        self.maps = kernel.picture(operation, 1, **WindowSums.maps_of(operation, length))
        self._sums = WindowSums(self.maps, operation.dtype, length)
        self._is_estimated = False

    @property
    def is_full(self) -> bool:
        """Whether the window is full."""
        return self.count >= self.length

    @property
    def model(self) -> TurnModel:
        """Tilt and noise, given or estimated from the first full window."""
        assert self._model is not None
        return self._model

    def push(self, frames: NDArray[Any], phase: Doubles) -> None:
        """Process the next frames, (n, H, W), and their phases, (n,) radians."""
        filling = max(0, min(len(frames), self.length - self.count))
        for part in (slice(filling), slice(filling, None)):
            if len(frames[part]) > 0:
                self._sums.push(frames[part], phase[part], np.ones(len(frames[part])))
                self.count += len(frames[part])
            if self.is_full and self._model is None:
                self._model = self._kernel.estimate_model(thinned(self._sums.frames())[0], self._fit())

    def estimate(self, bare: bool = True) -> None:
        """Enqueue the estimate of the window's normals, which writes to the maps.

        ``bare`` omits mean, cosine, sine and residual. InputError: the window is not full, or its phases do
        not determine a normal.
        """
        kinds = {"bare": bare, "again": self._is_estimated}
        self._kernel.run(self.maps, None, self._fit(), self.model, 1, start=self._sums.oldest, **kinds)
        self._is_estimated = True

    def place(self, heights: NDArray[np.floating]) -> None:
        """Set the height of the object for a response, (H, W), mm above the rest plane."""
        self.maps.fill("scale", heights, plane=4)

    def correlation(self) -> Result:
        """Return the correlation of the frames in the window; see `mirrorskin.engine.Correlate`."""
        return self._sums.result(on_host=True)

    def _fit(self) -> TurnFit:
        """Return the fit to the window's frames."""
        phase, weight = self._sums.phase, self._sums.weight
        fit = turn_fit(phase, weight) if self.is_full else None
        if fit is None:
            check_phases(phase[weight > 0])  # raises an InputError with the reason
            raise InputError(f"{self.count} frames: a window of {self.length} is not full yet")
        return fit
