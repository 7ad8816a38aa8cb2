"""Surface normals from axial rotation (paper, section 4), to the statistical limit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_frames, thin_out, thinning
from mirrorskin.engine.rotation.design_matrix import (
    LONGEST,
    Doubles,
    TurnFit,
    check_phases,
    check_weights,
    cut_into_turns,
    turn_fit,
)
from mirrorskin.engine.rotation.normals_kernel import (
    MAPS,
    NormalMethod,
    NormalOptions,
    Samples,
    set_up,
    settle,
)
from mirrorskin.engine.rotation.residual_noise import CountNoise
from mirrorskin.engine.rotation.response import Response
from mirrorskin.engine.tiling import MEMORY_LIMIT, Band, cut_into_bands
from mirrorskin.io import Block, InputError, check_phase
from mirrorskin.kernels.device import Device


@dataclass(frozen=True)
class Normals:
    """Which way the pixels' surface faces, and how sure that is.

    Attributes
    ----------
    vectors : ndarray, (H, W, 3), float32
        Unit normals in the mean pose; NaN without an answer.
    sigma : ndarray, (H, W), float32
        Predicted RMS angle to the true normal, radians.
    contact : ndarray, (H, W), uint8
        1 where sheet and object touched in every frame.
    mean, cosine, sine, residual : ndarray, (H, W), float32
        Counts, of the samples' fit with one wave a turn; see `mirrorskin.engine.Correlation`. Of several
        turns the mean, of the residual the root mean square. NaN where a sample is missing in each turn.
    noise : float
        Standard deviation of a sample that was reckoned with, counts, at the middle of the brightness.
    shot : float
        By how much its square was reckoned to grow with each count.
    tilt : float
        Half-angle of the precession that was reckoned with, radians.
    turns, frames : int
        How many entered.
    """

    vectors: NDArray[np.float32]
    sigma: NDArray[np.float32]
    contact: NDArray[np.uint8]
    mean: NDArray[np.float32]
    cosine: NDArray[np.float32]
    sine: NDArray[np.float32]
    residual: NDArray[np.float32]
    noise: float
    shot: float
    tilt: float
    turns: int
    frames: int

    @cached_property
    def zenith(self) -> NDArray[np.float32]:
        """Angle to the body's axis in the mean pose, (H, W) float32, radians."""
        x, y, z = np.moveaxis(self.vectors, -1, 0)
        zenith: NDArray[np.float32] = np.arctan2(np.hypot(x, y), z)
        return zenith

    @cached_property
    def azimuth(self) -> NDArray[np.float32]:
        """Direction in which the surface faces, (H, W) float32, radians from x towards y; NaN where level."""
        x, y = self.vectors[..., 0], self.vectors[..., 1]
        azimuth: NDArray[np.float32] = np.where((x == 0) & (y == 0), np.float32(np.nan), np.arctan2(y, x))
        return azimuth

    @cached_property
    def modulation(self) -> NDArray[np.float32]:
        """Amplitude of the wave, (H, W) float32, counts."""
        return np.hypot(self.cosine, self.sine)


def estimate_normals(
    frames: NDArray[Any],
    phase: ArrayLike,
    tilt: float | None,
    gain: ArrayLike | None = None,
    offset: ArrayLike = 0.0,
    *,
    method: NormalMethod = "exact",
    noise: float | None = None,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    response: Response | None = None,
    weights: ArrayLike | None = None,
    device: str | Device | None = None,
) -> Normals:
    """Estimate the normals from a stack that fits in memory.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts. Whole counts at the ends of their type are taken for clipped, a NaN for missing.
    phase : array_like, (T,)
        Radians, one a frame, at least three different ones a turn.
    tilt : float or None
        Half-angle of the precession, radians; None estimates it from the first turn.
    gain, offset : array_like, scalar or (H, W)
        E = offset + gain zenith: counts per radian, and counts.
    method : {"exact", "paper"}
        The most likely normals, or the paper's equations 14 to 22.
    noise : float, optional
        Standard deviation of any sample, counts; by default told from the first turn's residuals, as read and
        shot noise.
    low, high : array_like, scalar or (H, W), optional
        Counts between which brightness is linear in the zenith; what is expected beyond tells nothing.
    response : Response, optional
        What is known of a sensor that is not linear, instead of gain, offset, low and high; see
        ``mirrorskin.engine.rotation.response``.
    weights : array_like, (T,), optional
        Inverse variances of the frames, in those of ``noise``; 0 for a missing one.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Normals

    Raises
    ------
    mirrorskin.io.InputError
        Frames, phases, tilt, scale or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.
    """
    if frames.ndim != 3 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) is needed")
    alpha = check_phase(phase, len(frames), "phase")
    estimator = NormalEstimator(
        frames.shape[1:],
        frames.dtype,
        tilt=tilt,
        gain=gain,
        offset=offset,
        method=method,
        noise=noise,
        low=low,
        high=high,
        response=response,
        device=device,
        memory_limit=min(MEMORY_LIMIT, 2 * frames.nbytes),
    )
    estimator.push(Block(frames, index=0, phase=alpha), weights)
    return estimator.result()


