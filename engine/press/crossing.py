"""Search for a threshold crossing on a device, shared by the operations on a press (paper, section 3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray
from mirrorskin.engine.base.frames import Noise, estimate_noise_of_all, reference_maps
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.picture import Appended, PerPixel, Picture
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.diagnosis.position_uncertainty import with_travel_error
from mirrorskin.io import Fitted, Map, Result
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.model.maps import TABLE, PressStatus, ReleaseStatus, status_of
from mirrorskin.io.model.positions import check_travel
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.press.onset import complement, onset_levels, onset_near, onset_sure

if TYPE_CHECKING:
    from mirrorskin.engine.press.onset import ThresholdOperation
    from mirrorskin.engine.press.strokes import Strokes
    from mirrorskin.io import Source

Event = Literal["onset", "release"]

STATUS: Mapping[str, Map] = {"onset": status_of(PressStatus), "release": status_of(ReleaseStatus)}
"""Declaration of the status map of each event."""

_PLATEAU_Z_SCORE = 3.0  # standard deviations: tolerance of a sample that belongs to a dark or light plateau
_DARK_Z_SCORE = 6.0  # standard deviations below the threshold: a sample whose plateau is not near it
_ROUNDING = 1e-12  # tolerance of a threshold such as 0.55, which has no exact binary value
_TILE = 4096  # pixels of a work-item on a CPU; 0.8 times the run time of 1024 for long rows
_MAX_NOISE_RATIO = 1.6  # ratio of two estimates of the noise that chance, or shot noise, hardly explains
_MAX_HOLD = 2**30  # frames: limit of `hold`, so that sums of frame numbers do not overflow


class PressOperation(Operation):
    """Base of operations on a press: reference levels, noise, and the maps of an event."""

    motions = ("vertical",)
    dtypes = FRAME_DTYPES
    least_frames = 2
    for_device = True

    height = TABLE["height"]
    status = TABLE["status"]
    frame = TABLE["frame"]
    event: Event

    hold: int = option(
        default=2,
        unit="frames",
        within=(1, np.iinfo(np.int32).max),
        help="consecutive light frames that confirm an onset, or dark frames that confirm a release",
    )
    dark: ArrayLike | None = option(
        default=None,
        unit="counts",
        help="brightness without light, a number or a map (H, W)",
        shown_default="that of the recording or calibration, otherwise estimated from the frames, or the"
        " least of their type",
    )
    bright: ArrayLike | None = option(
        default=None,
        unit="counts",
        help="brightness with full light, a number or a map (H, W)",
        shown_default="that of the recording or calibration, otherwise estimated from the frames, or the"
        " greatest of their type",
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

    estimated_levels: Sequence[str] = option(
        default=(), help="names of the levels that were estimated from the frames", python_only=True
    )

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's levels and travel error, where none are given."""
        levels = {name: getattr(source.header, name) for name in ("dark", "bright", "travel_sigma")}
        return self.with_options(
            **{name: level for name, level in levels.items() if getattr(self, name) is None}
        )

    @property
    def lowest_threshold(self) -> float:
        """Share of the range from dark to bright at which heights are computed."""
        return float(self.option_values()["threshold"])

    def with_event(self, result: Result) -> Result:
        """Return a result with its event and levels, whose heights also have the errors of the travel."""
        dark, bright = (
            float(np.asarray(level)) if level is not None and np.ndim(level) == 0 else None
            for level in (self.dark, self.bright)
        )
        travel = tuple(self.positions_so_far("travel").tolist())
        fitted = Fitted(event=self.event, dark_level=dark, bright_level=bright, frame_travel=travel)
        result = result.assign(fitted=fitted)
        return with_travel_error(result, self.travel_sigma) if self.travel_sigma else result

    def after_last_frame(self, samples: FrameSamples) -> Self | None:
        """Return the operation with the noise of all frames, if the first two misled about it."""
        used = self.used_noise
        if self.noise is not None or used is None or samples.count < 3:
            return None
        values = samples.values
        noise = estimate_noise_of_all(values.reshape(len(values), -1))
        if not noise or used / _MAX_NOISE_RATIO <= noise <= used * _MAX_NOISE_RATIO or math.isnan(noise):
            return None
        return self.with_options(noise=noise)

    @property
    def used_noise(self) -> float | None:
        """Standard deviation of a sample, counts, that was estimated from the first two frames, or given."""
        return None

    @property
    def declarations(self) -> Mapping[str, Map]:
        """Declarations of the maps; the legend of the status depends on the event."""
        return {**self.maps, "status": STATUS[self.event]}


EVENT_MAPS = "height", "height_sigma", "status", "frame"
"""Names of `EventMaps` in a result."""


