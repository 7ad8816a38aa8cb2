"""The search for a threshold crossing on a device, which operations of a press share (paper, section 3)."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import Noise, reference_maps
from mirrorskin.engine.operation import Operation
from mirrorskin.engine.options import option
from mirrorskin.engine.tiling import Band, Planes, Staged, cut_into_bands, join_rows, room_of
from mirrorskin.io.positions import check_travel
from mirrorskin.io.types import FRAME_DTYPES
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.onset import DARK, complement

if TYPE_CHECKING:
    from mirrorskin.io import Source

Event = Literal["onset", "release"]

_PLATEAU = 3.0  # sigmas by which a sample may differ from the plateau that it sits on
_SURELY = 6.0  # sigmas by which a sample must miss the level so that its plateau is not near it
_ROUNDING = 1e-12  # a threshold such as 0.55 is not exact: counts that reach it but for rounding are light
_TILE = 4096  # pixels of a core's item: of long rows more is read at once, in 0.8 of the time of 1024
_LONGEST = 2**30  # no stack is as long, and sums with frames' numbers stay in range


class PressOperation(Operation):
    """Base of operations on a press: what is known of dark, light and noise."""

    motions = ("vertical",)
    dtypes = FRAME_DTYPES
    least_frames = 2
    on_device = long_blocks = True

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
        shown_default="estimated from the first two frames",
    )

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's own levels of dark and light, where none are given."""
        levels = {name: getattr(source.header, name) for name in ("dark", "bright")}
        return self.with_options(**{name: own for name, own in levels.items() if getattr(self, name) is None})


class CrossingOperation(PressOperation):
    """Base of operations that search for threshold crossings."""

    subframe: bool = option(
        default=True,
        help="interpolate between the frames around the event; without it, the paper's equation 4 as printed",
    )


class Found(NamedTuple):
    """What a search found at each pixel.

    Attributes
    ----------
    height, sigma : ndarray, (H, W), float32
        Millimetres; NaN unless status is 1.
    status : ndarray, (H, W), uint8
        Codes of `mirrorskin.io.maps.PressStatus` or `mirrorskin.io.maps.ReleaseStatus`.
    frame : ndarray, (H, W), int32
        Number of the first frame after the event; -1 without one.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    status: NDArray[np.uint8]
    frame: NDArray[np.int32]


class Crossing:
    """Search for the crossing of one threshold on a device.

    Options are those of ``operation``, which owns the search; the threshold may be another one.
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
        self.device: Device = operation.device
        self._length = max(1, operation.memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self._bands = cut_into_bands(self.device, shape, dtype, self._planes(), self._length)
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

    def push(self, frames: NDArray[Any], travel: ArrayLike, lent: bool = False) -> None:
        """Take in the next frames, (n, H, W), and the travel of each; InputError if it runs back."""
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

    def found(self, last: bool = False) -> Found:
        """Return the maps of the frames so far; of the ``last`` ones without copies, before a `reset`."""
        maps = [self._answers(band, last) for band in self._bands]
        height, sigma, status, frame = (join_rows(parts) for parts in zip(*maps, strict=True))
        return Found(height, sigma, status, np.maximum(frame, DARK, out=frame))

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
