"""Height from a vertical press or release: the change-point of each pixel's brightness."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import Noise, check_dtype, check_frames, reference_pair
from mirrorskin.engine.press.onset import Event, Onset, check_event, check_stack
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.engine.tiling import MEMORY_LIMIT, Band, Staged, cut_into_bands, join_rows, room_of
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.io.maps import PressStatus, ReleaseStatus, status_of
from mirrorskin.io.positions import check_travel
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.changepoint import DECIDED, INVALID, REACH, SLOTS, UNIT
from mirrorskin.kernels.device import C_TYPES, Device, Kernel, open_device

_EVIDENCE = 12.0  # log of how much likelier the samples must be with a change than without
_RELEASED = np.array([0, 1, 3, 2], np.uint8)  # what never turns dark is light to the end, and so on


@checked
def find_change_point(
    frames: NDArray[Any],
    travel: ArrayLike,
    *,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
    threshold: float = 0.5,
    hold: int = 2,
    noise: float | None = None,
    event: Event = "onset",
    device: str | Device | None = None,
) -> Onset:
    """Find the change from dark to light, or back, in a stack that fits in memory.

    With known levels it is a CUSUM of each pixel's samples (Page, Biometrika 41, 1954, 100-115); with unknown
    ones the split of its samples that leaves the least squares.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts of a vertical press, or of a release.
    travel : array_like, (T,)
        Millimetres that the body has been lowered, one a frame: never decreasing in a press, never increasing
        in a release.
    dark, bright : array_like, scalar or (H, W), optional
        Counts without and with full light. With one of them missing, both are estimated from each pixel's own
        samples before and after the change.
    threshold : float
        Share of the way from dark to bright whose crossing is looked for.
    hold : int
        Fully light frames, or dark ones of a release, that it takes to make sure of a change, 1 to 12.
    noise : float, optional
        Standard deviation of a sample in counts; by default estimated from the first two frames.
    event : {"onset", "release"}
        Whether to look for the light state's begin or its end.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Onset
        Its ``frame`` is the first frame after the most likely change.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, travel, references or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    >>> frames = np.zeros((6, 1, 2), np.uint8)
    >>> frames[3:, 0, 0] = 200
    >>> find_change_point(frames, 0.1 * np.arange(6), dark=0, bright=200).frame
    array([[ 3, -1]], dtype=int32)
    """
    search = ChangePointSearch(
        check_stack(frames),
        frames.dtype,
        dark=dark,
        bright=bright,
        threshold=threshold,
        hold=hold,
        noise=noise,
        event=event,
        device=device,
        memory_limit=min(MEMORY_LIMIT, 2 * frames.nbytes),
    )
    search.push(frames, travel=travel)
    if search.passes == 2:
        search.start_second_pass()
        search.push(frames, travel=travel)
    return search.result()


class ChangePointSearch(ThreadSafe):
    """Find the change in frames that come block by block; see `mirrorskin.engine.streaming.Estimator`.

    With known levels one pass is enough, and ``result`` may be called at any time. With unknown ones all
    frames are pushed twice, with ``start_second_pass`` in between.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    dark, bright, threshold, hold, noise, event, device
        As for `find_change_point`.
    memory_limit : int
        Bytes of host memory for frames on the move; half of it is the room for one block.

    Attributes
    ----------
    passes : int
        How often the frames are needed: 1, or 2 where a level is unknown.
    """

    position = "travel"

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        dark: ArrayLike | None = None,
        bright: ArrayLike | None = None,
        threshold: float = 0.5,
        hold: int = 2,
        noise: float | None = None,
        event: Event = "onset",
        device: str | Device | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        if not 0 < threshold < 1:
            raise InputError(
                f"threshold {threshold}: a change-point needs a share between 0 and 1, such as 0.5"
            )
        if not 1 <= hold <= REACH:
            raise InputError(f"hold {hold}: a change-point needs a number of frames from 1 to {REACH}")
        self._shape, self._dtype = shape, check_dtype(dtype)
        self._release, self._hold = check_event(event) == "release", hold
        self.maps = {"status": status_of(ReleaseStatus if self._release else PressStatus)}
        self._noise = Noise(noise, self._dtype.kind == "u")
        self.passes = 2 if dark is None or bright is None else 1
        self.device: Device = open_device(device)
        self._length = max(1, memory_limit // (2 * shape[0] * shape[1] * self._dtype.itemsize))
        self._bands = cut_into_bands(self.device, shape, self._dtype, self._maps(), self._length)
        # A release is a change as well, from bright to dark: its first level is the bright one.
        self._level = 1 - threshold if self._release else threshold
        self._travel: list[float] = []
        self._start = np.zeros(shape, np.int32)
        if self.passes == 1:
            references = reference_pair(dark, bright, shape, self._dtype)
            first, second = reversed(references) if self._release else references
            self._start = np.where(np.isnan(first), INVALID, 0).astype(np.int32)
            self._fill(dark=np.nan_to_num(first), gain=1 / np.where(np.isnan(first), 1, second - first))
        self.reset()

    @cached_property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied."""
        return room_of(self._bands, self._length)

    def _maps(self) -> dict[str, DTypeLike]:
        """Return what is kept of each pixel."""
        integers = dict.fromkeys(("start", "excess", "below", "since"), np.int32)
        floats = dict.fromkeys(("dark", "gain", "height", "sigma"), np.float32)
        twice = dict.fromkeys(("mean", "mean_rest", "total", "total_rest", "score"), np.float32)
        ring = np.dtype((np.void, SLOTS * self._dtype.itemsize))  # the last samples
        return {
            "ring": ring, "status": np.uint8, **integers, **floats, **(twice if self.passes == 2 else {})
        }  # fmt: skip

    def reset(self) -> None:
        """Forget the frames so far, and be ready for another press with the same references."""
        self._travel.clear()
        self._noise.reset()
        self._weight: Array | None = None
        zeros = np.zeros(self._shape, np.int32)
        self._fill(start=self._start, excess=zeros, below=zeros, since=zeros)
        if self.passes == 2:
            self._fill(total=zeros, total_rest=zeros)

    def start_second_pass(self) -> None:
        """Be ready for the same frames once more, when unknown levels need a second pass.

        Raises
        ------
        mirrorskin.io.InputError
            Fewer than two frames came in the first pass.
        """
        count = len(self._travel)
        self._known_noise()
        self._travel.clear()
        split = np.arange(1.0, count)
        self._weight = self.device.array("weight", (count + 1,), np.float32)
        self._weight.host[1:-1] = self._sign / np.sqrt(split * (count - split))
        self._weight.upload()
        for band in self._bands:
            with band.resident():
                total, rest = (band.maps[name].download() for name in ("total", "total_rest"))
                mean = (total.astype(np.float64) + rest) / count
            band.write("mean", mean)
            band.write("mean_rest", mean - mean.astype(np.float32))
            band.write("start", np.where(np.isfinite(mean), 0, INVALID))
            for name in ("total", "total_rest", "score"):
                band.write(name, np.zeros_like(mean))

    def push(self, frames: NDArray[Any], *, travel: ArrayLike | None, lent: bool = False) -> None:
        """Take in the next frames, (n, H, W), and the travel of each.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another shape or type; travel is missing, or runs back; or there are more frames in the
            second pass than in the first.
        """
        first = len(self._travel)
        if self._weight is not None and first + len(frames) >= len(self._weight.host):
            raise InputError("there are more frames in the second pass than in the first: give the same ones")
        check_frames(frames, self._dtype, self._shape)
        last = self._travel[-1:]
        self._travel.extend(check_travel(travel, len(frames), "travel", after=last, falls=self._release))
        self._noise.look(frames)
        for band in self._bands:
            with band.resident():
                for staged in band.stage(frames, lent):
                    self._scan(band, staged, first + staged.frames.start)

    def _scan(self, band: Band, staged: Staged, first: int) -> None:
        """Let the kernel of this pass go through frames of a band."""
        known: dict[str, Any] = {"first": first}
        if self.passes == 1:
            name, maps = "changepoint_scan", "dark gain start excess below ring"
            level = round(self._level * UNIT)
            known |= {"level": level, "least": self._hold * (UNIT - level), "quiet": self._quiet()}
        elif self._weight is None:
            name, maps, known = "changepoint_sum", "total total_rest", {}
        else:
            name, maps = "changepoint_split", "mean mean_rest total total_rest start since score ring"
            known |= {"weight": self._weight}
        known |= {one: band.maps[one] for one in maps.split()}
        self._kernel(name)(
            self._items(band),
            frames=staged.array,
            count=staged.count,
            pixels=band.pixels,
            **known,
            moved=staged.count * band.pixels * self._dtype.itemsize,
        )

    def result(self) -> Onset:
        """Return the maps of the frames so far.

        Raises
        ------
        mirrorskin.io.InputError
            There are fewer than two frames, or the second pass over them is missing.
        """
        count, noise = len(self._travel), self._known_noise()
        if self.passes == 2 and (self._weight is None or count + 1 != len(self._weight.host)):
            raise InputError("a change between unknown levels needs all frames twice: give dark and bright")
        maps = [self._finish(band, noise) for band in self._bands]
        height, sigma, status, frame = (join_rows(parts) for parts in zip(*maps, strict=True))
        answered = (status == 1) | (status == 3)
        status = _RELEASED[status] if self._release else status
        return Onset(height, sigma, status, np.where(answered, frame, np.int32(-1)), noise)

    def _finish(self, band: Band, noise: float) -> list[NDArray[Any]]:
        """Return height, sigma, status and frame of a band's rows."""
        if self.passes == 2:
            self._take_levels(band, noise)
        names = ["start", "excess", "below", "since", "dark", "gain", "ring", "height", "sigma", "status"]
        maps: dict[str, Any] = {name: band.maps[name] for name in names}
        with band.resident():
            self._kernel("changepoint_heights")(
                self._items(band),
                pixels=band.pixels,
                count=len(self._travel),
                travel=self._travel_pairs(),
                noise=noise,
                quiet=self._quiet(),
                level=self._level,
                own=self.passes == 2,
                **maps,
                moved=sum(array.host.nbytes for array in maps.values()),
            )
            answers = [band.detach(name) for name in ("height", "sigma", "status")]
            return [*answers, maps["start"].download().copy()]

    def _travel_pairs(self) -> Array:
        """Hand the travel to the device as (T, 2) floats, whose sums are as good as float64."""
        pairs = self.device.array("travel", (len(self._travel), 2), np.float32)
        pairs.host[:, 0] = self._travel
        pairs.host[:, 1] = self.travel - pairs.host[:, 0]
        pairs.upload()
        return pairs

    def _take_levels(self, band: Band, noise: float) -> None:
        """Turn the best splits into levels, where noise alone would not make such a split."""
        count = len(self._travel)
        with band.resident():
            score, mean, start = (
                band.maps[name].download().astype(np.float64) for name in ("score", "mean", "start")
            )
        changed = score**2 * count / 2 > (_EVIDENCE + np.log(count)) * noise**2
        split = np.where(changed, start, 1)
        rest = np.sqrt((count - split) / split)
        score *= self._sign
        dark = np.where(changed, mean - score * rest, 0)
        gain = 1 / np.where(changed, score * (rest + 1 / rest), 1)
        excess = np.where(changed, DECIDED, 0)
        for name, values in (("excess", excess), ("below", start), ("dark", dark), ("gain", gain)):
            band.write(name, values)

    @property
    def travel(self) -> NDArray[np.float64]:
        """The travel of the frames so far, (T,), mm."""
        return np.array(self._travel, np.float64)

    def _known_noise(self) -> float:
        """Return the noise, or raise InputError where there are fewer than two frames."""
        if len(self._travel) < 2 or self._noise.value is None:
            raise InputError(
                f"a press of {len(self._travel)} frames has no change-point: at least 2 are needed"
            )
        return self._noise.value

    def _fill(self, **maps: NDArray[Any]) -> None:
        for band in self._bands:
            for name, values in maps.items():
                band.write(name, values[band.rows])

    @property
    def _sign(self) -> int:
        return -1 if self._release else 1

    def _quiet(self) -> float:
        """Square counts of excess that noise alone would make; a first frame alone decides nothing."""
        return _EVIDENCE * (self._noise.value or 0.0) ** 2

    def _items(self, band: Band) -> int:
        return int(-(-band.pixels // self.device.layout.tile))

    def _kernel(self, name: str) -> Kernel:
        top = {} if self._dtype.kind == "f" else {"TOP": int(np.iinfo(self._dtype).max)}
        return self.device.kernel("changepoint", name, FRAME=C_TYPES[self._dtype.name], **top)
