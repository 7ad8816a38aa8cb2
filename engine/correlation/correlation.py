"""Mean, cosine and sine of the brightness over an axial rotation (paper, section 4: equations 17 to 22).

A device stores four sums per pixel, of E, E cos alpha, E sin alpha and E^2, and solves the fit from them.
Integer samples of frames with weights 0 and 1 are summed as integers, with cosines rounded to multiples of
2^-17 or 2^-23: these sums are exact and do not depend on how frames are divided into blocks. Other samples
are summed as pairs of floats, in the order of the frames. See `mirrorskin.kernels.rotation.correlation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, on_host
from mirrorskin.engine.base.functions import phase_function
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.picture import PerFrame, Picture
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.correlation.design_matrix import basis, check_phases, check_weights
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.model.maps import TABLE
from mirrorskin.io.model.positions import check_phase
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.correlation import WINDOW

_STEPS_PER_UNIT = {
    1: 2**17,
    2: 2**23,
}  # steps per unit of a cosine, by bytes of a sample: no integer sum overflows
_MAX_FRAMES = 2**23  # limit of integer sums
_SUMS = "total", "cosine", "sine", "square"
_FIT = "mean", "cosine_part", "sine_part", "residual"


class CorrelationOperation(Operation):
    """Base of operations that fit mean, cosine and sine of a phase to each pixel's brightness."""

    dtypes = FRAME_DTYPES
    for_device = True
    _more_maps: ClassVar[Mapping[str, Any]] = {}
    """Types of maps that are computed from the fit, besides its own."""

    def _window(self) -> int | None:
        """Return the number of the last frames that are fitted; None for all."""
        return None

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        self._stack: tuple[AnyArray, Doubles, Doubles] | None = None

    @cached_property
    def _sums(self) -> TurnSums | WindowSums:
        window = self._window()
        if window is None:
            return TurnSums(self)
        return WindowSums(Picture(self, "correlation", WindowSums.maps_of(self, window)), self.dtype, window)

    @property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return self._sums.maps.staging_buffer

    def _push(self, frames: AnyArray, alpha: Doubles, weights: Doubles) -> None:
        """Process frames with the phase and the weight of each."""
        windowed, whole = self._window() is not None, self._stay_valid and self.count == 0
        if whole and not windowed and StackSums.take(frames, weights):
            self._stack = frames, alpha, weights  # summed and solved by one kernel, unless more frames follow
            return
        if self._stack is not None:
            stack, self._stack = self._stack, None
            self._sums.push(*stack)
        self._sums.push(on_host(frames) if windowed else frames, alpha, weights)

    def _fit(self) -> Result:
        """Return the fit of the frames so far, or of those in the window."""
        return self._frame_sums().result(on_host=self._window() is not None)

    def _frame_sums(self) -> TurnSums | WindowSums | StackSums:
        """Return the sums over the frames so far, or over those in the window."""
        return self._sums if self._stack is None else StackSums(self, *self._stack)