class NormalEstimator:
    """Estimate normals from frames that come block by block, turn after turn.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    tilt, gain, offset, method, noise, low, high, response, device
        As for ``estimate_normals``.
    longest : int
        Frames of a turn at most.
    per_turn : bool
        Whether to tell each turn alone, in maps with a leading axis, instead of the mean over turns.
    memory_limit : int
        Bytes of host memory for frames on the move, where more than one turn is to be held.

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
        longest: int = LONGEST,
        per_turn: bool = False,
        memory_limit: int = MEMORY_LIMIT,
        **options: Unpack[NormalOptions],
    ) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        self._longest, self._per_turn = min(longest, LONGEST), per_turn
        self._setup = set_up(shape, self._dtype, **options)
        self.device, self._launch = self._setup.device, self._setup.launch
        length = max(self._longest + 1, memory_limit // (2 * shape[0] * shape[1] * self._dtype.itemsize))
        self._bands = cut_into_bands(
            self.device, shape, self._dtype, self._launch.planes, length, self._longest + 1
        )
        self._buffer = self._bands[0].frames.host
        if len(self._bands) > 1:
            fits = min(len(band.frames.host) for band in self._bands)
            self._buffer = np.empty((fits, *shape), self._dtype)
        for band in self._bands:
            self._launch.write_scale(band)
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far, and be ready for another rotation of the same sensor."""
        self._tilt, self._noise = self._setup.tilt, self._setup.noise
        self._phase, self._weights = np.empty(0), np.empty(0)
        self._turns = self._frames = 0
        self._each: list[list[NDArray[Any]]] = []

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._buffer[len(self._phase) :]

    def push(self, block: Block, weights: ArrayLike | None = None) -> None:
        """Take in the next frames.

        Parameters
        ----------
        block : Block
            With the phase of each frame.
        weights : array_like, (n,), optional
            Of the frames, as for ``estimate_normals``.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another type or size, phases or weights that cannot be used, or a turn of too many
            frames.
        """
        frames = block.frames
        check_frames(frames, self._dtype, self._shape)
        phase = check_phase(block.phase, len(frames), "phase")
        weight = check_weights(weights, len(frames))
        start = 0
        while start < len(frames):
            part = slice(start, start + len(self.room))
            self._take(frames[part], phase[part], weight[part])
            start = part.stop

    def result(self) -> Normals:
        """Return the maps of all turns, and be ready for another rotation: the last turn ends here.

        Raises
        ------
        mirrorskin.io.InputError
            The phases of the first turn do not determine a normal.
        """
        phase, weights = self._phase.copy(), self._weights.copy()
        self._work(cut_into_turns(phase))
        if self._turns == 0:
            check_phases(phase, weights)  # says what is wrong
        if self._per_turn:
            maps = [np.stack(turns) for turns in zip(*self._each, strict=True)]
        else:
            maps = self._maps()
        assert self._noise is not None
        assert self._tilt is not None
        normals = tell_normals(maps, self._noise, self._tilt, self._turns, self._frames)
        self.reset()
        return normals

    def _take(self, frames: NDArray[Any], phase: Doubles, weights: Doubles) -> None:
        """Take in frames that fit, and work on the turns that are then over."""
        turns = cut_into_turns(np.concatenate([self._phase, phase]))
        longest = max(turn.stop - turn.start for turn in turns)
        if longest > self._longest:
            told = f"a turn of {longest} frames or more: normals are told from {self._longest} at most"
            raise InputError(f"{told}; leave some out, or use 'mirrorskin correlate'")
        here = self.room[: len(frames)]
        if frames.ctypes.data != here.ctypes.data or not frames.flags.c_contiguous:
            here[:] = frames
        self._phase = np.concatenate([self._phase, phase])
        self._weights = np.concatenate([self._weights, weights])
        if len(turns) > 1:
            self._work(turns[:-1])

    def _work(self, turns: list[slice]) -> None:
        """Estimate the normals of turns in the buffer, and keep the frames that come after them."""
        told = self._told([self._close_up(turn) for turn in turns])
        alone = len(self._bands) == 1
        if alone and turns:
            self._bands[0].frames.upload(len(self._phase))
        for start in range(0, len(told), self._launch.together):
            group = told[start : start + self._launch.together]
            self._launch.write_tables([fit for _, fit in group])
            for turn, fit in group:
                self._estimate(turn, fit)
        if alone:
            self._bands[0].frames.claim()
        end = turns[-1].stop if turns else 0
        rest = len(self._phase) - end
        self._buffer[:rest] = self._buffer[end : end + rest].copy()
        self._phase, self._weights = self._phase[end:], self._weights[end:]

    def _close_up(self, turn: slice) -> slice:
        """Move the frames of a turn that are not missing to its begin."""
        there = turn.start + np.flatnonzero(self._weights[turn] > 0)
        known = slice(turn.start, turn.start + len(there))
        if known != turn:
            for values in (self._buffer, self._phase, self._weights):
                values[known] = values[there]
        return known

    def _told(self, turns: list[slice]) -> list[tuple[slice, TurnFit]]:
        """Return the turns whose phases determine a normal, and, after the first that does, go all round."""
        told: list[tuple[slice, TurnFit]] = []
        for turn in turns:
            fit = turn_fit(self._phase[turn], self._weights[turn])
            if fit is not None and (fit.goes_round or not (self._turns or told)):
                told.append((turn, fit))
        return told

    def _estimate(self, turn: slice, fit: TurnFit) -> None:
        count = turn.stop - turn.start
        if self._noise is None or self._tilt is None:
            self._settle(turn, fit.matrix)
        assert self._noise is not None
        assert self._tilt is not None
        self._turns += 1
        self._frames += count
        for band in self._bands:
            start = turn.start
            if len(self._bands) > 1:
                band.frames.claim()
                band.frames.host[:count] = self._buffer[turn, band.rows]
                band.frames.upload(count)
                start = 0
            turns = 1 if self._per_turn else self._turns
            samples = Samples(band.frames, start, count)
            with band.resident():
                self._launch.run(band, samples, fit, self._noise, self._tilt, turns)
        if self._per_turn:
            self._each.append(self._maps())

    def _settle(self, turn: slice, matrix: Doubles) -> None:
        """Tell from a turn what was not given: the noise, and the tilt."""
        samples = self._buffer[turn].reshape(turn.stop - turn.start, -1)[:, :: thinning(self._shape)]
        known = self._phase[turn], self._weights[turn], matrix, self._setup.scale, self._noise, self._tilt
        self._noise, self._tilt = settle(samples, self._shape, *known)

    def _maps(self) -> list[NDArray[Any]]:
        """Return the maps of all rows, as they are listed."""
        if len(self._bands) == 1:
            return self._download(self._bands[0])
        return [np.concatenate(parts) for parts in zip(*map(self._download, self._bands), strict=True)]

    def _download(self, band: Band) -> list[NDArray[Any]]:
        """Return the maps of a band, as they are listed; it has new ones then."""
        rows = (-1, self._shape[1])
        with band.resident():
            vectors, *others = (band.hand_over(name).reshape(-1) for name in MAPS)
        flat = [one[: band.pixels].reshape(rows) for one in others]
        return [vectors[: 3 * band.pixels].reshape(*rows, 3), *flat]


def tell_normals(
    maps: list[NDArray[Any]], noise: CountNoise, tilt: float, turns: int, frames: int
) -> Normals:
    """Put together what a kernel left, as ``mirrorskin.engine.rotation.normals_kernel.MAPS`` lists it."""
    vectors, sigma, contact, mean, cosine, sine, residual = maps
    some = thin_out(mean)
    known = some[np.isfinite(some)]
    level = np.median(known) if known.size else 0.0
    told = float(noise.at(level)), noise.slope, tilt, turns, frames
    return Normals(vectors, sigma, contact, mean, cosine, sine, residual, *told)