class EventMaps(NamedTuple):
    """The event at each pixel: height and its sigma, status, and number of the first frame after it.

    Heights, mm, are NaN unless the status is 1 (see `mirrorskin.io.model.maps.PressStatus` and
    ``ReleaseStatus``); frames are -1 without an event. They are NumPy arrays, or on the device.
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
        operation: ThresholdOperation | Strokes,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        *,
        threshold: float,
        event: Event = "onset",
    ) -> None:
        self._release, self._subframe = event == "release", operation.subframe
        self._hold = min(operation.hold, _MAX_HOLD)
        self._noise = Noise(operation.noise, dtype.kind == "u")
        self._travels = Appended(1, np.float64)
        self.travel: NDArray[np.float64] = np.empty(0)  # of the frames so far, (T,), mm
        self._travel_table = Appended(3)  # travel; the step to it; since the first frame
        # Of a release, the dark plateau is unknown: no reference specifies it.
        self._dark_from_frames = self._release or operation.dark is None
        self._marked_noise: float | None = None
        self._threshold = 1 - threshold if self._release else threshold
        dark, bright = reference_maps(operation.dark, operation.bright, shape, dtype)
        alike = dark.ndim == bright.ndim == 0 and not (self._subframe and self._dark_from_frames)
        planes = {
            "frames_left": Planes(1, f"u{dtype.itemsize}"),  # frames until the pixel is finished
            "times": Planes(3, np.int32),  # start of the run; last frames that were clearly dark, not near
            "answers": Planes(2, np.float32),  # height and sigma
            "status": Planes(1, np.uint8),
            **({"samples": Planes(5, dtype)} if self._subframe else {}),  # those around an open run
        }
        if not alike:
            planes |= {
                "levels": Planes(2, np.float32),  # counts at the threshold, and of the dark plateau
                "thresholds": Planes(3, dtype),  # least sample that is light, not clearly dark, near
            }
        self._maps = Picture(
            operation, "onset", planes, tile=_TILE, RELEASE=int(self._release),
            SUBFRAME=int(self._subframe), ALIKE=int(alike),
        )  # fmt: skip
        fraction = threshold - _ROUNDING
        self._levels: tuple[NDArray[Any], ...] | None = None  # if alike: level, dark plateau, least light
        if alike:
            self._levels = onset_levels(bright, dark, fraction, dtype, self._release)
            return
        coarse = float(np.float32(fraction))
        self._maps.run(
            "onset_levels", fraction=coarse, fraction_rest=fraction - coarse, darks=PerPixel(dark),
            dark_step=dark.ndim // 2, brights=PerPixel(bright), bright_step=bright.ndim // 2,
        )  # fmt: skip

    def push(self, frames: AnyArray, travel: ArrayLike) -> None:
        """Process the next frames, (n, H, W), and the travel of each; InputError if it reverses."""
        first, last = len(self.travel), self.travel[-1:]
        more = check_travel(travel, len(frames), "travel", after=last, falls=self._release)
        if len(more):
            self._travels.append(more[:, np.newaxis])
            self.travel = self._travels.values[:, 0]
            steps = more - np.concatenate([last if first else more[:1], more[:-1]])
            self._travel_table.append(np.stack([more, steps, more - self.travel[0]], axis=1))
        self._noise.look(frames)
        noise = self._noise.value or 0.0  # not needed for a single frame, which is assumed to be dark
        arguments: dict[str, Any] = {}
        if self._levels is not None:
            level, plateau, least = self._levels
            sure = onset_sure(level, least, _DARK_Z_SCORE * noise)
            near = onset_near(level, plateau, sure)
            numbers = {
                "level": level,
                "plateau": plateau,
                "light": least,
                "dark_limit": sure,
                "near_limit": near,
            }
            arguments = {f"{name}_of_all": value.item() for name, value in numbers.items()}
        elif self._subframe:
            self._set_plateaus(frames[0] if first == 0 else None)
        light = _PLATEAU_Z_SCORE * np.sqrt(2) * noise  # the plateau is a sample itself
        dark = light if self._dark_from_frames else _PLATEAU_Z_SCORE * noise
        arguments |= {"noise": noise, "dark_tolerance": dark, "light_tolerance": light, "hold": self._hold}
        arguments["threshold"] = self._threshold  # as a share of the way from the plateau before the event
        arguments["travel"] = self._travel_table
        arguments |= {} if self._subframe else {"samples": None}
        self._maps.scan("onset_scan", frames, first=first, **arguments)
        self._marked_noise = self._noise.value

    def _set_plateaus(self, first: AnyArray | None) -> None:
        """Set the dark plateau from the first frame, and clearly dark samples once the noise is estimated."""
        if first is not None and self._dark_from_frames:
            plateau = np.asarray(first)
            self._maps.fill("levels", complement(plateau) if self._release else plateau, plane=1)
        noise = self._noise.value
        if noise is not None and noise != self._marked_noise:
            self._maps.run("onset_sure", tolerance=_DARK_Z_SCORE * noise)

    def event_maps(self, on_host: bool = True) -> EventMaps:
        """Return the maps of the frames so far, on the device if frames are, unless ``on_host``."""
        parts = ("answers", 0), ("answers", 1), "status", "times"
        return EventMaps(*self._maps.take(*parts, on_host=on_host))

    def reset(self, noise: float | None = None) -> None:
        """Prepare for another press with the same references and, if given, the same noise, counts."""
        self.travel = np.empty(0)
        self._travels.clear()
        self._travel_table.clear()
        self._noise.reset(noise)
        if self._dark_from_frames:  # the marks depend on the first frame
            self._marked_noise = None

    @property
    def noise(self) -> float:
        """Standard deviation of a sample, given or estimated, counts; 0 before the second frame."""
        return self._noise.value or 0.0
