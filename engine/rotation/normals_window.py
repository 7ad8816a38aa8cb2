"""Normals of an endless rotation, from a window of its last frames."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_frames, thinning
from mirrorskin.engine.rotation.correlation import Correlation, WindowSums
from mirrorskin.engine.rotation.design_matrix import TurnFit, check_phases, turn_fit
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.normals_kernel import MAPS, NormalKernel, NormalOptions, Samples, TurnModel
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.engine.tiling import Band, join_rows
from mirrorskin.io import InputError
from mirrorskin.io.positions import check_phase
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

_ROOM = 16  # frames that may be pushed at once without a copy


class NormalWindow(ThreadSafe):
    """Estimate normals of a window that moves on with the frames, however they are cut into blocks.

    Noise and tilt are those of the first full window, unless they are given. Its frames are kept on
    the device, in a ring that the correlation's sums share: the normals are those of ``estimate_normals``
    from the same frames, bit by bit, and the correlation is that of ``Correlator``.

    The window has 3 to 64 frames; other options are those of `mirrorskin.engine.estimate_normals`.
    """

    count: int

    position = "phase"

    def __init__(
        self, shape: tuple[int, int], dtype: DTypeLike, *, window: int, **options: Unpack[NormalOptions]
    ) -> None:
        self._shape, self._dtype, self._window = shape, np.dtype(dtype), window
        self._kernel = NormalKernel(shape, self._dtype, **options)
        self.device: Device = self._kernel.device
        planes = self._kernel.planes
        self._sums = WindowSums(self.device, shape, self._dtype, _ROOM, window, planes)
        for band in self.bands:
            self._kernel.write_scale(band)
        self._model, self.count = self._kernel.model, 0

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._sums.room

    @property
    def is_full(self) -> bool:
        """Whether there are as many frames as the window has."""
        return self.count >= self._window

    @property
    def tilt(self) -> float:
        """Half-angle of the precession, given or estimated, radians; once the window is full."""
        return self._known_model.tilt

    @property
    def bands(self) -> list[Band]:
        """Where the maps are that `estimate` leaves, by the names of `MAPS`."""
        return self._sums.bands

    def reset(self) -> None:
        """Forget the frames so far, and what was estimated from them."""
        self._sums.reset()
        self._model, self.count = self._kernel.model, 0

    def push(self, frames: NDArray[Any], *, phase: ArrayLike, lent: bool = False) -> None:
        """Take in the next frames; see `mirrorskin.engine.streaming.Estimator`."""
        check_frames(frames, self._dtype, self._shape)
        alpha, weights = check_phase(phase, len(frames), "phase"), np.ones(len(frames))
        filling = max(0, min(len(frames), self._window - self.count))
        for part in (slice(filling), slice(filling, None)):
            if len(frames[part]) > 0:
                self._sums.push(frames[part], alpha[part], weights[part], lent)
                self.count += len(frames[part])
            if self.is_full and self._model is None:
                self._model = self._kernel.estimate_model(self._samples(), self._fit())

    def estimate(self, bare: bool = True) -> None:
        """Put the estimate of the window's normals on the device's queue; their maps lie in the bands.

        ``bare`` leaves out mean, cosine, sine and residual. InputError: the window is not full, or its phases
        do not determine a normal.
        """
        fit = self._fit()
        self._kernel.write_tables([fit])
        for band in self.bands:
            with band.resident():
                ring = band.maps["ring"]
                samples = Samples(ring, self._sums.oldest, self._window, ring=True)
                self._kernel.run(band, samples, fit, self._known_model, turns=1, bare=bare)
                self._estimated = ring.last_use

    def place(self, heights: NDArray[np.floating]) -> None:
        """Set how high the object stands from now on, (H, W), mm above the rest plane; with a response."""
        for band in self.bands:
            band.write("scale", heights[band.rows], plane=4)

    def result(self) -> Normals:
        """Estimate the window's normals; see `estimate`."""
        self.estimate(bare=False)
        return Normals.of([self.fetch(name) for name in MAPS], self._known_model, 1, self._window)

    def correlation(self) -> Correlation:
        """Return the fit of the frames in the window; see ``Correlator.result``."""
        return self._sums.correlation()

    def fetch(self, name: str) -> NDArray[Any]:
        """Wait for a map of the last estimate, and return a copy, (H, W), or (H, W, 3)."""
        parts = []
        for band in self.bands:
            with band.resident():
                parts.append(self._without_padding(band, band.maps[name].download()).copy())
        return join_rows(parts)

    def fetch_early(self, name: str) -> NDArray[Any]:
        """Return what `fetch` does, but wait for the last estimate alone, not for what came after it."""
        if len(self.bands) > 1:
            return self.fetch(name)
        band = self.bands[0]
        return self._without_padding(band, band.maps[name].snapshot(self._estimated))

    def on_device(self, name: str) -> Array:
        """Return a map of the last estimate as one array of the device; it may have padding."""
        if len(self.bands) == 1:
            return self.bands[0].maps[name]
        return self.device.given(name, self.fetch(name), self.bands[0].maps[name].host.dtype)

    @property
    def _known_model(self) -> TurnModel:
        assert self._model is not None  # of a full window
        return self._model

    def _without_padding(self, band: Band, map_: NDArray[Any]) -> NDArray[Any]:
        depth = len(map_)
        flat = map_.reshape(-1)[: depth * band.pixels]
        return flat.reshape(-1, self._shape[1], *([depth] if depth > 1 else []))

    def _fit(self) -> TurnFit:
        """Return how the window's frames are fitted."""
        phase, weight = self._sums.frames
        fit = turn_fit(phase, weight) if self.is_full else None
        if fit is None:
            check_phases(phase[weight > 0])  # says what is wrong
            raise InputError(f"{self.count} frames: a window of {self._window} is not full yet")
        return fit

    def _samples(self) -> NDArray[Any]:
        """Return every n-th pixel of the frames in the window, (N, n), the oldest frame first."""
        order = np.roll(np.arange(self._window), -self._sums.oldest)
        step, before, parts = thinning(self._shape), 0, []
        for band in self.bands:
            with band.resident():
                ring = band.maps["ring"].download()
                parts.append(ring[:, -before % step : band.pixels : step][order])
            before += band.pixels
        return np.concatenate(parts, axis=1)
