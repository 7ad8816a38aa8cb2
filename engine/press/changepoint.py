"""Height from a vertical press or release: the change-point of each pixel's brightness."""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import Noise, reference_pair
from mirrorskin.engine.operation import travel_function
from mirrorskin.engine.press.crossing import EVENT_MAPS, Event, PressOperation
from mirrorskin.engine.press.onset import Onset
from mirrorskin.engine.tiling import Band, Staged, cut_into_bands, for_each_band, join_rows, room_of
from mirrorskin.io import InputError, Result
from mirrorskin.io.positions import check_travel
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.changepoint import DECIDED, INVALID, REACH, SLOTS, UNIT
from mirrorskin.kernels.device import C_TYPES, Device, Kernel

_EVIDENCE = 12.0  # minimum logarithm of the likelihood ratio of a change
_RELEASED = np.array([0, 1, 3, 2], np.uint8)  # status of a release, from that of a press


class ChangePoint(PressOperation):
    """Height from a press or a release, by the most likely change of each pixel's brightness.

    With `dark` and `bright`, it is a CUSUM of each pixel's samples (Page, Biometrika 41, 1954, 100-115). If
    one of them is missing, both are estimated from each pixel's own samples before and after the change: the
    split of the samples that leaves the least squares. This takes two passes over the frames.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> frames = np.zeros((6, 1, 2), np.uint8)
    >>> frames[3:, 0, 0] = 200
    >>> engine.run(frames, engine.ChangePoint(), travel=0.1 * np.arange(6)).frame
    array([[ 3, -1]], dtype=int32)
    """

    takes_device_arrays = True

    threshold: float = Onset.threshold
    event: Event = Onset.event

    @property
    def passes(self) -> int:
        """Number of times that all frames are pushed: twice if a level is unknown."""
        return 2 if self.dark is None or self.bright is None else 1

    def check_options(self) -> None:
        """Raise InputError unless a change can be searched for with this threshold and hold."""
        if not 0 < self.threshold < 1:
            raise InputError(
                f"threshold {self.threshold}: a change-point needs a share between 0 and 1, such as 0.5"
            )
        if self.hold > REACH:
            raise InputError(f"hold {self.hold}: a change-point needs a number of frames from 1 to {REACH}")

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        self._release, self._twice = self.event == "release", self.passes == 2
        self._noise = Noise(self.noise, dtype.kind == "u")
        self._length = max(1, self.memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self._bands = cut_into_bands(self.devices, shape, dtype, self._planes(), self._length)
        # A release is a change from bright to dark: its first level is the bright one.
        self._level = 1 - self.threshold if self._release else self.threshold
        self._travel: list[float] = []
        self._start: ArrayLike = 0
        if not self._twice:
            references = reference_pair(self.dark, self.bright, shape, dtype)
            first, second = reversed(references) if self._release else references
            if not any(first.strides + second.strides):  # the same references at all pixels
                first, second = first[0, 0], second[0, 0]
            self._start = np.where(np.isnan(first), INVALID, 0)
            self._fill(dark=np.nan_to_num(first), gain=1 / np.where(np.isnan(first), 1, second - first))
        self.clear()

    @property
    def used_noise(self) -> float | None:
        """Standard deviation of a sample, counts."""
        return self._noise.value

    def use_noise(self, noise: float) -> None:
        """Replace the estimated noise before the first frame."""
        self._noise.reset(noise)

    @cached_property
    def room(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return room_of(self._bands, self._length)

    def _planes(self) -> dict[str, DTypeLike]:
        """Return the state of each pixel on the device; see ``changepoint.cl``."""
        integers = dict.fromkeys(("start", "excess", "below", "since"), np.int32)
        floats = dict.fromkeys(("dark", "gain", "height", "sigma"), np.float32)
        twice = dict.fromkeys(("mean", "mean_rest", "total", "total_rest", "score"), np.float32)
        ring = np.dtype((np.void, SLOTS * self.dtype.itemsize))  # the last samples
        return {
            "ring": ring, "status": np.uint8, **integers, **floats, **(twice if self._twice else {})
        }  # fmt: skip

    def clear(self) -> None:
        """Forget the frames so far."""
        self._travel.clear()
        self._noise.reset()
        self._weights: dict[Device, Array] = {}
        self._fill(start=self._start, excess=0, below=0, since=0)
        if self._twice:
            self._fill(total=0, total_rest=0)

    def start_second_pass(self) -> None:
        """Prepare for the same frames once more, to find each pixel's best split."""
        count = len(self._travel)
        self._travel.clear()
        split = np.arange(1.0, count)
        weight = np.pad(self._sign / np.sqrt(split * (count - split)), 1)
        self._weights = {device: device.from_host("weight", weight) for device in self.devices}

        def begin_split(band: Band) -> None:
            with band.resident():
                total, rest = (band.maps[name].read() for name in ("total", "total_rest"))
                mean = (total.astype(np.float64) + rest) / count
            band.write("mean", mean)
            band.write("mean_rest", mean - mean.astype(np.float32))
            band.write("start", np.where(np.isfinite(mean), 0, INVALID))
            for name in ("total", "total_rest", "score"):
                band.write(name, 0)

        for_each_band(self._bands, begin_split)

    def push(self, frames: NDArray[Any], *, travel: ArrayLike, lent: bool = False) -> None:
        """Process the next frames, (n, H, W), and the travel of each, (n,) mm."""
        first = len(self._travel)
        if any(first + len(frames) >= len(weight) for weight in self._weights.values()):
            raise InputError("the second pass has more frames than the first. Push the same frames twice")
        last = self._travel[-1:]
        self._travel.extend(check_travel(travel, len(frames), "travel", after=last, falls=self._release))
        self._noise.look(frames)

        def scan(band: Band) -> None:
            with band.resident():
                for staged in band.stage(frames, lent):
                    self._scan(band, staged, first + staged.frames.start)

        for_each_band(self._bands, scan)

    def _scan(self, band: Band, staged: Staged, first: int) -> None:
        """Run the kernel of this pass on frames of a band."""
        arguments: dict[str, Any] = {"first": first}
        if not self._twice:
            name, maps = "changepoint_scan", "dark gain start excess below ring"
            level = round(self._level * UNIT)
            arguments |= {"level": level, "least": self.hold * (UNIT - level), "quiet": self._quiet()}
        elif not self._weights:
            name, maps, arguments = "changepoint_sum", "total total_rest", {}
        else:
            name, maps = "changepoint_split", "mean mean_rest total total_rest start since score ring"
            arguments |= {"weight": self._weights[band.device]}
        arguments |= {plane: band.maps[plane] for plane in maps.split()}
        self._kernel(band, name)(
            _items(band),
            frames=staged.array,
            count=staged.count,
            pixels=band.pixels,
            **arguments,
            moved=staged.count * band.pixels * self.dtype.itemsize,
        )

    def result(self) -> Result:
        """Return height, status and frame of the frames so far."""
        noise = self._noise.value
        assert noise is not None  # there are two frames
        maps = for_each_band(self._bands, partial(self._finish, noise=noise))
        height, sigma, status, frame = (join_rows(parts) for parts in zip(*maps, strict=True))
        answered = (status == 1) | (status == 3)
        status = _RELEASED[status] if self._release else status
        frame = np.where(answered, frame, np.int32(-1))
        named: dict[str, Any] = dict(zip(EVENT_MAPS, (height, sigma, status, frame), strict=True))
        result = Result(named, process={"noise": noise}, declarations=self.declarations)
        return self.with_travel_errors(result)

    def _finish(self, band: Band, *, noise: float) -> list[Any]:
        """Return height, sigma, status and frame of a band's rows; the heights stay where the frames were."""
        if self._twice:
            self._estimate_levels(band, noise)
        names = ["start", "excess", "below", "since", "dark", "gain", "ring", "height", "sigma", "status"]
        maps: dict[str, Any] = {name: band.maps[name] for name in names}
        with band.resident():
            self._kernel(band, "changepoint_heights")(
                _items(band),
                pixels=band.pixels,
                count=len(self._travel),
                travel=self._travel_pairs(band.device),
                noise=noise,
                quiet=self._quiet(),
                level=self._level,
                own=self._twice,
                **maps,
                moved=sum(array.nbytes for array in maps.values()),
            )
            names = ["height", "sigma", "status", "start"]
            heights = names[:2] if self._on_device else []
            others = dict.fromkeys(names[len(heights) :], slice(None))
            return [*(band.cut(name) for name in heights), *band.fetch(others, keep=["start"])]

    def _travel_pairs(self, device: Device) -> Array:
        """Copy the travel to a device as (T, 2) floats, whose sums have the precision of float64."""
        travel = np.array(self._travel, np.float64)
        high = travel.astype(np.float32)
        return device.from_host("travel", np.stack([high, travel - high], axis=1))

    def _estimate_levels(self, band: Band, noise: float) -> None:
        """Compute the levels from the best splits, where they are significant."""
        count = len(self._travel)
        names = "score", "mean", "start"
        maps = band.fetch(dict.fromkeys(names, slice(None)), keep=names)
        score, mean, start = (values.astype(np.float64) for values in maps)
        changed = score**2 * count / 2 > (_EVIDENCE + np.log(count)) * noise**2
        split = np.where(changed, start, 1)
        rest = np.sqrt((count - split) / split)
        score *= self._sign
        dark = np.where(changed, mean - score * rest, 0)
        gain = 1 / np.where(changed, score * (rest + 1 / rest), 1)
        excess = np.where(changed, DECIDED, 0)
        for name, values in (("excess", excess), ("below", start), ("dark", dark), ("gain", gain)):
            band.write(name, values)

    def _fill(self, **maps: ArrayLike) -> None:
        for band in self._bands:
            for name, values in maps.items():
                band.write(name, np.broadcast_to(values, self.shape)[band.rows])

    @property
    def _sign(self) -> int:
        return -1 if self._release else 1

    def _quiet(self) -> float:
        """Return the sum of squared counts that noise alone may reach; 0 before the second frame."""
        return _EVIDENCE * (self._noise.value or 0.0) ** 2

    def _kernel(self, band: Band, name: str) -> Kernel:
        top = {} if self.dtype.kind == "f" else {"TOP": int(np.iinfo(self.dtype).max)}
        return band.device.kernel("changepoint", name, FRAME=C_TYPES[self.dtype.name], **top)


def _items(band: Band) -> int:
    """Return the work-items that process a band."""
    return int(-(-band.pixels // band.device.layout.tile))


find_change_point = travel_function(
    ChangePoint,
    "find_change_point",
    """Find the most likely change from dark to light, or back, in a stack that fits in memory.

    Returns
    -------
    Result
        As of `find_onset`; ``frame`` is the first frame after the most likely change.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, travel, references or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.zeros((6, 1, 2), np.uint8)
    >>> frames[3:, 0, 0] = 200
    >>> find_change_point(frames, 0.1 * np.arange(6), dark=0, bright=200).frame
    array([[ 3, -1]], dtype=int32)
    """,
    "Millimetres that the body has been lowered: never decreasing in a press, never increasing in a release.",
)
