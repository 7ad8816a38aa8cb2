"""Height from a vertical press: the travel at which each pixel turns light (paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.bands import Band, cut_into_bands
from mirrorskin.engine.noise import estimate_noise, thin_out
from mirrorskin.engine.references import check_threshold, light_levels, reference_pair
from mirrorskin.io import FRAME_DTYPES, Block, InputError, check_travel
from mirrorskin.kernels.device import Device, Kernel, open_device
from mirrorskin.kernels.onset import DARK, INVALID

MEMORY_LIMIT = 256_000_000

_PLATEAU = 3.0  # sigmas by which a sample may differ from the plateau that it sits on
_SURELY = 6.0  # sigmas by which a sample must miss the level so that its plateau is not near it
_C_TYPES = {"u1": "uchar", "u2": "ushort", "u4": "uint", "f4": "float"}
_INT_MAX = np.iinfo(np.int32).max


@dataclass(frozen=True, slots=True)
class Onset:
    """Where and when a press turned the pixels light.

    Attributes
    ----------
    height, sigma : ndarray, (H, W), float32
        Millimetres, and the standard deviation of the height; NaN unless status is 1.
    status : ndarray, (H, W), uint8
        0 invalid input, 1 onset, 2 never light, 3 light at start.
    frame : ndarray, (H, W), int32
        Number of the first light frame; -1 unless status is 1 or 3.
    noise : float
        Standard deviation of a sample that was reckoned with, counts.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    status: NDArray[np.uint8]
    frame: NDArray[np.int32]
    noise: float