class Correlate(CorrelationOperation):
    """Least-squares fit of mean, cosine and sine of the phase to each pixel's brightness.

    It minimises SS = sum_k w_k (E_k - mean - cosine cos alpha_k - sine sin alpha_k)^2. For N evenly spaced
    phases, sine and cosine are 2/N times the sums that correspond to the paper's integrals S and C (equations
    17 and 20), that is, gain times tilt times sine and cosine of the azimuth (equations 19 and 22). Uneven
    phases mix the three coefficients, which least squares separates.

    The residual is sqrt(SS / (N - 3)), the standard deviation of a sample of weight 1; it is undefined if N
    is 3. The modulation is the amplitude sqrt(cosine^2 + sine^2), and the azimuth is the phase of the
    maximum, atan2(sine, cosine). ``process`` contains the number N of ``frames`` whose weight is not 0.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> run = engine.Run(engine.Correlate())
    >>> for phase in np.arange(8) * np.pi / 4:
    ...     run.push(np.full((1, 2, 3), 100 + 20 * np.sin(phase), np.uint8), phase=[phase])
    >>> float(run.result().sine[0, 0].round())
    20.0
    """

    mean = TABLE["mean"]
    cosine = TABLE["cosine"]
    sine = TABLE["sine"]
    modulation = TABLE["modulation"]
    azimuth = TABLE["azimuth"]
    residual = TABLE["residual"]

    harmonic: int = option(
        default=1,
        within=(1, None),
        help="multiple of the phase that is fitted: alpha is this multiple. Other multiples do not contribute"
        " if the phases are evenly spaced over whole turns",
    )
    window_frames: int | None = option(
        default=None,
        unit="frames",
        within=(3, WINDOW),
        help=f"number of the last frames that are fitted, 3 to {WINDOW}: a turn of an endless rotation",
        shown_default="all frames",
    )

    def _window(self) -> int | None:
        return self.window_frames

    def push(self, frames: NDArray[Any], *, phase: ArrayLike, frame_weights: ArrayLike | None = None) -> None:
        """Process the next frames, (n, H, W), the phase of each, (n,) radians, and their weights, (n,)."""
        alpha = self.harmonic * check_phase(phase, len(frames), "phase")
        weights = check_weights(frame_weights, len(frames))
        self._push(frames, alpha, weights)

    def result(self) -> Result:
        """Return the fit of the frames so far, or of those in the window."""
        return self._fit()


correlate = phase_function(
    Correlate,
    "correlate",
    """Fit mean, cosine and sine of the phase to a stack that fits in memory; see `Correlate`.

    Returns
    -------
    Result
        ``mean``, ``cosine``, ``sine``, ``modulation`` and ``residual``, counts; ``azimuth``, radians. NaN
        where a sample is not a number.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, phases or weights that cannot be used, or phases that do not determine the fit.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> phase = np.arange(8) * np.pi / 4
    >>> frames = (100 + 10 * np.cos(phase - 1)[:, None, None] * np.ones((2, 3))).astype(np.float32)
    >>> round(float(engine.correlate(frames, phase).azimuth[0, 0]), 4)
    1.0
    """,
    "Radians.",
)


class _Sums:
    """Sums over frames on devices, and the fit that they determine."""

    phase: Doubles
    weight: Doubles  # 0 of a missing frame

    def __init__(self, maps: Picture, dtype: np.dtype[Any]) -> None:
        self.maps, self._integer, self._step = maps, dtype.kind == "u", _STEPS_PER_UNIT.get(dtype.itemsize, 1)

    def result(self, *, on_host: bool = False) -> Result:
        """Return the fit, with maps on the device if frames are; InputError if phases do not determine it."""
        used = self.solve()
        mean, cosine, sine, residual = self.maps.take(*_FIT, on_host=on_host)
        return Result(
            mean=mean,
            cosine=cosine,
            sine=sine,
            modulation=partial(_modulation, cosine, sine),
            azimuth=partial(_azimuth, cosine, sine),
            residual=residual,
            process={"frames": int(np.count_nonzero(used))},
        )

    def solve(self) -> NDArray[np.bool_]:
        """Compute the maps of the fit, and return which frames have a weight; see `result`."""
        used = self.weight > 0
        check_phases(self.phase[used], self.weight[used])
        self._solve()
        return used

    def _solve(self) -> None:
        """Compute the maps of the fit."""
        raise NotImplementedError

    def _rows_in_steps(self, phase: Doubles, weight: Doubles) -> NDArray[np.int32]:
        """Return 1, cos alpha and sin alpha, (N, 3), in integer steps; zeros unless the weight is 1."""
        steps = np.array([1, self._step, self._step])
        rows = np.where((weight == 1)[:, np.newaxis], np.rint(basis(phase) * steps), 0)
        return rows.astype(np.int32)

    def _window_kernel(self) -> tuple[str, NDArray[Any], dict[str, Any]]:
        """Return the kernel that sums and solves at most `WINDOW` frames, its basis and its arguments."""
        if self._integer and _are_counts(self.weight):
            rows = self._rows_in_steps(self.phase, self.weight)
            return "correlation_window", rows, {"fit": _fit_table(self.phase, rows), **_counted(rows)}
        floats = _float_rows(self.phase, self.weight)
        return "correlation_window_pairs", floats, {"fit": _fit_table(self.phase, floats)}


