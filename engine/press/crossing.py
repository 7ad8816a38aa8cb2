"""Search for a threshold crossing on a device, shared by the operations on a press (paper, section 3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import Noise, estimate_noise_of_all, reference_maps
from mirrorskin.engine.operation import Operation
from mirrorskin.engine.options import option
from mirrorskin.engine.tiling import Band, Planes, Staged, cut_into_bands, for_each_band, join_rows, room_of
from mirrorskin.io import Map, Result
from mirrorskin.io.maps import TABLE, PressStatus, ReleaseStatus, status_of
from mirrorskin.io.positions import check_travel
from mirrorskin.io.traces import FrameSamples
from mirrorskin.io.types import FRAME_DTYPES
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.onset import DARK, complement

if TYPE_CHECKING:
    from mirrorskin.io import Source

Event = Literal["onset", "release"]

STATUS: Mapping[str, Map] = {"onset": status_of(PressStatus), "release": status_of(ReleaseStatus)}
"""Declaration of the status map of each event."""

_PLATEAU = 3.0  # standard deviations: tolerance of a sample that belongs to a dark or light plateau
_CLEARLY_DARK = 6.0  # standard deviations below the threshold: a sample whose plateau is not near it
_ROUNDING = 1e-12  # tolerance of a threshold such as 0.55, which has no exact binary value
_TILE = 4096  # pixels of a work-item on a CPU; 0.8 times the run time of 1024 for long rows
_MISLED = 1.6  # ratio of two estimates of the noise that chance, or shot noise, hardly explains
_LONGEST = 2**30  # frames: limit of `hold`, so that sums of frame numbers do not overflow


class PressOperation(Operation):
    """Base of operations on a press: reference levels, noise, and the maps of an event."""

    motions = ("vertical",)
    dtypes = FRAME_DTYPES
    least_frames = 2
    on_device = long_blocks = True

    height = TABLE["height"]
    status = TABLE["status"]
    frame = TABLE["frame"]
    event: Event
    seen: FrameSamples | None = None
    """Samples of all frames, once they are pushed; None of frames that come while the body moves."""

    hold: int = option(
        default=2,
        unit="frames",
        within=(1, np.iinfo(np.int32).max),
        help="consecutive light frames that confirm an onset, or dark frames that confirm a release",
    )
    dark: ArrayLike | None = option(
        default=None,
        unit="counts",
        map=True,
        help="brightness without light, a number or a map (H, W)",
        shown_default="that of the recording or calibration; of arrays, the least value of their type",
    )
    bright: ArrayLike | None = option(
        default=None,
        unit="counts",
        map=True,
        help="brightness with full light, a number or a map (H, W)",
        shown_default="that of the recording or calibration; of arrays, the greatest value of their type",
    )
    noise: float | None = option(
        default=None,
        unit="counts",
        within=(0, None),
        help="standard deviation of a sample",
        shown_default="estimated from the frames",
    )

    travel_sigma: float | None = option(
        default=None,
        unit="mm",
        within=(0, None),
        help="standard deviation of the travel of each frame, independent from frame to frame, which is added"
        " to that of the heights",
        shown_default="that of the recording, or 0",
    )

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's levels and travel error, where none are given."""
        levels = {name: getattr(source.header, name) for name in ("dark", "bright", "travel_sigma")}
        return self.with_options(
            **{name: level for name, level in levels.items() if getattr(self, name) is None}
        )

    def with_travel_errors(self, result: Result) -> Result:
        """Return a result whose heights also have the errors of the travel."""
        return with_travel_error(result, self.travel_sigma) if self.travel_sigma else result

    def reconsider(self, samples: FrameSamples) -> bool:
        """Return whether the first two frames misled about the noise; all frames tell it then."""
        self.seen = samples
        used = self.used_noise
        if self.noise is not None or used is None or samples.count < 3:
            return False
        values = samples.values
        noise = estimate_noise_of_all(values.reshape(len(values), -1))
        if not noise or used / _MISLED <= noise <= used * _MISLED or math.isnan(noise):
            return False
        self.reset()
        self.use_noise(noise)
        return True

    @property
    def used_noise(self) -> float | None:
        """Standard deviation of a sample, counts, that was estimated from the first two frames, or given."""
        return None

    def use_noise(self, noise: float) -> None:
        """Replace the estimated noise before the first frame."""

    @property
    def declarations(self) -> Mapping[str, Map]:
        """Declarations of the maps; the legend of the status depends on the event."""
        return {**self.maps, "status": STATUS[self.event]}


def with_travel_error(result: Result, sigma: float) -> Result:
    """Return a result whose heights also have errors of the travel of each frame, mm.

    The variance of a height between two frames, at the share w, is (w^2 + (1 - w)^2) sigma^2: on average
    2/3 sigma^2.
    """
    error = np.float32(math.sqrt(2 / 3) * sigma)
    names = [name for name in ("height_sigma", "hysteresis_sigma") if name in result]
    more = {name: error * (math.sqrt(2) if name != "height_sigma" else 1) for name in names}
    return result.assign({name: np.hypot(result[name], np.float32(more[name])) for name in names})


