"""Mean, cosine and sine of the brightness over an axial rotation (paper, section 4: equations 17 to 22).

A device stores four sums per pixel, of E, E cos alpha, E sin alpha and E^2, and solves the fit from them.
Integer samples of frames with weights 0 and 1 are summed as integers, with cosines rounded to multiples of
2^-17 or 2^-23: these sums are exact and do not depend on how frames are divided into blocks. Other samples
are summed as pairs of floats, in the order of the frames. See `mirrorskin.kernels.correlation`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.device_arrays import AnyArray, on_host
from mirrorskin.engine.functions import phase_function
from mirrorskin.engine.operation import Operation
from mirrorskin.engine.options import option
from mirrorskin.engine.rotation.design_matrix import basis, check_phases, check_weights
from mirrorskin.engine.tiling import Band, Planes, cut_into_bands, for_each_band, join_rows, staging_buffer_of
from mirrorskin.io import InputError, Result
from mirrorskin.io.maps import TABLE
from mirrorskin.io.positions import check_phase
from mirrorskin.io.types import FRAME_DTYPES
from mirrorskin.kernels.array import Array, Operand
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.correlation import WINDOW
from mirrorskin.kernels.device import C_TYPES, Device

_STEPS = {1: 2**17, 2: 2**23}  # steps per unit of a cosine, by bytes of a sample: no integer sum overflows
_BATCH = 256  # frames per launch
_MAX_FRAMES = 2**23  # limit of integer sums
# Maps of a band, by the arguments of kernels.
_SUMS = {"total": "sum", "cosine": "cosine sum", "sine": "sine sum", "square": "square sum"}
_PAIRS = {"reference": "reference", **_SUMS}
_FIT = {name: f"wave {name}" for name in ("mean", "cosine_part", "sine_part", "residual")}


class CorrelationOperation(Operation):
    """Base of operations that fit mean, cosine and sine of a phase to each pixel's brightness."""

    dtypes = FRAME_DTYPES
    for_device = True

    def _window(self) -> int | None:
        """Return the number of the last frames that are fitted; None for all."""
        return None

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        self._stack: tuple[AnyArray, Doubles, Doubles] | None = None

    @cached_property
    def _sums(self) -> TurnSums | WindowSums:
        window, length = self._window(), self.frames_at_once
        if window is None:
            return TurnSums(self.devices, self.shape, self.dtype, length)
        return WindowSums([self.device], self.shape, self.dtype, length, window)

    @property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return self._sums.staging_buffer

    def _push(self, frames: AnyArray, alpha: Doubles, weights: Doubles) -> None:
        """Process frames with the phase and the weight of each."""
        windowed, whole = self._window() is not None, self._stay_valid and self.count == 0
        if whole and not windowed and StackSums.take(frames, weights):
            self._stack = frames, alpha, weights  # summed and solved by one kernel, unless more frames follow
            return
        if self._stack is not None:
            self._sums.push(*self._stack, stay_valid=True)
            self._stack = None
        self._sums.push(on_host(frames) if windowed else frames, alpha, weights, self._stay_valid)

    def _fit(self) -> Result:
        """Return the fit of the frames so far, or of those in the window."""
        if self._stack is None:
            return self._sums.result(self._on_device and self._window() is None)
        frames, alpha, weights = self._stack
        check_phases(alpha, weights)
        sums = StackSums(self.devices, self.shape, self.dtype, len(frames))
        sums.push(frames, alpha, weights)
        return sums.result(self._on_device)


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


class _Tables:
    """The small tables of a launch, on a device."""

    def __init__(self, device: Device) -> None:
        self.place: Array = device.array("place", (_BATCH,), np.int32, zeroed=False)
        self.steps: Array = device.array("basis", (3 * _BATCH,), np.int32, zeroed=False)
        self.floats: Array = device.array("basis", (3 * _BATCH,), np.float32, zeroed=False)
        self.fit: Array = device.array("fit", (28,), np.float32, zeroed=False)