class StackSums(_Sums):
    """Sums over a complete stack, which one kernel computes and solves, without storing them."""

    def __init__(
        self, operation: CorrelationOperation, frames: AnyArray, phase: Doubles, weight: Doubles
    ) -> None:
        maps = {**dict.fromkeys(_FIT, np.float32), **operation._more_maps}
        super().__init__(Picture(operation, "correlation", maps, whole=len(frames)), operation.dtype)
        self.phase, self.weight, self._frames = phase, weight, frames

    @staticmethod
    def take(frames: AnyArray, weight: Doubles) -> bool:
        """Return whether a stack is short enough, and its weights allow integer sums."""
        few = np.count_nonzero(weight) <= WINDOW
        in_order = isinstance(frames, Array) or (frames.flags.c_contiguous and frames.flags.aligned)
        return bool(few and in_order and (frames.dtype.kind == "f" or _are_counts(weight)))

    def _solve(self) -> None:
        name, rows, arguments = self._window_kernel()
        self.maps.scan(
            name, self._frames, chosen=self.weight != 0, whole=True, basis=PerFrame(rows), **arguments
        )


class TurnSums(_Sums):
    """Sums over all frames so far: integers until the first weight that is neither 0 nor 1, then pairs."""

    def __init__(self, operation: CorrelationOperation) -> None:
        # Eight bytes are one integer or two floats.
        maps = {**dict.fromkeys(_SUMS, np.int64), **dict.fromkeys(("reference", *_FIT), np.float32)}
        maps |= operation._more_maps
        super().__init__(Picture(operation, "correlation", maps), operation.dtype)
        self.phase, self.weight = np.empty((2, 0))
        # Number of frames that were summed as integers; None: all.
        self._counts: int | None = None if self._integer else 0

    def push(self, frames: AnyArray, phase: Doubles, weight: Doubles) -> None:
        """Add some frames."""
        if len(self.phase) + len(frames) > _MAX_FRAMES:
            raise InputError(
                f"at most {_MAX_FRAMES} frames can be summed: take the result so far, and start a new run"
            )
        if self._counts is None:
            fractions = np.flatnonzero((weight != 0) & (weight != 1))
            whole = slice(fractions[0] if len(fractions) else len(frames))
            rows = self._rows_in_steps(phase[whole], weight[whole])
            self._add("correlation_add", frames[whole], phase[whole], weight[whole], rows)
            frames, phase, weight = (part[whole.stop :] for part in (frames, phase, weight))
        if len(frames) > 0:
            self._convert_to_pairs()
            self._add("correlation_sum", frames, phase, weight, _float_rows(phase, weight))

    def _solve(self) -> None:
        steps = self._rows_in_steps(self.phase, self.weight)
        if self._counts is None:
            table = _fit_table(self.phase, steps)
            self.maps.run("correlation_solve_counts", fit=table, **_counted(steps))
        else:
            rows = steps / [1, self._step, self._step]
            rows[self._counts :] = _float_rows(self.phase, self.weight)[self._counts :]
            self.maps.run("correlation_solve_pairs", fit=_fit_table(self.phase, rows))

    def _add(
        self, kernel: str, frames: AnyArray, phase: Doubles, weight: Doubles, rows: NDArray[Any]
    ) -> None:
        """Add frames to integer sums, or to pairs."""
        first = int(np.count_nonzero(self.weight))
        self.maps.scan(kernel, frames, first=first, chosen=weight != 0, basis=PerFrame(rows))
        self.phase = np.concatenate([self.phase, phase])
        self.weight = np.concatenate([self.weight, weight])

    def _convert_to_pairs(self) -> None:
        """Convert integer sums, if there are any, to pairs of floats."""
        if self._counts is not None:
            return
        self._counts = len(self.phase)
        if np.any(self.weight):
            counts = _counted(self._rows_in_steps(self.phase, self.weight))
            self.maps.run("correlation_convert", unit=1 / self._step, **counts)


