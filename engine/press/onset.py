"""Height from a vertical press: the travel at which a pixel turns light, or dark again (paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import Noise, check_dtype, check_frames, reference_maps
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.engine.tiling import MEMORY_LIMIT, Band, Planes, Staged, cut_into_bands, join_rows, room_of
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.io.maps import PressStatus, ReleaseStatus, status_of
from mirrorskin.io.positions import check_travel
from mirrorskin.io.result import Shown
from mirrorskin.kernels.device import C_TYPES, Device, open_device
from mirrorskin.kernels.onset import DARK, complement

Event = Literal["onset", "release"]
EVENTS: tuple[Event, ...] = get_args(Event)

_PLATEAU = 3.0  # sigmas by which a sample may differ from the plateau that it sits on
_SURELY = 6.0  # sigmas by which a sample must miss the level so that its plateau is not near it
_ROUNDING = 1e-12  # a threshold such as 0.55 is not exact: counts that reach it but for rounding are light
_INT_MAX = np.iinfo(np.int32).max
_TILE = 4096  # pixels of a core's item: of long rows more is read at once, in 0.8 of the time of 1024
_LONGEST = 2**30  # no stack is as long, and sums with frames' numbers stay in range


@dataclass(frozen=True, slots=True, repr=False)
class Onset(Shown):
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
        Standard deviation of a sample, counts, given or estimated.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    status: NDArray[np.uint8]
    frame: NDArray[np.int32]
    noise: float


@checked
def find_onset(
    frames: NDArray[Any],
    travel: ArrayLike,
    *,
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

    The sheet at a pixel has the height f = -s at the travel s of the onset (paper, equations 3 and 4).

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
        Standard deviation of a sample in counts; by default estimated from the first two frames.
    event : {"onset", "release"}
        Whether to look for the light state's begin or its end.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, travel, references or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    >>> frames = np.zeros((5, 1, 2), np.uint8)
    >>> frames[3:, 0, 0] = 255
    >>> find_onset(frames, [0.0, 0.1, 0.2, 0.3, 0.4]).height
    array([[-0.25,   nan]], dtype=float32)
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
    return search.finish()


class OnsetSearch(ThreadSafe):
    """Find the onset in frames that come block by block; see `mirrorskin.engine.streaming.Estimator`.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    dark, bright, threshold, hold, subframe, noise, event, device
        As for `find_onset`.
    memory_limit : int
        Bytes of host memory for frames on the move; half of it is the room for one block.
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
        subframe: bool = True,
        noise: float | None = None,
        event: Event = "onset",
        device: str | Device | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        if not 1 <= hold <= _INT_MAX:
            raise InputError(f"hold {hold}: a number of frames from 1 to {_INT_MAX} is needed")
        if not 0 <= threshold <= 1:
            raise InputError(
                f"threshold {threshold}: a share from 0 (dark) to 1 (bright) is needed, such as 0.5"
            )
        self._shape, self._dtype = shape, check_dtype(dtype)
        self._release, self._subframe = check_event(event) == "release", subframe
        self.maps = {"status": status_of(ReleaseStatus if self._release else PressStatus)}
        self._hold = min(hold, _LONGEST)
        self._noise = Noise(noise, self._dtype.kind == "u")
        self.device: Device = open_device(device)
        self._length = max(1, memory_limit // (2 * shape[0] * shape[1] * self._dtype.itemsize))
        self._bands = cut_into_bands(self.device, shape, self._dtype, self._planes(), self._length)
        self._travel = _TravelTable(self.device)
        # The plateau that a run comes from: no reference says how light a pixel was before its release.
        self._own_dark = self._release or dark is None
        self._macros: dict[str, str | int] = {
            "FRAME": C_TYPES[self._dtype.name],
            "BITS": 8 * self._dtype.itemsize,
        }
        self._noise_of_bounds: float | None = None
        self._set_levels(*reference_maps(dark, bright, shape, self._dtype), threshold)
        self.reset()

    @cached_property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied."""
        return room_of(self._bands, self._length)

    def _planes(self) -> dict[str, Planes]:
        """Return what is kept of each pixel."""
        return {
            "levels": Planes(2, np.float32),  # counts at the threshold, and of the dark plateau
            "marks": Planes(3, self._dtype),  # the smallest sample that is light, not surely dark, near
            "left": Planes(1, f"u{self._dtype.itemsize}"),  # frames after which nothing can change
            "times": Planes(3, np.int32),  # where the run began; the last before surely dark, not near
            "answers": Planes(2, np.float32),  # height and sigma
            "status": Planes(1, np.uint8),
            **({"samples": Planes(5, self._dtype)} if self._subframe else {}),  # around an open run
        }

    def _set_levels(self, dark: NDArray[np.float32], bright: NDArray[np.float32], threshold: float) -> None:
        """Turn references and threshold into each pixel's least light sample, in the frames' own type."""
        share = threshold - _ROUNDING
        coarse = float(np.float32(share))
        for band in self._bands:
            known: dict[str, Any] = {}
            for name, values in (("bright", bright), ("dark", dark)):
                rows = values[band.rows] if values.ndim else values.reshape(1)
                known |= {f"{name}s": self.device.seen(name, rows), f"{name}_step": values.ndim // 2}
            with band.resident():
                self._launch(
                    band, "onset_levels", "levels marks",
                    release=self._release, share=coarse, share_rest=share - coarse, **known,
                )  # fmt: skip

    def push(self, frames: NDArray[Any], *, travel: ArrayLike | None, lent: bool = False) -> None:
        """Take in the next frames, (n, H, W), and the travel of each.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another shape or type; travel is missing, or runs back.
        """
        check_frames(frames, self._dtype, self._shape)
        first, last = self._travel.count, self._travel.values[-1:]
        self._travel.extend(check_travel(travel, len(frames), "travel", after=last, falls=self._release))
        self._noise.look(frames)
        for band in self._bands:
            if self._subframe:
                self._set_plateaus(band, frames[0] if first == 0 else None)
            with band.resident():
                for staged in band.stage(frames, lent):
                    self._scan(band, staged, first + staged.frames.start)
        self._noise_of_bounds = self._noise.value

    def _set_plateaus(self, band: Band, first: NDArray[Any] | None) -> None:
        """Use the first frame as dark plateau, and the noise, once known, for what is surely dark."""
        if first is not None and self._own_dark:
            plateau = complement(first) if self._release else first
            band.write("levels", plateau[band.rows], plane=1)
        noise = self._noise.value
        if noise is not None and noise != self._noise_of_bounds:
            with band.resident():
                self._launch(band, "onset_sure", "levels marks", tolerance=_SURELY * noise)

    def _scan(self, band: Band, staged: Staged, first: int) -> None:
        # From one frame no noise is estimated, and none is needed: it is taken for dark.
        known = self._travel.arguments | self._tolerances(self._noise.value or 0.0)
        known |= {"hold": self._hold, "release": self._release, "subframe": self._subframe, "first": first}
        known |= {"frames": staged.array, "count": staged.count, "samples": band.maps.get("samples")}
        moved = staged.count * band.pixels * self._dtype.itemsize
        self._launch(band, "onset_scan", "marks left times levels answers status", moved, **known)

    def result(self) -> Onset:
        """Return the maps of the frames so far; more may follow."""
        return self._found(last=False)

    def finish(self) -> Onset:
        """Return the maps of all frames, without copies of them; only ``reset`` may follow."""
        return self._found(last=True)

    def _found(self, last: bool) -> Onset:
        noise = self._noise.value
        if noise is None or self._travel.count == 0:
            raise InputError(f"a press of {self._travel.count} frames has no onset: at least 2 are needed")
        maps = [self._answers(band, last) for band in self._bands]
        height, sigma, status, frame = (join_rows(parts) for parts in zip(*maps, strict=True))
        return Onset(height, sigma, status, np.maximum(frame, DARK, out=frame), noise)

    def _answers(self, band: Band, last: bool) -> list[NDArray[Any]]:
        """Return height, sigma, status and frame of a band's rows."""
        with band.resident():
            answers, status, times = (
                band.detach(name) if last else band.maps[name].download()
                for name in ("answers", "status", "times")
            )
            found = [band.picture(plane) for plane in (answers[0], answers[1], status[0], times[0])]
            return found if last else [plane.copy() for plane in found]

    def reset(self, noise: float | None = None) -> None:
        """Forget the frames so far, and be ready for another press with the same references.

        Its noise, counts, is estimated anew unless it is given.
        """
        self._travel.clear()
        self._noise.reset(noise)
        if self._own_dark:  # what is near the level is looked for between it and the first frame
            self._noise_of_bounds = None

    @property
    def falls(self) -> bool:
        """Whether it looks for releases, while travel falls."""
        return self._release

    @property
    def travel(self) -> NDArray[np.float64]:
        """The travel of the frames so far, (T,), mm."""
        return np.array(self._travel.values, np.float64)

    @property
    def noise(self) -> float:
        """Standard deviation of a sample, given or estimated, counts; 0 before the second frame."""
        return self._noise.value or 0.0

    def _tolerances(self, noise: float) -> dict[str, float]:
        """Return the noise, and what a sample may differ from the dark and the light plateau it sits on."""
        light = _PLATEAU * np.sqrt(2) * noise  # from the plateau, which is a sample itself
        dark = light if self._own_dark else _PLATEAU * noise
        return {"noise": noise, "dark_tolerance": dark, "light_tolerance": light}

    def _launch(self, band: Band, name: str, maps: str, moved: int = 0, **arguments: Any) -> None:
        """Run a kernel over a band; ``maps`` names those that it takes, ``moved`` the bytes of frames."""
        tile = _TILE if self.device.layout.tile > 1 else 1
        arguments |= {
            "pixels": band.pixels,
            "stride": band.stride,
            **{one: band.maps[one] for one in maps.split()},
        }
        kernel = self.device.kernel("onset", name, **self._macros, TILE=tile)
        kernel(-(-band.pixels // tile), **arguments, moved=moved)


class _TravelTable:
    """The travel of all frames so far, as kernels look it up: itself, steps, since the first frame."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._table = device.array("travel", (3, 64), np.float32)
        self.clear()

    @property
    def arguments(self) -> dict[str, Any]:
        """The planes of the table, and their length."""
        return {"travel": self._table, "room": self._table.host.shape[1]}

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
        self._table.claim()
        if count > self._table.host.shape[1]:
            known = self._table.host
            self._table = self._device.array("travel", (3, 2 * count), np.float32)
            self._table.host[:, : known.shape[1]] = known
        self.values.extend(travel.tolist())
        self._table.host[:, old:count] = travel, steps, travel - self.values[0]
        self._table.upload()


def check_stack(frames: NDArray[Any]) -> tuple[int, int]:
    """Return rows and columns of a stack, or raise InputError if it is none."""
    if frames.ndim != 3 or len(frames) < 2 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) with at least 2 frames is needed")
    return frames.shape[1], frames.shape[2]


def check_event(event: Event) -> Event:
    """Return the event if it is one, else raise InputError."""
    if event not in EVENTS:
        raise InputError(f"unknown event {event!r}; known are {', '.join(EVENTS)}")
    return event
