"""Surface normals from axial rotation (paper, section 4), to the statistical limit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Unpack, cast

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
    NormalKernel,
    NormalMethod,
    NormalOptions,
    Samples,
    TurnModel,
)
from mirrorskin.engine.rotation.poses import PoseFit, check_poses, even_windows, rocks
from mirrorskin.engine.rotation.response import Response
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.engine.tiling import MEMORY_LIMIT, Band, cut_into_bands, join_rows, room_of
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.io.positions import check_phase
from mirrorskin.io.result import Shown
from mirrorskin.kernels.device import Device


@dataclass(frozen=True, repr=False)
class Normals(Shown):
    """Which way the pixels' surface faces, and the standard deviation of that.

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
        Standard deviation of a sample, given or estimated, counts, at the middle of the brightness.
    shot : float
        By how much its square grows with each count.
    tilt : float
        Half-angle of the precession, given or estimated, radians.
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

    @classmethod
    def of(cls, maps: list[NDArray[Any]], model: TurnModel, turns: int, frames: int) -> Normals:
        """Put together what the kernel left, as `MAPS` lists it."""
        vectors, sigma, contact, mean, cosine, sine, residual = maps
        some = thin_out(mean)
        known = some[np.isfinite(some)]
        level = np.median(known) if known.size else 0.0
        numbers = float(model.noise.at(level)), model.noise.slope, model.tilt, turns, frames
        return cls(vectors, sigma, contact, mean, cosine, sine, residual, *numbers)

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


@checked
def estimate_normals(
    frames: NDArray[Any],
    phase: ArrayLike | None = None,
    *,
    tilt: ArrayLike | Literal["estimate"] | None = None,
    axis: ArrayLike | None = None,
    travel: ArrayLike | None = None,
    gain: ArrayLike | None = None,
    offset: ArrayLike = 0.0,
    method: NormalMethod = "exact",
    noise: float | None = None,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    response: Response | None = None,
    frame_weights: ArrayLike | None = None,
    device: str | Device | None = None,
) -> Normals:
    """Estimate the normals from a stack that fits in memory.

    At each phase a pixel shows the angle between its normal n and the body's axis a, cos theta' = n . a
    (eq. 10); the normal is the most likely one by all samples. See the
    documentation, "Normals from a rotation".

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts. Whole counts at the ends of their type are taken for clipped, a NaN for missing.
    phase : array_like, (T,), optional
        Radians, one a frame, at least three different ones a turn.
    tilt : float, array_like of (T,), or "estimate"
        Half-angle of the precession, radians, or to estimate it from the first turn. One a frame: any known
        poses; see `PoseEstimator`. Of two phases half a turn apart the body rocks.
    axis : array_like, (T, 3), optional
        The body's axis in each frame instead of phase and tilt: unit vectors, towards the camera.
    travel : array_like, (T,), optional
        Millimetres of each frame, of any known poses where the body presses as well.
    gain, offset : array_like, scalar or (H, W)
        E = offset + gain zenith: counts per radian, and counts.
    method : {"exact", "paper"}
        The most likely normals, or the paper's equations 14 to 22.
    noise : float, optional
        Standard deviation of any sample, counts; by default estimated from the first turn's residuals, as
        read and shot noise.
    dark, bright : array_like, scalar or (H, W), optional
        Counts between which brightness is linear in the zenith; samples that are expected beyond are left
        out.
    response : Response, optional
        Of a calibrated sensor that is not linear, instead of gain, offset, dark and bright; see
        ``mirrorskin.engine.rotation.response``.
    frame_weights : array_like, (T,), optional
        Inverse variances of the frames, in those of ``noise``; 0 for a missing one.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Normals
        `PoseNormals` of any known poses.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, phases, tilt, axes, scale or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    A plane that is inclined by 0.3 rad towards x, seen by a body that leans by 0.05 rad:

    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> phase = np.arange(8) * np.pi / 4
    >>> cosine = np.cos(0.3) * np.cos(0.05) - np.sin(0.3) * np.sin(0.05) * np.cos(phase)
    >>> frames = (500 * np.arccos(cosine)[:, None, None] * np.ones((2, 3))).astype(np.float32)
    >>> normals = engine.estimate_normals(frames, phase, tilt=0.05, gain=500, noise=1.0)
    >>> round(float(normals.zenith[0, 0]), 4)
    0.3
    """
    if frames.ndim != 3 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) is needed")
    options: dict[str, Any] = {
        "gain": gain,
        "offset": offset,
        "method": method,
        "noise": noise,
        "dark": dark,
        "bright": bright,
        "response": response,
        "device": device,
        "memory_limit": min(MEMORY_LIMIT, 2 * frames.nbytes),
    }
    estimator: NormalEstimator
    given = None if tilt is None or isinstance(tilt, str) else np.asarray(tilt, np.float64)
    varies = given is not None and (given.ndim > 0 or rocks(phase))
    if axis is not None or travel is not None or varies:
        from mirrorskin.engine.rotation.normals_pose import PoseEstimator

        where = check_poses(len(frames), phase, given, axis, travel)
        estimator = PoseEstimator(
            frames.shape[1:], frames.dtype, longest=even_windows(len(frames)), **options
        )
    else:
        if tilt is None:
            raise InputError("tilt is missing: give the half-angle of the precession, such as 2.5deg")
        where = check_phase(phase, len(frames), "phase")
        estimator = NormalEstimator(frames.shape[1:], frames.dtype, tilt=cast(Any, tilt), **options)
    estimator.look_at(frames, where, check_weights(frame_weights, len(frames)))
    return estimator.result()