class CrossingOperation(PressOperation):
    """Base of operations that search for threshold crossings."""

    subframe: bool = option(
        default=True,
        help="interpolate between the frames around the event; without it, the paper's equation 4 as printed",
    )


EVENT_MAPS = "height", "height_sigma", "status", "frame"
"""Names of `EventMaps` in a result."""


class EventMaps(NamedTuple):
    """The event at each pixel: height and its sigma, status, and number of the first frame after it.

    Heights, mm, are NaN unless the status is 1 (see `mirrorskin.io.maps.PressStatus` and ``ReleaseStatus``);
    frames are -1 without an event. They are NumPy arrays, or on the device; the frame is then a function that
    returns it.
    """

    height: Any
    sigma: Any
    status: Any
    frame: Any


class Crossing:
    """Search for the crossing of one threshold on a device, or on several.

    It uses the options of ``operation``, except for the threshold.
    """

    def __init__(
        self,
        operation: CrossingOperation,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        *,
        threshold: float,
        event: Event = "onset",
    ) -> None:
        dark, bright = operation.dark, operation.bright
        self._shape, self._dtype = shape, dtype
        self._release, self._subframe = event == "release", operation.subframe
        self._hold = min(operation.hold, _LONGEST)
        self._noise = Noise(operation.noise, dtype.kind == "u")
        self._length = max(1, operation.memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self._bands = cut_into_bands(operation.devices, shape, dtype, self._planes(), self._length)
        self._travel = _TravelTable(operation.devices)
        # Of a release, the dark plateau is unknown: no reference specifies it.
        self._dark_from_frames = self._release or dark is None
        self._macros: dict[str, str | int] = {"FRAME": C_TYPES[dtype.name], "BITS": 8 * dtype.itemsize}
        self._marked_noise: float | None = None
        self._threshold = 1 - threshold if self._release else threshold
        self._set_levels(*reference_maps(dark, bright, shape, dtype), threshold)
        self.reset()

    @cached_property
    def room(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return room_of(self._bands, self._length)

    def _planes(self) -> dict[str, Planes]:
        """Return the state of each pixel on the device; see ``onset.cl``."""
        return {
            "levels": Planes(2, np.float32),  # counts at the threshold, and of the dark plateau
            "marks": Planes(3, self._dtype),  # least sample that is light, not clearly dark, near
            "left": Planes(1, f"u{self._dtype.itemsize}"),  # frames until the pixel is finished
            "times": Planes(3, np.int32),  # start of the run; last frames that were clearly dark, not near
            "answers": Planes(2, np.float32),  # height and sigma
            "status": Planes(1, np.uint8),
            **({"samples": Planes(5, self._dtype)} if self._subframe else {}),  # those around an open run
        }

    def _set_levels(self, dark: NDArray[np.float32], bright: NDArray[np.float32], threshold: float) -> None:
        """Compute the smallest sample of each pixel that counts as light, in the type of the frames."""
        share = threshold - _ROUNDING
        coarse = float(np.float32(share))

        def set_levels(band: Band) -> None:
            references: dict[str, Any] = {}
            for name, values in (("bright", bright), ("dark", dark)):
                rows = values[band.rows] if values.ndim else values.reshape(1)
                references |= {f"{name}s": band.device.share(name, rows), f"{name}_step": values.ndim // 2}
            with band.resident():
                self._launch(
                    band, "onset_levels", "levels marks",
                    release=self._release, share=coarse, share_rest=share - coarse, **references,
                )  # fmt: skip

        for_each_band(self._bands, set_levels)

    def push(self, frames: NDArray[Any], travel: ArrayLike, lent: bool = False) -> None:
        """Process the next frames, (n, H, W), and the travel of each; InputError if it reverses."""
        first, last = self._travel.count, self._travel.values[-1:]
        self._travel.extend(check_travel(travel, len(frames), "travel", after=last, falls=self._release))
        self._noise.look(frames)

        def scan(band: Band) -> None:
            if self._subframe:
                self._set_plateaus(band, frames[0] if first == 0 else None)
            with band.resident():
                for staged in band.stage(frames, lent):
                    self._scan(band, staged, first + staged.frames.start)

        for_each_band(self._bands, scan)
        self._marked_noise = self._noise.value

    def _set_plateaus(self, band: Band, first: NDArray[Any] | None) -> None:
        """Set the dark plateau from the first frame, and clearly dark samples once the noise is estimated."""
        if first is not None and self._dark_from_frames:
            plateau = complement(first) if self._release else first
            band.write("levels", plateau[band.rows], plane=1)
        noise = self._noise.value
        if noise is not None and noise != self._marked_noise:
            with band.resident():
                self._launch(band, "onset_sure", "levels marks", tolerance=_CLEARLY_DARK * noise)

    def _scan(self, band: Band, staged: Staged, first: int) -> None:
        noise = self._noise.value or 0.0  # not needed for a single frame, which is assumed to be dark
        light = _PLATEAU * np.sqrt(2) * noise  # the plateau is a sample itself
        dark = light if self._dark_from_frames else _PLATEAU * noise
        arguments: dict[str, Any] = {"noise": noise, "dark_tolerance": dark, "light_tolerance": light}
        arguments |= {"hold": self._hold, "release": self._release, "subframe": self._subframe}
        arguments["threshold"] = self._threshold  # as a share of the way from the plateau before the event
        arguments |= {"frames": staged.array, "count": staged.count, "samples": band.maps.get("samples")}
        moved = staged.count * band.pixels * self._dtype.itemsize
        maps = "marks left times levels answers status"
        self._launch(
            band, "onset_scan", maps, moved, first=first, **arguments, **self._travel.on(band.device)
        )

    def event_maps(self, last: bool = False, on_device: bool = False) -> EventMaps:
        """Return the maps of the frames so far; without a copy if they are the ``last`` before a `reset`.

        ``on_device``: height, sigma and status are arrays on the device, for frames that were.
        """
        if on_device:
            (band,) = self._bands
            later = partial(_first_light, band.cut("times"))
            return EventMaps(band.cut("answers", 0), band.cut("answers", 1), band.cut("status"), later)
        maps = for_each_band(self._bands, partial(self._band_maps, last=last))
        height, sigma, status, frame = (join_rows(parts) for parts in zip(*maps, strict=True))
        return EventMaps(height, sigma, status, _first_light(frame))

    def _band_maps(self, band: Band, *, last: bool) -> list[NDArray[Any]]:
        """Return height, sigma, status and frame of a band's rows."""
        parts: dict[str, int | slice] = {"answers": slice(None), "status": 0, "times": 0}
        answers, status, frame = band.fetch(parts, keep=() if last else parts)
        return [band.picture(plane) for plane in (*answers, status, frame)]

    def reset(self, noise: float | None = None) -> None:
        """Prepare for another press with the same references and, if given, the same noise, counts."""
        self._travel.clear()
        self._noise.reset(noise)
        if self._dark_from_frames:  # the marks depend on the first frame
            self._marked_noise = None

    @property
    def travel(self) -> NDArray[np.float64]:
        """The travel of the frames so far, (T,), mm."""
        return np.array(self._travel.values, np.float64)

    @property
    def noise(self) -> float:
        """Standard deviation of a sample, given or estimated, counts; 0 before the second frame."""
        return self._noise.value or 0.0

    def _launch(self, band: Band, name: str, maps: str, moved: int = 0, **arguments: Any) -> None:
        """Run a kernel over a band; ``maps`` are names of its maps, ``moved`` the bytes of frames."""
        tile = _TILE if band.device.layout.tile > 1 else 1
        arguments |= {
            "pixels": band.pixels,
            "stride": band.stride,
            **{plane: band.maps[plane] for plane in maps.split()},
        }
        kernel = band.device.kernel("onset", name, **self._macros, TILE=tile)
        kernel(-(-band.pixels // tile), **arguments, moved=moved)


def _first_light(times: Any) -> NDArray[np.int32]:
    """Return the first frame after the event, -1 without one, from the state of the search."""
    frame: NDArray[np.int32] = np.asarray(times)
    return np.maximum(frame, DARK, out=frame)


class _TravelTable:
    """The travel of all frames so far in planes: travel, its steps, and the distance from the first frame."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = devices
        self._rows = np.zeros((3, 64), np.float32)
        self._allocate()
        self.clear()

    def on(self, device: Device) -> dict[str, Any]:
        """Return the table on a device and its length, as kernel arguments."""
        table = self._tables[device]
        return {"travel": table, "room": table.shape[1]}

    def clear(self) -> None:
        self.values: list[float] = []

    @property
    def count(self) -> int:
        return len(self.values)

    def extend(self, travel: NDArray[np.float64]) -> None:
        """Add the next frames."""
        old = len(self.values)
        steps = np.diff(travel, prepend=self.values[-1] if old else travel[0])
        count = old + len(travel)
        if count > self._rows.shape[1]:
            self._rows = np.pad(self._rows, ((0, 0), (0, 2 * count - self._rows.shape[1])))
            self._allocate()
        self.values.extend(travel.tolist())
        self._rows[:, old:count] = travel, steps, travel - self.values[0]
        for table in self._tables.values():
            table.write(self._rows)

    def _allocate(self) -> None:
        self._tables = {
            device: device.array("travel", self._rows.shape, np.float32, zeroed=False)
            for device in self._devices
        }