def find_onset(
    frames: NDArray[Any],
    travel: ArrayLike,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    threshold: float = 0.5,
    hold: int = 2,
    subframe: bool = True,
    noise: float | None = None,
    device: str | Device | None = None,
) -> Onset:
    """Find the onset of the light state in a stack that fits in memory.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts of a vertical press.
    travel : array_like, (T,)
        Millimetres that the body has been lowered, one a frame, never decreasing.
    dark, bright : array_like, scalar or (H, W), optional
        Counts without and with full light; by default the range of the frames' type.
    threshold : float
        Share of the way from dark to bright at which a pixel is light.
    hold : int
        Light frames in a row that make an onset, so that a spike of noise makes none.
    subframe : bool
        Look inside the interval before the onset; False gives the paper's equation 4 to the letter.
    noise : float, optional
        Standard deviation of a sample in counts; by default told from the first two frames.
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
    if frames.ndim != 3 or len(frames) < 2 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) with at least 2 frames is needed")
    positions = check_travel(np.asarray(travel), len(frames), "travel")
    search = OnsetSearch(
        (frames.shape[1], frames.shape[2]),
        frames.dtype,
        dark=dark,
        bright=bright,
        threshold=threshold,
        hold=hold,
        subframe=subframe,
        noise=noise,
        device=device,
        memory_limit=min(MEMORY_LIMIT, 2 * frames.nbytes),
    )
    search.push(Block(frames, index=0, travel=positions))
    return search.result()


class OnsetSearch:
    """Find the onset in frames that come block by block, however they are cut.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    dark, bright, threshold, hold, subframe, noise, device
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
        device: str | Device | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        dtype = np.dtype(dtype)
        _check(dtype, hold, noise)
        low, high = reference_pair(dark, bright, shape, dtype)
        level, light = light_levels(low, high, check_threshold(threshold), dtype)
        self.device = open_device(device)
        self._shape = shape
        self._dtype = dtype
        self._hold = hold
        self._subframe = subframe
        self._given_noise = self._noise = noise
        self._own_dark = dark is None
        self._travel: list[float] = []
        self._samples: list[NDArray[np.float64]] = []
        length = max(1, memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self._bands = cut_into_bands(self.device, shape, dtype, _maps(dtype), length)
        alone = len(self._bands) == 1
        self._room = self._bands[0].frames.host if alone else np.empty((length, *shape), dtype)
        self._start = np.where(np.isnan(level), INVALID, DARK)
        self._fill(level=level, light=light, dark=low)
        self.reset()

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._room

    def reset(self) -> None:
        """Forget the frames so far, and be ready for another press with the same references."""
        self._travel.clear()
        self._samples.clear()
        self._noise = self._given_noise
        self._fill(onset=self._start, below=np.zeros_like(self._start))

    def push(self, block: Block) -> None:
        """Take in the next frames.

        Raises
        ------
        mirrorskin.io.InputError
            Travel is missing, or runs back.
        """
        frames, first = block.frames, len(self._travel)
        if frames.dtype != self._dtype or frames.shape[1:] != self._shape or len(frames) == 0:
            raise InputError(
                f"frames of {frames.dtype} {frames.shape}: expected {self._dtype} (n, *{self._shape})"
            )
        travel = check_travel(block.travel, len(frames), "travel", after=self._travel[-1:])
        if first == 0 and self._own_dark:
            self._fill(dark=frames[0])
        self._look_at_noise(frames)
        self._travel.extend(travel)
        for band in self._bands:
            self._scan(band, frames, first)

    def result(self) -> Onset:
        """Return the maps of the frames so far; more may follow."""
        noise = self._noise
        if not self._travel or noise is None:
            raise InputError(f"a press of {len(self._travel)} frames has no onset: at least 2 are needed")
        maps = [self._heights(band, noise) for band in self._bands]
        height, sigma, status, frame = (np.concatenate(parts) for parts in zip(*maps, strict=True))
        return Onset(height, sigma, status, np.maximum(frame, DARK), noise)

    def _fill(self, **maps: NDArray[Any]) -> None:
        for band in self._bands:
            for name, values in maps.items():
                band.write(name, values[band.rows])

    def _scan(self, band: Band, frames: NDArray[Any], first: int) -> None:
        width = max(self._dtype.itemsize, np.min_scalar_type(self._hold).itemsize)
        scan = self._kernel("onset_scan", COUNT=_C_TYPES[f"u{width}"], SPAN=min(256**width - 1, _INT_MAX))
        state = [
            band.maps[name] for name in ("level", "light", "onset", "below", "last", "before", "at", "after")
        ]
        # One frame alone tells no noise, and needs none: the first is taken for dark.
        tolerance = _SURELY * (self._noise or 0.0)
        with band.resident():
            for start, count in band.stage(frames):
                scan(
                    -(-band.pixels // self.device.tile),
                    band.frames,
                    *map(np.int32, (count, band.pixels, first + start, self._hold)),
                    np.float32(tolerance),
                    *state,
                    moved=count * band.pixels * self._dtype.itemsize,
                )

    def _heights(self, band: Band, noise: float) -> list[NDArray[Any]]:
        travel = self.device.array("travel", (len(self._travel), 2), np.float32)
        travel.host[:, 0] = self._travel
        travel.host[:, 1] = np.array(self._travel) - travel.host[:, 0]
        travel.upload()
        dark_tolerance = _PLATEAU * noise * (np.sqrt(2) if self._own_dark else 1)
        light_tolerance = _PLATEAU * noise * np.sqrt(2)
        known = [band.maps[name] for name in ("onset", "below", "before", "at", "after", "level", "dark")]
        wanted = [band.maps[name] for name in ("height", "sigma", "status")]
        with band.resident():
            self._kernel("onset_heights", COUNT="uint", SPAN=1)(
                -(-band.pixels // self.device.tile),
                *map(np.int32, (band.pixels, len(self._travel))),
                *(*known, travel),
                *map(np.float32, (dark_tolerance, light_tolerance, noise)),
                np.int32(self._subframe),
                *wanted,
                moved=sum(array.host.nbytes for array in (*known, *wanted)),
            )
            return [array.download().copy() for array in (*wanted, band.maps["onset"])]

    def _kernel(self, name: str, **defines: str | int) -> Kernel:
        kind = self._dtype.kind
        sample = _C_TYPES[f"{kind}{self._dtype.itemsize}"]
        return self.device.kernel("onset", name, FRAME=sample, FLOATS=int(kind == "f"), **defines)

    def _look_at_noise(self, frames: NDArray[Any]) -> None:
        self._samples += [thin_out(frame) for frame in frames[: 2 - len(self._samples)]]
        if self._noise is None and len(self._samples) == 2:
            self._noise = estimate_noise(self._samples[0], self._samples[1], self._dtype.kind == "u")


def _maps(dtype: np.dtype[Any]) -> dict[str, DTypeLike]:
    samples = dict.fromkeys(("light", "last", "before", "at", "after"), dtype)
    floats = dict.fromkeys(("level", "dark", "height", "sigma"), np.float32)
    return {"onset": np.int32, "below": np.int32, "status": np.uint8, **samples, **floats}


def _check(dtype: np.dtype[Any], hold: int, noise: float | None) -> None:
    if dtype not in FRAME_DTYPES:
        raise InputError(f"frames of type {dtype}: uint8, uint16 or float32 are needed")
    if not 1 <= hold <= _INT_MAX:
        raise InputError(f"hold {hold}: a number of frames from 1 to {_INT_MAX} is needed")
    if noise is not None and not 0 <= noise < np.inf:
        raise InputError(f"noise {noise}: a standard deviation in counts is needed, such as 1.5")