class NormalEstimator(ThreadSafe):
    """Estimate normals from frames that come block by block, turn after turn.

    Frames are kept until their turn is over, at most 64 of them; of turns that are over, the device keeps the
    mean of the normals, weighted by inverse variance.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    tilt, gain, offset, method, noise, dark, bright, response, device
        As for `estimate_normals`.
    longest : int
        Frames of a turn at most.
    per_turn : bool
        Whether to return each turn alone, in maps with a leading axis, instead of the mean over turns.
    memory_limit : int
        Bytes of host memory for frames on the move, where more than one turn is to be held.

    Raises
    ------
    mirrorskin.io.InputError
        Parameters that cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> estimator = engine.NormalEstimator((2, 3), "uint8", tilt=0.05, gain=300, noise=1.0)
    >>> for phase in np.arange(8) * np.pi / 4:
    ...     estimator.push(np.full((1, 2, 3), 100 + 15 * np.cos(phase), np.uint8), phase=[phase])
    >>> estimator.result().turns
    1
    """

    position = "phase"
    _maps: tuple[str, ...] = MAPS
    _width = 0  # numbers that say where the body was in a frame; 0 for one that is no list

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
        self._kernel = NormalKernel(shape, self._dtype, **options, poses=self._width > 0)
        self.device: Device = self._kernel.device
        length = max(self._longest + 1, memory_limit // (2 * shape[0] * shape[1] * self._dtype.itemsize))
        planes = self._kernel.planes
        self._bands = cut_into_bands(self.device, shape, self._dtype, planes, length, self._longest + 1)
        for band in self._bands:
            self._kernel.write_scale(band)
        self.reset()

    @cached_property
    def _buffer(self) -> NDArray[Any]:
        """The frames of the open turn, and room for more."""
        return room_of(self._bands, min(band.length for band in self._bands))

    def reset(self) -> None:
        """Forget the frames so far, and what was estimated from them."""
        self._model = self._kernel.model
        self._phase = np.empty((0, self._width) if self._width else 0)  # of the frames in the buffer
        self._weights = np.empty(0)
        self._turns = self._frames = 0  # that are in the maps
        self._each: list[list[NDArray[Any]]] = []

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._buffer[len(self._phase) :]

    def push(
        self,
        frames: NDArray[Any],
        *,
        phase: ArrayLike,
        frame_weights: ArrayLike | None = None,
        lent: bool = False,
    ) -> None:
        """Take in the next frames.

        Parameters
        ----------
        frames : ndarray, (n, H, W)
        phase : array_like, (n,)
            Radians.
        frame_weights : array_like, (n,), optional
            As for `estimate_normals`.
        lent : bool
            Of no use here: frames are copied unless they lie in ``room``.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another type or size, phases or weights that cannot be used, or a turn of too many
            frames.
        """
        check_frames(frames, self._dtype, self._shape)
        self._push(frames, check_phase(phase, len(frames), "phase"), frame_weights)

    def _push(self, frames: NDArray[Any], where: Doubles, frame_weights: ArrayLike | None) -> None:
        """Take in frames, part by part, as there is room for them."""
        weights = check_weights(frame_weights, len(frames))
        start = 0
        while start < len(frames):
            part = slice(start, start + len(self.room))
            self._take(frames[part], where[part], weights[part])
            start = part.stop

    def look_at(self, frames: NDArray[Any], phase: Doubles, weights: Doubles) -> None:
        """Take in all frames at once; they stay as they are until the result is there, and are not copied."""
        if np.all(weights > 0):  # else frames are moved
            self._cut(phase)
            self._buffer, self._phase, self._weights = frames, phase, weights
        else:
            self._push(frames, phase, weights)

    def result(self) -> Normals:
        """Return the maps of all turns, the last of which is taken to end here.

        Raises
        ------
        mirrorskin.io.InputError
            The phases of the first turn do not determine a normal.
        """
        state = self._model, self._turns, self._frames, self._phase.copy(), self._weights.copy()
        frames = self._buffer[: len(self._phase)].copy() if np.any(self._weights == 0) else None
        closed = [self._copy_maps(band) for band in self._bands] if self._turns and not self._per_turn else []
        try:
            self._estimate(self._turns_in(self._phase))
            if self._turns == 0:
                self._explain(*state[-2:])
            assert self._model is not None
            if self._per_turn:
                maps = [np.stack(turns) for turns in zip(*self._each, strict=True)]
            else:
                maps = self._take_maps()
            return self._found(maps)
        finally:  # more frames may follow: the last turn is as open as before
            self._model, self._turns, self._frames, self._phase, self._weights = state
            del self._each[self._turns :]
            for band, kept in zip(self._bands, closed, strict=False):
                for name, values in kept.items():
                    band.write(name, values)
            if frames is not None:
                self._buffer[: len(frames)] = frames

    def _found(self, maps: list[NDArray[Any]]) -> Normals:
        assert self._model is not None
        return Normals.of(maps, self._model, self._turns, self._frames)

    def _turns_in(self, where: Doubles) -> list[slice]:
        """Return which frames are estimated together, by where the body was in them."""
        return cut_into_turns(where)

    def _fit_of(self, where: Doubles, weights: Doubles, first: bool) -> TurnFit | PoseFit | None:
        """Return how frames are fitted that are estimated together, if they can be."""
        fit = turn_fit(where, weights)
        return fit if fit is not None and (fit.goes_round or first) else None

    def _explain(self, where: Doubles, weights: Doubles) -> None:
        """Raise InputError that says why frames cannot be fitted."""
        check_phases(where, weights)

    def _take(self, frames: NDArray[Any], phase: Doubles, weights: Doubles) -> None:
        """Take in frames that fit into the buffer, and estimate the turns that are then over."""
        turns = self._cut(np.concatenate([self._phase, phase]))
        here = self.room[: len(frames)]
        if frames.ctypes.data != here.ctypes.data or not frames.flags.c_contiguous:
            here[:] = frames
        self._phase = np.concatenate([self._phase, phase])
        self._weights = np.concatenate([self._weights, weights])
        if len(turns) > 1:
            self._estimate(turns[:-1])
            end, frame_count = turns[-1].start, len(self._phase)
            self._buffer[: frame_count - end] = self._buffer[end:frame_count].copy()
            self._phase, self._weights = self._phase[end:], self._weights[end:]

    def _cut(self, phase: Doubles) -> list[slice]:
        """Cut frames into turns, none of which may be too long."""
        turns = self._turns_in(phase)
        longest = max(turn.stop - turn.start for turn in turns)
        if longest > self._longest:
            given = f"a turn of {longest} frames or more: normals take {self._longest} at most"
            raise InputError(f"{given}; leave some out, or use 'mirrorskin correlate'")
        return turns

    def _estimate(self, turns: list[slice]) -> None:
        """Estimate the normals of turns in the buffer."""
        fitted = self._fitted([self._close_up(turn) for turn in turns])
        for start in range(0, len(fitted), self._kernel.tables_at_once):
            group = fitted[start : start + self._kernel.tables_at_once]
            self._kernel.write_tables([fit for _, fit in group])
            for turn, fit in group:
                self._estimate_turn(turn, fit)

    def _close_up(self, turn: slice) -> slice:
        """Move the frames of a turn that are not missing to its begin, and return where they are."""
        there = turn.start + np.flatnonzero(self._weights[turn] > 0)
        known = slice(turn.start, turn.start + len(there))
        if known != turn:
            for values in (self._buffer, self._phase, self._weights):
                values[known] = values[there]
        return known

    def _fitted(self, turns: list[slice]) -> list[tuple[slice, TurnFit | PoseFit]]:
        """Return the turns whose phases determine a normal, and, after the first that does, go all round."""
        fitted: list[tuple[slice, TurnFit | PoseFit]] = []
        for turn in turns:
            fit = self._fit_of(self._phase[turn], self._weights[turn], first=not (self._turns or fitted))
            if fit is not None:
                fitted.append((turn, fit))
        return fitted

    def _estimate_turn(self, turn: slice, fit: TurnFit | PoseFit) -> None:
        """Take a turn into the maps."""
        count = turn.stop - turn.start
        if self._model is None:
            samples = np.stack([frame.reshape(-1)[:: thinning(self._shape)] for frame in self._buffer[turn]])
            self._model = self._kernel.estimate_model(samples, fit)
        self._turns += 1
        self._frames += count
        turns = 1 if self._per_turn else self._turns
        for band in self._bands:
            with band.resident():
                for staged in band.stage(self._buffer[turn], whole=True):
                    self._kernel.run(band, Samples(staged.array, 0, count), fit, self._model, turns)
        if self._per_turn:
            self._each.append(self._take_maps())

    def _copy_maps(self, band: Band) -> dict[str, NDArray[Any]]:
        """Return copies of a band's maps, with their padding."""
        with band.resident():
            return {name: band.maps[name].download().copy() for name in self._maps}

    def _take_maps(self) -> list[NDArray[Any]]:
        """Return the maps of all rows, as they are listed; the bands have new ones then."""
        parts = []
        for band in self._bands:
            with band.resident():
                vectors, *others = (band.detach(name).reshape(-1) for name in self._maps)
            rows = (-1, self._shape[1])
            flat = [one[: band.pixels].reshape(rows) for one in others]
            parts.append([vectors[: 3 * band.pixels].reshape(*rows, 3), *flat])
        return [join_rows(part) for part in zip(*parts, strict=True)]