class _Sums:
    """Sums over frames on devices, and the fit that they determine."""

    _phase: Doubles
    _weight: Doubles

    def __init__(
        self,
        devices: Sequence[Device],
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        maps: Mapping[str, DTypeLike | Planes],
        length: int,
        least: int = 1,
    ) -> None:
        self._size, self._integer = dtype.itemsize, dtype.kind == "u"
        self._step = _STEPS.get(dtype.itemsize, 1)
        self._macros: dict[str, str | int] = {"FRAME": C_TYPES[dtype.name], "BITS": 8 * dtype.itemsize}
        maps = {**maps, **dict.fromkeys(_FIT.values(), np.float32)}
        self.bands: list[Band] = cut_into_bands(devices, shape, dtype, maps, length, least)
        self._length = length
        self._tables = {device: _Tables(device) for device in devices}

    @cached_property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return staging_buffer_of(self.bands, self._length)

    @property
    def frames(self) -> tuple[Doubles, Doubles]:
        """Phases and weights of the frames; the weight of a missing frame is 0."""
        return self._phase, self._weight

    def result(self, on_device: bool = False) -> Result:
        """Return the fit, optionally with maps on the device; InputError if phases do not determine it."""
        used = self._weight > 0
        check_phases(self._phase[used], self._weight[used])
        self._solve()

        def take_fit(band: Band) -> list[Any]:
            with band.resident():
                if on_device:
                    return [band.cut(name) for name in _FIT.values()]
                return band.fetch(dict.fromkeys(_FIT.values(), slice(None)))

        parts = for_each_band(self.bands, take_fit)
        mean, cosine, sine, residual = (join_rows(part) for part in zip(*parts, strict=True))
        return Result(
            mean=mean,
            cosine=cosine,
            sine=sine,
            modulation=partial(_modulation, cosine, sine),
            azimuth=partial(_azimuth, cosine, sine),
            residual=residual,
            process={"frames": int(np.count_nonzero(used))},
        )

    def _solve(self) -> None:
        """Write mean, cosine, sine and residual to the bands' maps."""
        raise NotImplementedError

    def _rows_in_steps(self, phase: Doubles, weight: Doubles) -> Doubles:
        """Return 1, cos alpha and sin alpha, (N, 3), in integer steps; zeros unless the weight is 1."""
        steps = np.array([1, self._step, self._step])
        return np.where((weight == 1)[:, np.newaxis], np.rint(basis(phase) * steps), 0)

    def _run(self, band: Band, name: str, moved: int, **arguments: Any) -> None:
        """Run a kernel over a band; ``moved`` is bytes per pixel."""
        kernel = band.device.kernel("correlation", name, **self._macros)
        items = -(-band.pixels // band.device.layout.tile)
        kernel(items, pixels=band.pixels, moved=moved * band.pixels, **arguments)

    def _run_at_once(
        self,
        band: Band,
        frames: Operand,
        stride: int,
        places: NDArray[np.intp],
        phase: Doubles,
        weight: Doubles,
    ) -> None:
        """Sum and solve at most `WINDOW` frames on the device."""
        used, name, tables = np.flatnonzero(weight), "correlation_window", self._tables[band.device]
        counts: dict[str, int] = {}
        if self._integer and _are_counts(weight):
            rows, basis = self._rows_in_steps(phase, weight), tables.steps
            counts = _counted(rows)
        else:
            rows, basis, name = _float_rows(phase, weight), tables.floats, f"{name}_pairs"
        _fill(tables.fit, _fit_table(phase, rows))
        _fill(tables.place, places[used])
        _fill(basis, rows[used])
        count = len(used)
        self._run(
            band, name, self._size * count + 16, frames=frames, count=count, stride=stride,
            place=tables.place, basis=basis, fit=tables.fit, **counts, **_maps_of(band, _FIT),
        )  # fmt: skip


class StackSums(_Sums):
    """Sums over a complete stack, which one kernel computes and solves, without storing them."""

    def __init__(
        self, devices: Sequence[Device], shape: tuple[int, int], dtype: np.dtype[Any], length: int
    ) -> None:
        super().__init__(devices, shape, dtype, {}, length, least=length)

    @staticmethod
    def take(frames: AnyArray, weight: Doubles) -> bool:
        """Return whether a stack is short enough, and its weights allow integer sums."""
        few = np.count_nonzero(weight) <= WINDOW
        in_order = isinstance(frames, Array) or (frames.flags.c_contiguous and frames.flags.aligned)
        return bool(few and in_order and (frames.dtype.kind == "f" or _are_counts(weight)))

    def push(self, frames: AnyArray, phase: Doubles, weight: Doubles) -> None:
        """Sum all frames, which must not change before the result is returned."""
        self._phase, self._weight = phase, weight

        def run(band: Band) -> None:
            with band.resident():
                for staged in band.stage(frames, stay_valid=True, whole=True):
                    self._run_at_once(band, staged.array, band.pixels, np.arange(len(frames)), phase, weight)

        for_each_band(self.bands, run)

    def _solve(self) -> None:
        """Do nothing: `push` has solved the fit."""


class TurnSums(_Sums):
    """Sums over all frames so far: integers until the first weight that is neither 0 nor 1, then pairs."""

    def __init__(
        self, devices: Sequence[Device], shape: tuple[int, int], dtype: np.dtype[Any], length: int
    ) -> None:
        # Eight bytes are one integer or two floats.
        maps = {"reference": np.float32, **dict.fromkeys(_SUMS.values(), np.int64)}
        super().__init__(devices, shape, dtype, maps, length)
        self._phase, self._weight = np.empty((2, 0))
        self._counts: int | None = (
            None if self._integer else 0
        )  # frames that were summed as integers; None: all

    def push(self, frames: AnyArray, phase: Doubles, weight: Doubles, stay_valid: bool = False) -> None:
        """Add some frames."""
        if len(self._phase) + len(frames) > _MAX_FRAMES:
            raise InputError(
                f"at most {_MAX_FRAMES} frames can be summed: take the result so far, and start a new run"
            )
        if self._counts is None:
            fractions = np.flatnonzero((weight != 0) & (weight != 1))
            whole = slice(fractions[0] if len(fractions) else len(frames))
            self._add(frames[whole], phase[whole], weight[whole], stay_valid)
            frames, phase, weight = (part[whole.stop :] for part in (frames, phase, weight))
        if len(frames) > 0:
            self._convert_to_pairs()
            self._add(frames, phase, weight, stay_valid)

    def _solve(self) -> None:
        rows = self._rows_in_steps(self._phase, self._weight)
        name, moved, sums, counts = "counts", 48, _SUMS, _counted(rows)
        if self._counts is not None:
            rows /= [1, self._step, self._step]
            rows[self._counts :] = _float_rows(self._phase, self._weight)[self._counts :]
            name, moved, sums, counts = "pairs", 52, _PAIRS, {}
        table = _fit_table(self._phase, rows)
        for tables in self._tables.values():
            _fill(tables.fit, table)

        def solve(band: Band) -> None:
            with band.resident():
                maps, fit = _maps_of(band, {**sums, **_FIT}), self._tables[band.device].fit
                self._run(band, f"correlation_solve_{name}", moved, fit=fit, **maps, **counts)

        for_each_band(self.bands, solve)

    def _add(self, frames: AnyArray, phase: Doubles, weight: Doubles, stay_valid: bool) -> None:
        """Add frames to integer sums, or to pairs."""
        counts = self._counts is None
        rows = self._rows_in_steps(phase, weight) if counts else _float_rows(phase, weight)
        fresh = not np.any(self._weight)

        def add(band: Band) -> None:
            tables = self._tables[band.device]
            basis, name = (tables.steps, "add") if counts else (tables.floats, "sum")
            with band.resident():
                for staged in band.stage(frames, stay_valid):
                    used = staged.frames.start + np.flatnonzero(weight[staged.frames])
                    for start in range(0, len(used), _BATCH):
                        places = used[start : start + _BATCH]
                        _fill(tables.place, places - staged.frames.start)
                        _fill(basis, rows[places])
                        arguments = _maps_of(band, _SUMS if counts else _PAIRS)
                        arguments |= {"frames": staged.array, "count": len(places), "stride": band.pixels}
                        arguments |= {"place": tables.place, "basis": basis}
                        arguments["fresh"] = fresh and not np.any(weight[: places[0]])
                        moved = self._size * len(places) + (64 if counts else 72)
                        self._run(band, f"correlation_{name}", moved, **arguments)

        for_each_band(self.bands, add)
        self._phase = np.concatenate([self._phase, phase])
        self._weight = np.concatenate([self._weight, weight])

    def _convert_to_pairs(self) -> None:
        """Convert integer sums, if there are any, to pairs of floats."""
        if self._counts is not None:
            return
        self._counts = len(self._phase)
        if np.any(self._weight):
            counts = _counted(self._rows_in_steps(self._phase, self._weight))

            def convert(band: Band) -> None:
                with band.resident():
                    sums = _maps_of(band, _PAIRS)
                    self._run(band, "correlation_convert", 68, unit=1 / self._step, **counts, **sums)

            for_each_band(self.bands, convert)


class WindowSums(_Sums):
    """The last frames of an endless rotation, which are summed when the fit is computed.

    The map ``ring`` of each band is a ring buffer of frames; ``oldest`` is the index of the oldest frame of a
    full window, which the next frame replaces.
    """

    def __init__(
        self,
        devices: Sequence[Device],
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        length: int,
        window: int,
        other_maps: Mapping[str, DTypeLike | Planes] | None = None,
    ) -> None:
        self._window = window
        maps = {"ring": Planes(window, dtype), **(other_maps or {})}
        super().__init__(devices, shape, dtype, maps, length)
        self._phase, self._weight = np.zeros((2, self._window))  # oldest frame first; weight 0: no frame
        self.oldest: int = 0

    def push(self, frames: AnyArray, phase: Doubles, weight: Doubles, stay_valid: bool = False) -> None:
        """Add frames to the window, and remove as many of the oldest."""
        frames, phase, weight = (part[-self._window :] for part in (frames, phase, weight))
        for band in self.bands:
            with band.resident():
                for number, frame in enumerate(frames[:, band.rows], self.oldest):
                    band.maps["ring"].write(frame, number % self._window)
        self.oldest = (self.oldest + len(frames)) % self._window
        self._phase = np.concatenate([self._phase, phase])[-self._window :]
        self._weight = np.concatenate([self._weight, weight])[-self._window :]

    def _solve(self) -> None:
        places = (self.oldest + np.arange(self._window)) % self._window
        for band in self.bands:
            with band.resident():
                ring = band.maps["ring"]
                self._run_at_once(band, ring, band.stride, places, self._phase, self._weight)


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


def _maps_of(band: Band, names: Mapping[str, str]) -> dict[str, Any]:
    """Return maps of a band by the arguments of kernels."""
    return {argument: band.maps[name] for argument, name in names.items()}


def _float_rows(phase: Doubles, weight: Doubles) -> Doubles:
    """Return w, w cos alpha and w sin alpha, (N, 3), rounded to float32."""
    return (basis(phase) * weight[:, np.newaxis]).astype(np.float32).astype(np.float64)


def _counted(rows: Doubles) -> dict[str, int]:
    """Return the number of frames in integer sums, and the sums of their cosines and sines, in steps."""
    used, cosines, sines = np.sum(rows.astype(np.int64), axis=0)
    return {"used": int(used), "cosines": int(cosines), "sines": int(sines)}


def _fit_table(phase: Doubles, rows: Doubles) -> NDArray[np.float32]:
    """Return the table "fit" of `mirrorskin.kernels.correlation`, (28,) float32.

    ``rows``, (N, 3), is Z: the factors of the samples in the sums, the weights first.
    """
    weight, exact = rows[:, :1], basis(phase)
    root = np.asarray(np.linalg.qr(np.sqrt(weight) * exact, mode="r"))
    project = np.linalg.solve((rows.T @ exact).T, root.T).T.ravel()
    high = project.astype(np.float32)
    freedom = np.count_nonzero(weight) - 3
    share = 1 / freedom if freedom > 0 else np.nan
    return np.concatenate([high, project - high, np.linalg.inv(root).ravel(), [share]]).astype(np.float32)


def _fill(array: Array, values: NDArray[Any]) -> None:
    """Copy a table to the device."""
    array.write(values.ravel())
