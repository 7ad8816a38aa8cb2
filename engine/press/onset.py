"""Height from a vertical press: the travel at which a pixel turns light, or dark again (paper, section 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.autotune import fit
from mirrorskin.engine.frames import Noise, check_dtype, check_frames, check_threshold, reference_maps
from mirrorskin.engine.tiling import MEMORY_LIMIT, Band, Planes, cut_into_bands, join_rows
from mirrorskin.io import InputError, check_travel
from mirrorskin.kernels.array import Array, Operand
from mirrorskin.kernels.device import C_TYPES, Device, open_device
from mirrorskin.kernels.onset import DARK, complement

_PLATEAU = 3.0  # sigmas by which a sample may differ from the plateau that it sits on
_SURELY = 6.0  # sigmas by which a sample must miss the level so that its plateau is not near it
_ROUNDING = 1e-12  # a threshold such as 0.55 is not exact: counts that reach it but for rounding are light
_INT_MAX = np.iinfo(np.int32).max
_LONGEST = 2**30  # no stack is as long, and sums with frames' numbers stay in range


Event = Literal["onset", "release"]
EVENTS: tuple[Event, ...] = get_args(Event)


@dataclass(frozen=True, slots=True)
class Onset:
    """Where and when a press turned the pixels light, or a release dark again.

    Attributes
    ----------
    height, sigma : ndarray, (H, W), float32
        Millimetres, and the standard deviation of the height; NaN unless status is 1.
    status : ndarray, (H, W), uint8
        0 invalid input, 1 onset, 2 never light, 3 light at start; of a release: 0 invalid input, 1 release,
        2 dark at start, 3 light to the end.
    frame : ndarray, (H, W), int32
        Number of the first light frame, of a release of the first dark one; -1 without one.
    noise : float
        Standard deviation of a sample that was reckoned with, counts.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    status: NDArray[np.uint8]
    frame: NDArray[np.int32]
    noise: float


