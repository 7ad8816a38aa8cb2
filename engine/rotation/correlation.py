"""Mean, cosine and sine of the brightness over an axial rotation (paper, section 4: equations 17 to 22)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_dtype, check_frames
from mirrorskin.engine.rotation.design_matrix import Doubles, basis, check_phases, check_weights
from mirrorskin.engine.tiling import MEMORY_LIMIT, Band, Planes, Staged, cut_into_bands
from mirrorskin.io import Block, InputError, check_phase
from mirrorskin.kernels.array import Array, Operand
from mirrorskin.kernels.correlation import WINDOW
from mirrorskin.kernels.device import C_TYPES, Device, open_device


@dataclass(frozen=True, slots=True)
class Correlation:
    """The least-squares fit E = mean + cosine cos alpha + sine sin alpha of each pixel.

    Attributes
    ----------
    mean, cosine, sine : ndarray, (H, W), float32
        Counts; NaN where a sample was no number.
    residual : ndarray, (H, W), float32
        Counts: sqrt(SS / (N - 3)), the standard deviation of a sample of weight 1; NaN where N is 3.
    frames : int
        Number N of frames that counted: those of a weight above 0.
    """

    mean: NDArray[np.float32]
    cosine: NDArray[np.float32]
    sine: NDArray[np.float32]
    residual: NDArray[np.float32]
    frames: int

    @property
    def modulation(self) -> NDArray[np.float32]:
        """Amplitude sqrt(cosine^2 + sine^2), (H, W) float32, counts."""
        return np.hypot(self.cosine, self.sine)

    @property
    def azimuth(self) -> NDArray[np.float32]:
        """Phase at which the pixel is brightest, atan2(sine, cosine), (H, W) float32, radians, or NaN."""
        still = (self.cosine == 0) & (self.sine == 0)
        phase: NDArray[np.float32] = np.where(still, np.float32(np.nan), np.arctan2(self.sine, self.cosine))
        return phase


def correlate(
    frames: NDArray[Any],
    phase: ArrayLike,
    weights: ArrayLike | None = None,
    device: str | Device | None = None,
) -> Correlation:
    """Fit mean, cosine and sine to a stack that fits in memory.

    It minimises SS = sum_k w_k (E_k - mean - cosine cos alpha_k - sine sin alpha_k)^2. For N evenly spaced
    phases, sine and cosine are 2/N times the sums that stand for the paper's integrals S and C (equations 17
    and 20), and so gain times tilt times sine and cosine of the azimuth, as in equations 19 and 22. Uneven
    or measured phases mix the three, and least squares tells them apart.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts.
    phase : array_like, (T,)
        Radians, one a frame.
    weights : array_like, (T,), optional
        How much each frame counts; 0 for a missing one. By default, all count the same.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, phases or weights that cannot be used; see ``check_phases``.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.
    """
    if frames.ndim != 3 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) is needed")
    alpha = check_phase(phase, len(frames), "phase")
    check_phases(alpha, check_weights(weights, len(frames)))
    limit = min(MEMORY_LIMIT, 2 * frames.nbytes)
    correlator = Correlator(frames.shape[1:], frames.dtype, device=device, memory_limit=limit)
    correlator.push(Block(frames, index=0, phase=alpha), weights)
    return correlator.result()


class Correlator:
    """Fit mean, cosine and sine to frames that come block by block, however they are cut.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    window : int, optional
        Frames, 3 to 64, that count: the last ones of an endless rotation. By default, all of them.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    memory_limit : int
        Bytes of host memory for frames on the move; half of it is the room for one block.

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
        window: int | None = None,
        device: str | Device | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        dtype = np.dtype(dtype)
        check_dtype(dtype)
        if window is not None and not 3 <= window <= WINDOW:
            raise InputError(f"window {window}: a number of frames from 3 to {WINDOW} is needed")
        opened = open_device(device)
        length = max(1, memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self.device = opened
        self._shape, self._dtype = shape, dtype
        self._sums = (
            TurnSums(opened, shape, dtype, length)
            if window is None
            else WindowSums(opened, shape, dtype, length, window, {})
        )

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._sums.room

    def push(self, block: Block, weights: ArrayLike | None = None) -> None:
        """Take in the next frames.

        Parameters
        ----------
        block : Block
            Frames and their phases.
        weights : array_like, (n,), optional
            How much each of them counts; 0 for a missing one. By default, each has weight 1.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another shape or type, phases or weights that cannot be used, or more frames than
            the sums hold.
        """
        frames = block.frames
        check_frames(frames, self._dtype, self._shape)
        phase = check_phase(block.phase, len(frames), "phase")
        self._sums.push(frames, phase, check_weights(weights, len(frames)), block.lent)

    def result(self) -> Correlation:
        """Return the fit of the frames so far, or of those in the window; more may follow.

        Raises
        ------
        mirrorskin.io.InputError
            Their phases do not determine a fit yet.
        """
        return tell_wave(self._sums)

    def reset(self) -> None:
        """Forget the frames so far."""
        self._sums.reset()


def tell_wave(sums: TurnSums | WindowSums) -> Correlation:
    """Return the fit that sums tell; see ``Correlator.result``."""
    phase, weight = sums.seen()
    used = weight > 0
    check_phases(phase[used], weight[used])
    mean, cosine, sine, residual = sums.solve()
    return Correlation(mean, cosine, sine, residual, int(np.count_nonzero(used)))


_STEPS = {1: 2**17, 2: 2**23}  # of a cosine, by bytes of a count: no sum in kernels/correlation.cl overflows
_PIECE = 256  # frames that a kernel is told of at once
_MOST = 2**23  # frames that an accumulator of counts can take
_SUMS = ("total", "cosine_sum", "sine_sum", "square")
_PAIRS = ("reference", *_SUMS)
_ANSWERS = ("wave mean", "wave cosine", "wave sine", "wave residual")


class Sums:
    """Sums over frames on a device, and the fit that they tell.

    Whole counts of frames of weight 0 or 1 are summed as integers, anything else as pairs of floats; see
    ``mirrorskin.kernels.correlation``.
    """

    def __init__(
        self,
        device: Device,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        maps: Mapping[str, DTypeLike | Planes],
        length: int,
        wide: bool,
    ) -> None:
        self._device = device
        self._size = dtype.itemsize
        self._integer = dtype.kind == "u"
        self._steps = np.array([1, *2 * [_STEPS.get(dtype.itemsize, 1)]])
        self._macros: dict[str, str | int] = {
            "FRAME": C_TYPES[dtype.name],
            "BITS": 8 * dtype.itemsize,
            "WIDE": int(wide and self._integer),
        }
        answers = dict.fromkeys(_ANSWERS, np.float32)
        self._bands = cut_into_bands(device, shape, dtype, {**maps, **answers}, length)
        alone = len(self._bands) == 1
        self.room = self._bands[0].frames.host if alone else np.empty((length, *shape), dtype)
        self._place = device.array("place", (_PIECE,), np.int32)
        self._whole = device.array("basis", (max(6 * WINDOW, 3 * _PIECE),), np.int32)
        self._real = device.array("basis", (3 * _PIECE,), np.float32)
        self._fit = device.array("fit", (28,), np.float32)

    def _whole_rows(self, phase: Doubles, weight: Doubles) -> Doubles:
        """Return 1, cos alpha and sin alpha, (N, 3), in whole steps; zeros for other weights than 1."""
        return np.where((weight == 1)[:, np.newaxis], np.rint(basis(phase) * self._steps), 0)

    def _stage(self, frames: NDArray[Any], lent: bool) -> Iterator[tuple[Band, Staged]]:
        """Have each band at work on its rows of the frames; yield which of these are on the device."""
        for band in self._bands:
            with band.resident():
                for staged in band.stage(frames, lent):
                    yield band, staged

    def _run(self, band: Band, name: str, *arguments: str | int | Operand | np.generic, moved: int) -> None:
        """Run a kernel over a band, whose maps are told by their names; ``moved`` is bytes a pixel."""
        values: list[Operand | np.generic] = []
        for argument in arguments:
            if isinstance(argument, str):
                values.append(band.maps[argument])
            else:
                values.append(np.int32(argument) if isinstance(argument, int) else argument)
        kernel = self._device.kernel("correlation", name, **self._macros)
        kernel(-(-band.pixels // self._device.layout.tile), *values, moved=moved * band.pixels)

    def _answer(
        self, name: str, known: Callable[[Band], Sequence[str | int | Array | np.generic]], moved: int
    ) -> list[NDArray[np.float32]]:
        """Have a kernel turn what is known of each band into mean, cosine, sine and residual, (H, W)."""
        parts = []
        for band in self._bands:
            with band.resident():
                self._run(band, name, *known(band), self._fit, *_ANSWERS, moved=moved)
                parts.append([band.maps[answer].download() for answer in _ANSWERS])
        return [np.concatenate(part) for part in zip(*parts, strict=True)]

    def _answer_counts(self, phase: Doubles, rows: Doubles, size: int) -> list[NDArray[np.float32]]:
        """Return the answers that integer sums of ``size`` bytes tell."""
        _fill(self._fit, _fit_table(phase, rows))
        counted = _counted(rows)
        moved = 4 * (size + 4)
        return self._answer("correlation_solve_counts", lambda band: (band.pixels, *counted, *_SUMS), moved)


class TurnSums(Sums):
    """Sums over all frames so far."""

    def __init__(self, device: Device, shape: tuple[int, int], dtype: np.dtype[Any], length: int) -> None:
        # Eight bytes, for a whole number or for two floats.
        maps = {"reference": np.float32, **dict.fromkeys(_SUMS, np.int64)}
        super().__init__(device, shape, dtype, maps, length, wide=True)
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._phase: list[float] = []
        self._weight: list[float] = []
        self._counts: int | None = None if self._integer else 0  # frames in integer sums; None for all
        for band in self._bands:
            for name in _SUMS:
                band.write(name, 0)

    def seen(self) -> tuple[Doubles, Doubles]:
        """Return phases and weights of the frames so far."""
        return np.array(self._phase, np.float64), np.array(self._weight, np.float64)

    def push(self, frames: NDArray[Any], phase: Doubles, weight: Doubles, lent: bool = False) -> None:
        """Add some frames: whole counts as integers, until the first weight that is neither 0 nor 1."""
        if len(self._phase) + len(frames) > _MOST:
            raise InputError(f"sums hold {_MOST} frames: take the result of those so far, and reset")
        if self._counts is None:
            fractions = np.flatnonzero((weight != 0) & (weight != 1))
            whole = slice(fractions[0] if len(fractions) else len(frames))
            self._add(frames[whole], phase[whole], weight[whole], lent)
            frames, phase, weight = (part[whole.stop :] for part in (frames, phase, weight))
        if len(frames) > 0:
            self._convert()
            self._sum(frames, phase, weight, lent)

    def solve(self) -> list[NDArray[np.float32]]:
        """Return mean, cosine, sine and residual of all frames, (H, W) each."""
        phase, weight = self.seen()
        rows = self._whole_rows(phase, weight)
        if self._counts is None:
            return self._answer_counts(phase, rows, size=8)
        rows /= self._steps
        rows[self._counts :] = _real_rows(phase, weight)[self._counts :]
        _fill(self._fit, _fit_table(phase, rows))
        return self._answer("correlation_solve_pairs", lambda band: (band.pixels, *_PAIRS), moved=52)

    def _add(self, frames: NDArray[Any], phase: Doubles, weight: Doubles, lent: bool) -> None:
        """Add frames of weight 0 or 1 to integer sums."""
        rows = self._whole_rows(phase, weight)
        for band, staged, places in self._pieces(frames, weight, lent):
            _fill(self._whole, rows[staged.frames.start + places])
            known = len(places), band.pixels, self._place, self._whole
            moved = self._size * len(places) + 64
            self._run(band, "correlation_add", staged.array, *known, *_SUMS, moved=moved)
        self._note(phase, weight)

    def _sum(self, frames: NDArray[Any], phase: Doubles, weight: Doubles, lent: bool) -> None:
        """Add frames of any weight to sums that are pairs of floats."""
        rows, fresh = _real_rows(phase, weight), not any(self._weight)
        for band, staged, places in self._pieces(frames, weight, lent):
            start = staged.frames.start
            first = fresh and not np.any(weight[: start + places[0]])
            _fill(self._real, rows[start + places])
            known = len(places), band.pixels, int(first), self._place, self._real
            moved = self._size * len(places) + 72
            self._run(band, "correlation_sum", staged.array, *known, *_PAIRS, moved=moved)
        self._note(phase, weight)

    def _pieces(
        self, frames: NDArray[Any], weight: Doubles, lent: bool
    ) -> Iterator[tuple[Band, Staged, NDArray[np.intp]]]:
        """Yield frames on the device, and the places in them of those that count."""
        for band, staged in self._stage(frames, lent):
            used = np.flatnonzero(weight[staged.frames])
            for piece in range(0, len(used), _PIECE):
                places = used[piece : piece + _PIECE]
                _fill(self._place, places)
                yield band, staged, places

    def _note(self, phase: Doubles, weight: Doubles) -> None:
        self._phase += phase.tolist()
        self._weight += weight.tolist()

    def _convert(self) -> None:
        """Turn integer sums, if there still are any, into pairs of floats."""
        if self._counts is not None:
            return
        phase, weight = self.seen()
        self._counts = len(phase)
        if np.any(weight):
            counted = _counted(self._whole_rows(phase, weight))
            step = np.float32(1 / self._steps[1])
            for band in self._bands:
                with band.resident():
                    self._run(band, "correlation_convert", band.pixels, *counted, step, *_PAIRS, moved=68)


class WindowSums(Sums):
    """The last frames of an endless rotation: integer sums move on with it, anything else is summed anew."""

    def __init__(
        self,
        device: Device,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        length: int,
        window: int,
        beside: Mapping[str, DTypeLike | Planes],
    ) -> None:
        self._window = window
        self._width = {1: 4, 2: 8}.get(dtype.itemsize, 0)  # bytes of an integer sum
        sums = dict.fromkeys(_SUMS if self._width else (), f"i{self._width}")
        maps = {"ring": Planes(window, dtype), **sums, **beside}
        super().__init__(device, shape, dtype, maps, length, wide=False)
        self.reset()

    @property
    def bands(self) -> list[Band]:
        """Where the frames are: map ``ring`` of each band holds its rows of them."""
        return self._bands

    @property
    def oldest(self) -> int:
        """Plane of the ring that the oldest frame of a full window is in; the next frame goes there."""
        return self._next

    def reset(self) -> None:
        """Forget the frames so far."""
        self._phase, self._weight = np.zeros((2, self._window))  # the oldest frame first; weight 0 for none
        self._next = 0  # plane of the ring that the next frame goes to
        for band in self._bands:
            for name in _SUMS if self._integer else ():
                band.write(name, 0)

    def seen(self) -> tuple[Doubles, Doubles]:
        """Return phases and weights of the frames in the window."""
        return self._phase, self._weight

    def push(self, frames: NDArray[Any], phase: Doubles, weight: Doubles, lent: bool = False) -> None:
        """Move the window on; of a block that is longer than it, only the end is ever in it."""
        frames, phase, weight = (part[-self._window :] for part in (frames, phase, weight))
        phase, weight = np.concatenate([self._phase, phase]), np.concatenate([self._weight, weight])
        rows = self._whole_rows(phase, weight)
        moves = np.hstack([rows[self._window :], rows[: len(frames)]])
        for band, staged in self._stage(frames, lent):
            count, there = staged.count, staged.frames
            place = count, band.pixels, band.stride, self._next + there.start, self._window
            if not self._integer:
                moved = 2 * self._size * count
                self._run(band, "correlation_keep", staged.array, *place, "ring", moved=moved)
                continue
            _fill(self._whole, moves[there])
            moved = 3 * self._size * count + 8 * self._width
            known = *place, self._whole, "ring", *_SUMS
            self._run(band, "correlation_slide", staged.array, *known, moved=moved)
        self._next = (self._next + len(frames)) % self._window
        self._phase, self._weight = phase[-self._window :], weight[-self._window :]

    def solve(self) -> list[NDArray[np.float32]]:
        """Return mean, cosine, sine and residual of the window's frames, (H, W) each."""
        phase, weight = self.seen()
        if self._integer and np.all((weight == 0) | (weight == 1)):
            return self._answer_counts(phase, self._whole_rows(phase, weight), self._width)
        rows, used = _real_rows(phase, weight), np.flatnonzero(weight)
        _fill(self._fit, _fit_table(phase, rows))
        _fill(self._place, (self._next + used) % self._window)
        _fill(self._real, rows[used])
        return self._answer(
            "correlation_window",
            lambda band: ("ring", len(used), band.pixels, band.stride, self._place, self._real),
            self._size * len(used) + 16,
        )


def _real_rows(phase: Doubles, weight: Doubles) -> Doubles:
    """Return w, w cos alpha and w sin alpha, (N, 3), as float32 has them."""
    return (basis(phase) * weight[:, np.newaxis]).astype(np.float32).astype(np.float64)


def _counted(rows: Doubles) -> tuple[int, np.int64, np.int64]:
    """Return how many frames are in integer sums, and the sums of their cosines and sines, in steps."""
    frames, cosines, sines = np.sum(rows.astype(np.int64), axis=0)
    return int(frames), cosines, sines


def _fit_table(phase: Doubles, rows: Doubles) -> NDArray[np.float32]:
    """Return what ``mirrorskin.kernels.correlation`` calls the fit, (28,) float32.

    Parameters
    ----------
    phase : ndarray, (N,), float64
    rows : ndarray, (N, 3), float64
        Z: what the samples were multiplied by before they were summed. The first column is the weights.
    """
    weight, exact = rows[:, :1], basis(phase)
    root = np.asarray(np.linalg.qr(np.sqrt(weight) * exact, mode="r"))
    project = np.linalg.solve((rows.T @ exact).T, root.T).T.ravel()
    high = project.astype(np.float32)
    freedom = np.count_nonzero(weight) - 3
    share = 1 / freedom if freedom > 0 else np.nan
    return np.concatenate([high, project - high, np.linalg.inv(root).ravel(), [share]]).astype(np.float32)


def _fill(array: Array, values: NDArray[Any]) -> None:
    """Hand a table to the device."""
    array.claim()
    array.host[: values.size] = values.ravel()
    array.upload(values.size)
