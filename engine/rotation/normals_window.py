"""Normals of an endless rotation, from a window of its last frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.engine.frames import check_frames, thinning
from mirrorskin.engine.rotation.correlation import Correlation, WindowSums, tell_wave
from mirrorskin.engine.rotation.design_matrix import TurnFit, check_phases, turn_fit
from mirrorskin.engine.rotation.normals import Normals, tell_normals
from mirrorskin.engine.rotation.normals_kernel import MAPS, NormalOptions, Samples, set_up, settle
from mirrorskin.engine.rotation.residual_noise import CountNoise
from mirrorskin.engine.tiling import Band
from mirrorskin.io import Block, InputError, check_phase
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.correlation import WINDOW

_ROOM = 16  # frames that may be pushed at once without a copy


class NormalWindow:
    """Estimate normals of a window that moves on with the frames, however they are cut into blocks.

    Noise and tilt are those of the first full window, unless they are given. Its frames are kept on
    the device, in a ring that the correlation's sums share: the normals are those of ``estimate_normals``
    from the same frames, bit by bit, and the correlation is that of ``Correlator``.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    window : int
        Frames, 3 to 64.
    tilt, gain, offset, method, noise, low, high, response, device
        As for ``estimate_normals``.

    Attributes
    ----------
    device : Device
    count : int
        Frames so far.

    Raises
    ------
    mirrorskin.io.InputError
        Parameters that cannot be used.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        window: int,
        **options: Unpack[NormalOptions],
    ) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        if not 3 <= window <= WINDOW:
            raise InputError(f"window {window}: a number of frames from 3 to {WINDOW} is needed")
        self._window = window
        self._setup = set_up(shape, self._dtype, **options)
        self._tilt, self._noise = self._setup.tilt, self._setup.noise
        self.device, self._launch = self._setup.device, self._setup.launch
        beside = self._launch.planes
        self._sums = WindowSums(self.device, shape, self._dtype, _ROOM, window, beside)
        for band in self._sums.bands:
            self._launch.write_scale(band)
        self.count = 0

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
        """Half-angle of the precession that is reckoned with, radians; once it is known."""
        assert self._tilt is not None
        return self._tilt

    @property
    def bands(self) -> list[Band]:
        """Where the maps are that ``estimate`` leaves; see ``MAPS``."""
        return self._sums.bands

    def reset(self) -> None:
        """Forget the frames so far, and what was told from them."""
        self._sums.reset()
        self._tilt, self._noise, self.count = self._setup.tilt, self._setup.noise, 0

    def push(self, block: Block) -> None:
        """Take in the next frames.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another type or size, phases that cannot be used; or the first full window does not
            tell what noise or tilt there is.
        """
        frames = block.frames
        check_frames(frames, self._dtype, self._shape)
        phase = check_phase(block.phase, len(frames), "phase")
        start = 0
        if not self.is_full:
            start = min(len(frames), self._window - self.count)
            self._push(replace(block, frames=frames[:start], phase=phase[:start]))
            if self.is_full:
                self._settle()
        if start < len(frames):
            self._push(replace(block, frames=frames[start:], phase=phase[start:]))

    def estimate(self, bare: bool = True) -> None:
        """Put the estimate of the window's normals on the device's queue; their maps lie in the bands.

        Parameters
        ----------
        bare : bool
            Whether to leave out mean, cosine, sine and residual.

        Raises
        ------
        mirrorskin.io.InputError
            The window is not full, or its phases do not determine a normal.
        """
        fit = self._fit()
        assert self._noise is not None
        samples = self._sums.oldest, self._window, True
        self._launch.write_tables([fit])
        for band in self.bands:
            with band.resident():
                ring = band.maps["ring"]
                known = fit, self._noise, self.tilt
                self._launch.run(band, Samples(ring, *samples), *known, turns=1, bare=bare)
                self._estimated = ring.used

    def place(self, heights: NDArray[np.floating]) -> None:
        """Say where the object is from now on, (H, W), mm above the rest plane; under a calibrated wall."""
        for band in self.bands:
            band.write("scale", heights[band.rows], plane=4)

    def normals(self) -> Normals:
        """Estimate the window's normals, and bring them to the host; more frames may follow.

        Raises
        ------
        mirrorskin.io.InputError
            As ``estimate``.
        """
        self.estimate(bare=False)
        assert self._noise is not None
        maps = [self.fetch(name) for name in MAPS]
        return tell_normals(maps, self._noise, self.tilt, 1, self._window)

    def correlation(self) -> Correlation:
        """Return the fit of the frames in the window; see ``Correlator.result``."""
        return tell_wave(self._sums)

    def fetch(self, name: str) -> NDArray[Any]:
        """Wait for a map of the last estimate, and return a copy, (H, W), or (H, W, 3)."""
        parts = []
        for band in self.bands:
            with band.resident():
                parts.append(self._part(band, band.maps[name].download()).copy())
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def glance(self, name: str) -> NDArray[Any]:
        """Return what ``fetch`` does, but wait for the last estimate alone, not for what came after it."""
        if len(self.bands) > 1:
            return self.fetch(name)
        band = self.bands[0]
        return self._part(band, band.maps[name].see(self._estimated))

    def whole(self, name: str) -> Array:
        """Return a map of the last estimate on the device, where it is one piece, up to the padding."""
        if len(self.bands) == 1:
            return self.bands[0].maps[name]
        return self.device.given(name, self.fetch(name), self.bands[0].maps[name].host.dtype)

    def _part(self, band: Band, map_: NDArray[Any]) -> NDArray[Any]:
        """Return a map of a band without its padding."""
        depth = len(map_)
        flat = map_.reshape(-1)[: depth * band.pixels]
        return flat.reshape(-1, self._shape[1], *([depth] if depth > 1 else []))

    def _push(self, block: Block) -> None:
        assert block.phase is not None
        self._sums.push(block.frames, block.phase, np.ones(len(block.frames)), block.lent)
        self.count += len(block.frames)

    def _fit(self) -> TurnFit:
        """Return how the window's frames are fitted."""
        phase, weight = self._sums.seen()
        fit = turn_fit(phase, weight) if self.is_full else None
        if fit is None:
            check_phases(phase[weight > 0])  # says what is wrong
            raise InputError(f"{self.count} frames: a window of {self._window} is not full yet")
        return fit

    def _settle(self) -> None:
        """Tell from the first full window what was not given: the noise, and the tilt."""
        if self._noise is not None and self._tilt is not None:
            return
        fit = self._fit()
        phase, weight = self._sums.seen()
        known: tuple[CountNoise | None, float | None] = self._noise, self._tilt
        told = self._samples(), self._shape, phase, weight, fit.matrix, self._setup.scale
        self._noise, self._tilt = settle(*told, *known)

    def _samples(self) -> NDArray[Any]:
        """Return each so-manieth pixel of the frames in the window, (N, n), the oldest frame first."""
        order = np.roll(np.arange(self._window), -self._sums.oldest)
        step, before, parts = thinning(self._shape), 0, []
        for band in self.bands:
            with band.resident():
                ring = band.maps["ring"].download()
                parts.append(ring[:, -before % step : band.pixels : step][order])
            before += band.pixels
        return np.concatenate(parts, axis=1)
