"""Normals of an endless rotation, from a window of the last frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.frames import thinning
from mirrorskin.engine.rotation.correlation import WindowSums
from mirrorskin.engine.rotation.design_matrix import TurnFit, check_phases, turn_fit
from mirrorskin.engine.rotation.normals_kernel import NormalKernel, Samples, TurnModel
from mirrorskin.engine.tiling import Band, join_rows
from mirrorskin.io import InputError, Result
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

_LENGTH = 16  # frames that can be pushed at once without a copy


class NormalWindow:
    """Normals of a window of the last frames on the device, for `mirrorskin.engine.Normals`.

    Noise and tilt are estimated from the first full window, unless they are given. The frames are in a ring
    buffer on the device that the correlation uses as well. Normals and correlation are bitwise equal to the
    results of ``estimate_normals`` and ``correlate`` for the same frames.
    """

    device: Device

    def __init__(
        self, kernel: NormalKernel, shape: tuple[int, int], dtype: np.dtype[Any], length: int
    ) -> None:
        self._shape, self.length, self._kernel = shape, length, kernel
        (self.device,) = kernel.devices
        self._sums = WindowSums([self.device], shape, dtype, _LENGTH, length, kernel.planes)
        for band in self.bands:
            kernel.write_scale(band)
        self._model, self.count = kernel.model, 0

    @property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return self._sums.staging_buffer

    @property
    def is_full(self) -> bool:
        """Whether the window is full."""
        return self.count >= self.length

    @property
    def model(self) -> TurnModel:
        """Tilt and noise, given or estimated from the first full window."""
        assert self._model is not None
        return self._model

    @property
    def bands(self) -> list[Band]:
        """The rows on the device, with the maps that `estimate` computes, named as in `MAPS`."""
        return self._sums.bands

    def push(self, frames: NDArray[Any], phase: Doubles) -> None:
        """Process the next frames, (n, H, W), and their phases, (n,) radians."""
        filling = max(0, min(len(frames), self.length - self.count))
        for part in (slice(filling), slice(filling, None)):
            if len(frames[part]) > 0:
                self._sums.push(frames[part], phase[part], np.ones(len(frames[part])))
                self.count += len(frames[part])
            if self.is_full and self._model is None:
                self._model = self._kernel.estimate_model(self._samples(), self._fit())

    def estimate(self, bare: bool = True) -> None:
        """Enqueue the estimate of the window's normals, which writes to the maps of the bands.

        ``bare`` omits mean, cosine, sine and residual. InputError: the window is not full, or its phases do
        not determine a normal.
        """
        fit = self._fit()
        self._kernel.write_tables([fit])
        for band in self.bands:
            with band.resident():
                ring = band.maps["ring"]
                samples = Samples(ring, self._sums.oldest, self.length, ring=True)
                self._kernel.run(band, samples, fit, self.model, turns=1, bare=bare)
                self._estimated = ring.last_use

    def place(self, heights: NDArray[np.floating]) -> None:
        """Set the height of the object for a response, (H, W), mm above the rest plane."""
        for band in self.bands:
            band.write("scale", heights[band.rows], plane=4)

    def correlation(self) -> Result:
        """Return the correlation of the frames in the window; see `mirrorskin.engine.Correlate`."""
        return self._sums.result()

    def fetch(self, name: str) -> NDArray[Any]:
        """Wait for a map of the last estimate, and return a copy, (H, W) or (H, W, 3)."""
        parts = []
        for band in self.bands:
            (planes,) = band.fetch({name: slice(None)}, keep=[name])
            parts.append(self._without_padding(band, planes))
        return join_rows(parts)

    def fetch_early(self, name: str) -> NDArray[Any]:
        """Return the same as `fetch`, but wait for the last estimate only, not for later kernels."""
        if len(self.bands) > 1:
            return self.fetch(name)
        band = self.bands[0]
        return self._without_padding(band, band.maps[name].read(after=self._estimated))

    def on_device(self, name: str) -> Array:
        """Return a map of the last estimate as one array on the device; it may have padding."""
        if len(self.bands) == 1:
            return self.bands[0].maps[name]
        return self.device.from_host(name, self.fetch(name), self.bands[0].maps[name].dtype)

    def _without_padding(self, band: Band, planes: NDArray[Any]) -> NDArray[Any]:
        depth = len(planes)
        flat = planes.reshape(-1)[: depth * band.pixels]
        return flat.reshape(-1, self._shape[1], *([depth] if depth > 1 else []))

    def _fit(self) -> TurnFit:
        """Return the fit to the window's frames."""
        phase, weight = self._sums.frames
        fit = turn_fit(phase, weight) if self.is_full else None
        if fit is None:
            check_phases(phase[weight > 0])  # raises an InputError with the reason
            raise InputError(f"{self.count} frames: a window of {self.length} is not full yet")
        return fit

    def _samples(self) -> NDArray[Any]:
        """Return every n-th pixel of the frames in the window, (N, n), the oldest frame first."""
        order = np.roll(np.arange(self.length), -self._sums.oldest)
        step, before, parts = thinning(self._shape), 0, []
        for band in self.bands:
            (ring,) = band.fetch({"ring": slice(None)}, keep=["ring"])
            parts.append(ring[:, -before % step : band.pixels : step][order])
            before += band.pixels
        return np.concatenate(parts, axis=1)