class WindowSums(_Sums):
    """The last frames of an endless rotation, which are summed when the fit is computed.

    The map ``frames`` is a ring buffer; ``oldest`` is the number of the oldest frame of a full window, which
    the next frame replaces.
    """

    def __init__(self, maps: Picture, dtype: np.dtype[Any], window: int) -> None:
        super().__init__(maps, dtype)
        self.phase, self.weight = np.zeros((2, window))  # oldest frame first; weight 0: no frame
        self._window, self.oldest = window, 0

    @staticmethod
    def maps_of(operation: Operation, window: int) -> dict[str, Planes]:
        """Return the kinds of the maps for a window of so many frames."""
        fit = dict.fromkeys(_FIT, Planes(1, np.float32))
        return {"frames": Planes(window, operation.dtype), **fit}

    def push(self, frames: AnyArray, phase: Doubles, weight: Doubles) -> None:
        """Add frames to the window, and remove as many of the oldest."""
        frames, phase, weight = (part[-self._window :] for part in (frames, phase, weight))
        for number, frame in enumerate(frames, self.oldest):
            self.maps.fill("frames", frame, number % self._window)
        self.oldest = (self.oldest + len(frames)) % self._window
        self.phase = np.concatenate([self.phase, phase])[-self._window :]
        self.weight = np.concatenate([self.weight, weight])[-self._window :]

    def frames(self) -> NDArray[Any]:
        """Return the frames of a full window, (n, H, W), the oldest first."""
        return np.stack(self.maps.read(*(("frames", int(place)) for place in self._places)))

    @property
    def _places(self) -> NDArray[np.intp]:
        return (self.oldest + np.arange(self._window)) % self._window

    def _solve(self) -> None:
        name, rows, arguments = self._window_kernel()
        used = np.flatnonzero(self.weight)
        places = self._places[used].astype(np.int32)
        self.maps.run(
            name, source="correlation", basis=rows[used], place=places, count=len(used), **arguments
        )


def _modulation(cosine: Any, sine: Any) -> NDArray[np.float32]:
    """Return the amplitude of a wave."""
    a, b = np.asarray(cosine), np.asarray(sine)
    return np.asarray(np.sqrt(a * a + b * b))


def _azimuth(cosine: Any, sine: Any) -> NDArray[np.float32]:
    """Return the phase of the maximum of a wave, radians; NaN without one."""
    a, b = np.asarray(cosine), np.asarray(sine)
    return np.where((a == 0) & (b == 0), np.float32(np.nan), np.arctan2(b, a))


def _are_counts(weight: Doubles) -> bool:
    """Return whether frames of these weights can be summed as integers."""
    return bool(np.all((weight == 0) | (weight == 1)))


def _float_rows(phase: Doubles, weight: Doubles) -> Doubles:
    """Return w, w cos alpha and w sin alpha, (N, 3), rounded to float32."""
    return (basis(phase) * weight[:, np.newaxis]).astype(np.float32).astype(np.float64)


def _counted(rows: NDArray[np.int32]) -> dict[str, Any]:
    """Return the number of frames in integer sums, and the sums of their cosines and sines, in steps."""
    used, cosines, sines = (int(total) for total in np.sum(rows, axis=0, dtype=np.int64).flat)
    return {"used": used, "cosines": cosines, "sines": sines}


def _fit_table(phase: Doubles, rows: NDArray[Any]) -> NDArray[np.float32]:
    """Return the table "fit" of `mirrorskin.kernels.rotation.correlation`, (28,) float32.

    ``rows``, (N, 3), is Z: the factors of the samples in the sums, the weights first.
    """
    weight, exact = rows[:, :1], basis(phase)
    root = np.asarray(np.linalg.qr(np.sqrt(weight) * exact, mode="r"))
    project = np.linalg.solve((rows.T @ exact).T, root.T).T.ravel()
    high = project.astype(np.float32)
    freedom = np.count_nonzero(weight) - 3
    per_freedom = 1 / freedom if freedom > 0 else np.nan
    return np.concatenate([high, project - high, np.linalg.inv(root).ravel(), [per_freedom]]).astype(
        np.float32
    )