class Search:
    """Room for frames on a device, and the check of what is pushed.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    maps : mapping of str to dtype or Planes
        What is kept of each pixel.
    noise : float, optional
        Standard deviation of a sample in counts; by default told from the first two frames.
    event : {"onset", "release"}
    device : Device
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
        dtype: np.dtype[Any],
        maps: Mapping[str, DTypeLike | Planes],
        noise: float | None,
        event: Event,
        device: Device,
        memory_limit: int,
    ) -> None:
        check_dtype(dtype)
        if event not in EVENTS:
            raise InputError(f"unknown event {event!r}; known are {', '.join(EVENTS)}")
        self.device = device
        self._shape, self._dtype = shape, dtype
        self._release = event == "release"
        self._noise = Noise(noise, dtype.kind == "u")
        length = max(1, memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self._bands = cut_into_bands(device, shape, dtype, maps, length)
        alone = len(self._bands) == 1
        self._room = self._bands[0].frames.host if alone else np.empty((length, *shape), dtype)

    position = "travel"

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._room

    def _accept(
        self, frames: NDArray[Any], travel: ArrayLike | None, so_far: Sequence[float]
    ) -> NDArray[np.float64]:
        """Check frames before they are taken in: return their travel, if it can follow the travel so far."""
        check_frames(frames, self._dtype, self._shape)
        checked = check_travel(travel, len(frames), "travel", after=so_far[-1:], falls=self._release)
        self._noise.look(frames)
        return checked


def check_stack(frames: NDArray[Any]) -> tuple[int, int]:
    """Return rows and columns of a stack, or raise InputError if it is none."""
    if frames.ndim != 3 or len(frames) < 2 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) with at least 2 frames is needed")
    return frames.shape[1], frames.shape[2]


def find_onset(
    frames: NDArray[Any],
    travel: ArrayLike,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    threshold: float = 0.5,
    hold: int = 2,
    subframe: bool = True,
    noise: float | None = None,
    event: Event = "onset",
    device: str | Device | None = None,
) -> Onset:
    """Find the onset of the light state, or its end, in a stack that fits in memory.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts of a vertical press, or of a release.
    travel : array_like, (T,)
        Millimetres that the body has been lowered, one a frame: never decreasing in a press, never increasing
        in a release.
    dark, bright : array_like, scalar or (H, W), optional
        Counts without and with full light; by default the range of the frames' type.
    threshold : float
        Share of the way from dark to bright at which a pixel is light.
    hold : int
        Light frames in a row that make an onset, dark ones that make a release, so that a spike of noise
        makes none.
    subframe : bool
        Look inside the interval before the onset; False gives the paper's equation 4 to the letter.
    noise : float, optional
        Standard deviation of a sample in counts; by default told from the first two frames.
    event : {"onset", "release"}
        Whether to look for the light state's begin or its end.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Onset

    Raises
    ------
    mirrorskin.io.InputError
        Frames, travel, references or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.
    """
    search = OnsetSearch(
        check_stack(frames),
        frames.dtype,
        dark=dark,
        bright=bright,
        threshold=threshold,
        hold=hold,
        subframe=subframe,
        noise=noise,
        event=event,
        device=device,
        memory_limit=min(MEMORY_LIMIT, 2 * frames.nbytes),
    )
    search.push(frames, travel=travel)
    return search.result()


class OnsetSearch(Search):
    """Find the onset in frames that come block by block, however they are cut.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    dark, bright, threshold, hold, subframe, noise, event, device
        As for ``find_onset``.
    memory_limit : int
        Bytes of host memory for frames on the move; half of it is the room for one block.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        dark: ArrayLike | None = None,
        bright: ArrayLike | None = None,
        threshold: float = 0.5,
        hold: int = 2,
        subframe: bool = True,
        noise: float | None = None,
        event: Event = "onset",
        device: str | Device | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        if not 1 <= hold <= _INT_MAX:
            raise InputError(f"hold {hold}: a number of frames from 1 to {_INT_MAX} is needed")
        dtype, opened = np.dtype(dtype), open_device(device)
        fit(opened, _trial)
        super().__init__(shape, dtype, _maps(dtype, subframe), noise, event, opened, memory_limit)
        low, high = reference_maps(dark, bright, shape, dtype)
        self._subframe = subframe
        # The plateau that a run comes from: no reference tells how light a pixel was before its release.
        self._own_dark = self._release or dark is None
        self._macros: dict[str, str | int] = {
            "FRAME": C_TYPES[dtype.name],
            "BITS": 8 * dtype.itemsize,
            "HOLD": min(hold, _LONGEST),
            "SAMPLES": int(subframe),
            "RELEASE": int(self._release),
        }
        self._travel = _Travel(self.device)
        self._sure_at: float | None = None
        share = check_threshold(threshold) - _ROUNDING
        for band in self._bands:
            band.write("levels", high[band.rows] if high.ndim else high, plane=0)
            band.write("levels", low[band.rows] if low.ndim else low, plane=1)
            parts = float(np.float32(share)), share - float(np.float32(share))
            with band.resident():
                size = band.pixels, band.stride
                self._launch(band, "onset_levels", *size, *parts, "levels", "marks", "closed")
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far, and be ready for another press with the same references."""
        self._travel.clear()
        self._noise.reset()

    def push(self, frames: NDArray[Any], *, travel: ArrayLike | None, lent: bool = False) -> None:
        """Take in the next frames, (n, H, W), and the travel of each; see `Estimator`.

        Raises
        ------
        mirrorskin.io.InputError
            Travel is missing, or runs back.
        """
        first = self._travel.count
        self._travel.extend(self._accept(frames, travel, self._travel.latest))
        for band in self._bands:
            if self._subframe:
                self._prepare(band, frames[0] if first == 0 else None)
            self._scan(band, frames, first, lent)
        self._sure_at = self._noise.value

    def result(self) -> Onset:
        """Return the maps of the frames so far; more may follow."""
        noise = self._noise.value
        if noise is None or self._travel.count == 0:
            raise InputError(f"a press of {self._travel.count} frames has no onset: at least 2 are needed")
        maps = [self._answer(band, noise) for band in self._bands]
        height, sigma, status, frame = (join_rows(parts) for parts in zip(*maps, strict=True))
        return Onset(height, sigma, status, np.maximum(frame, DARK, out=frame), noise)

    def _prepare(self, band: Band, first: NDArray[Any] | None) -> None:
        """Tell a band what is known of the plateaus: the first frame, and the noise once it is known."""
        if first is not None and self._own_dark:
            plateau = complement(first) if self._release else first
            band.write("levels", plateau[band.rows], plane=1)
        noise = self._noise.value
        if noise is not None and noise != self._sure_at:
            with band.resident():
                self._launch(band, "onset_sure", band.stride, _SURELY * noise, "levels", "marks")

    def _scan(self, band: Band, frames: NDArray[Any], first: int, lent: bool) -> None:
        # One frame alone tells no noise, and needs none: it is taken for dark.
        look = self._look(self._noise.value or 0.0)
        arguments: list[str | float | Operand] = ["marks", "closed", "busy", "times"]
        if self._subframe:
            arguments = [*arguments, "levels", *self._travel.arguments, *look, "samples", "answers", "status"]
        with band.resident():
            for staged in band.stage(frames, lent):
                part = staged.count, band.pixels, band.stride, first + staged.frames.start
                known = staged.array, *part, *arguments
                self._launch(band, "onset_scan", *known, frames=staged.count, aligned=staged.aligned)

    def _answer(self, band: Band, noise: float) -> list[NDArray[Any]]:
        """Return height, sigma, status and frame of a band's rows as if no frame followed."""
        known = [band.stride, "times", *self._travel.arguments, "answers", "status"]
        if self._subframe:
            known = [self._travel.count, *known, "busy", "samples", "levels", *self._look(noise)]
        planes = ("answers", 0), ("answers", 1), ("status", 0), ("times", 0)
        with band.resident():
            self._launch(band, "onset_heights", *known, *([0] if self._subframe else []))
            for name in ("answers", "status", "times"):
                band.maps[name].download()
            maps = [band.plane(*plane).copy() for plane in planes]
            if self._subframe:  # what is not final is taken back
                self._launch(band, "onset_heights", *known, 1)
        return maps

    def _look(self, noise: float) -> tuple[float, float, float]:
        """Return the noise, and what a sample may differ from the dark and the light plateau it sits on."""
        light = _PLATEAU * np.sqrt(2) * noise  # from the plateau, which is a sample itself
        return noise, light if self._own_dark else _PLATEAU * noise, light

    def _launch(
        self,
        band: Band,
        name: str,
        *arguments: str | float | Operand,
        frames: int = 0,
        aligned: bool = True,
    ) -> None:
        """Run a kernel over a band, or over so many frames of it; its maps are told by their names."""
        values: list[Operand | np.generic] = []
        for argument in arguments:
            if isinstance(argument, str):
                values.append(band.maps[argument])
            elif isinstance(argument, Operand):
                values.append(argument)
            else:
                values.append(np.float32(argument) if isinstance(argument, float) else np.int32(argument))
        maps = sum(value.host.nbytes for value in values if isinstance(value, Operand))
        moved = frames * band.pixels * self._dtype.itemsize or maps
        kernel = self.device.kernel("onset", name, **self._macros, ALIGNED=int(aligned))
        shape = self.device.layout
        words = band.stride * self._dtype.itemsize // (4 * shape.lanes)
        kernel(-(-words // shape.words), *values, moved=moved)


class _Travel:
    """The travel of all frames so far, as the kernels look it up."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._table = device.array("travel", (3, 64), np.float32)
        self.clear()

    @property
    def arguments(self) -> tuple[Array, int]:
        """The planes of the table, and their length."""
        return self._table, self._table.host.shape[1]

    @property
    def latest(self) -> list[float]:
        """The travel of the last frame, if there is one."""
        return self._values[-1:]

    def clear(self) -> None:
        """Forget all frames."""
        self._values: list[float] = []

    @property
    def count(self) -> int:
        """Frames so far."""
        return len(self._values)

    def extend(self, travel: NDArray[np.float64]) -> None:
        """Add the next frames: their travel, the step to each, and the travel since the first frame."""
        old = len(self._values)
        steps = np.diff(travel, prepend=self._values[-1] if old else travel[0])
        count = old + len(travel)
        self._make_room(count)
        self._values.extend(travel.tolist())
        self._table.claim()
        self._table.host[:, old:count] = travel, steps, travel - self._values[0]
        self._table.upload()

    def _make_room(self, count: int) -> None:
        room = self._table.host.shape[1]
        if count <= room:
            return
        known = self._table
        known.claim()
        self._table = self._device.array("travel", (3, 2 * count), np.float32)
        self._table.host[:, :room] = known.host


def _trial(device: Device) -> Callable[[], None]:
    """Make a press ready that shows which shape a device likes: a front that passes all pixels."""
    count, shape = 32, (512, 1024)
    search = OnsetSearch(
        shape, np.uint8, noise=1.0, device=device, memory_limit=2 * count * shape[0] * shape[1]
    )
    front = np.linspace(1, count, shape[0])[:, np.newaxis]
    for number, frame in enumerate(search.room[:count]):
        frame[:] = np.where(front <= number, 200, 20)
    press, travel = search.room[:count], np.arange(count, dtype=np.float64)

    def run() -> None:
        search.reset()
        search.push(press, travel=travel)
        device.finish()

    return run


def _maps(dtype: np.dtype[Any], subframe: bool) -> dict[str, Planes]:
    kept = {"samples": Planes(4, dtype)} if subframe else {}
    return {
        "levels": Planes(2, np.float32),
        "marks": Planes(2, dtype),
        "closed": Planes(2, f"u{dtype.itemsize}"),
        "busy": Planes(1, np.uint8),
        "times": Planes(2, np.int32),
        "answers": Planes(2, np.float32),
        "status": Planes(1, np.uint8),
        **kept,
    }
