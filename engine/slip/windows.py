"""Windows of a key frame that are followed one by one, and their states, on a device."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.slip.tracking import Level, Part, Tracker
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.skin.slip import (
    FIND_SLIP,
    FIXED,
    KNOWN,
    LAST,
    LEARN,
    LEARNED,
    MAPS,
    MEASURE,
    NUMBERS,
    ONSET,
    SCRATCH,
    STATES,
    SUMS,
)

Singles = NDArray[np.float32]
Integers = NDArray[np.int32]


class Motion(NamedTuple):
    """A rigid motion: its centre x + i y and the displacement there, mm; its turn, less 1; variances."""

    about: complex
    moved: complex
    turn_less_1: complex
    variance: float
    angle_variance: float


class Found(NamedTuple):
    """What a frame shows; maps are (rows, columns) of all windows."""

    counted: int  # windows in contact with texture
    slipped: int  # of these
    seen: int  # windows in contact that were found with this key
    matched: int  # windows in contact that are found
    started: bool  # whether a contact of enough windows has started
    motion: Motion | None
    displacement: Singles  # (rows, columns, 2), mm
    sigma: Singles  # (rows, columns, 2)
    covariance: Singles  # (rows, columns, 3): xx, yy and xy
    status: NDArray[np.uint8]
    onset: Integers


class Windows:
    """Windows of a key frame and the state of each; see `mirrorskin.kernels.skin.slip`.

    Attributes
    ----------
    level : Level
        The windows at full resolution.
    part : (slice, slice)
        Rows and columns of the windows that are followed.
    """

    def __init__(
        self, key: NDArray[Any], window: int, step: int, size: tuple[float, float], device: Device
    ) -> None:
        self._tracker = Tracker(key, window, step, device, separate=True)
        self.level: Level = self._tracker.finest
        self._device = device
        grid, group = self.level.grid, device.layout.group
        self.part: Part = self.level.whole
        apart = max(1, round(window / step))
        rows, columns = key.shape
        x, y = (
            (self.level.start - (count - 1) / 2) * mm for count, mm in zip((columns, rows), size, strict=True)
        )
        self._constants: dict[str, Any] = {
            "rows": grid[0],
            "columns": grid[1],
            "apart": apart,
            "bend_scale": (window / (apart * step)) ** 2 / 24,
            "chance": 1 + 2 * math.sqrt(2) / window,  # two standard deviations of a window's variance
            "grid": (x, -y, step * size[0], step * size[1]),
            "size": size,
        }
        self._state = device.array("state", (STATES, *grid), np.int32)
        shapes = {"known": (KNOWN, *grid), "scratch": (SCRATCH, *grid), "sums": (group, SUMS)}
        self._maps = {name: device.array(name, shape, np.float32) for name, shape in shapes.items()}
        self._found: Array = device.array("found", (NUMBERS + MAPS * math.prod(grid),), np.int32)
        self._start: tuple[list[float], list[float]] = [0.0, 0.0], [0.0, 0.0]
        self._least, self._enough = 0, self._tracker.least_converged(self.part)
        self._work: dict[str, int] = {}  # that was submitted
        self.level.maps["field"].write(self.level.rest)
        state = self.read()
        state.view(np.float32)[[LEARNED, FIXED, FIXED + 1]], state[ONSET] = np.nan, -1
        self.write(state)

    def read(self) -> Integers:
        """Return a copy of the state, (`STATES`, rows, columns)."""
        return self._state.read()

    def write(self, state: Integers) -> None:
        """Replace the state."""
        self._state.write(state)

    def know(self, *planes: Doubles) -> None:
        """Replace the variances and displacements on the device, (`KNOWN`, rows, columns)."""
        self._maps["known"].write(np.concatenate(planes))

    def choose(self, part: Part) -> None:
        """Follow the windows of a part, from now on."""
        self.part, self._enough = part, self._tracker.least_converged(part)

    def follow(self, frame: NDArray[Any]) -> None:
        """Follow the windows of the part to a frame."""
        self._frame, self._least = frame, self._enough
        self.level.follow_windows(frame, *self._start, self.part)

    def submit(self, work: int, since_key: int, frame: int = 0, started: bool = False) -> None:
        """Start some of the work of a frame on the device."""
        self._work = {"work": work, "since_key": since_key, "frame": frame, "started": started}
        self._launch()

    def answer(self) -> Found | None:
        """Wait for the work; return what the frame shows if it includes the search for slip."""
        work = self._work["work"]
        found = self._found.read(slice(None if work & FIND_SLIP else NUMBERS))
        if found[0] < self._least:
            self._search()
            self._launch()
            return self.answer()
        numbers = found[:NUMBERS].view(np.float32).tolist()
        if work & LEARN:
            self._start = numbers[1:3], numbers[3:5]
        if not work & FIND_SLIP:
            return None
        counted, slipped, seen, matched, has_motion, started = found[5:11].tolist()
        x, y, right, up, sine, less, *variances = numbers[11:19]
        motion = Motion(complex(x, y), complex(right, up), complex(less, sine), *variances)
        grid, maps, count = self.level.grid, found[NUMBERS:], math.prod(self.level.grid)
        displacement, sigma, covariance = (
            maps[start * count : end * count].view(np.float32).reshape(*grid, end - start)
            for start, end in ((0, 2), (2, 4), (4, 7))
        )
        status, onset = maps[7 * count :].reshape(2, *grid)
        return Found(
            counted, slipped, seen, matched, bool(started), motion if has_motion else None,
            displacement, sigma, covariance, status.astype(np.uint8), onset,
        )  # fmt: skip

    def measure_all(self, frame: NDArray[Any], since_key: int) -> tuple[NDArray[np.complex128], Doubles]:
        """Return the displacement of all windows at a frame that was followed, and their squared bias.

        They are x + i y, (rows, columns) mm, NaN where a window is not found; and (2, rows, columns).
        """
        last = self.read().view(np.float32)[LAST:]
        self.level.maps["field"].write(last)
        start = last[:2].reshape(2, -1)
        self._start = start.min(axis=1).tolist(), start.max(axis=1).tolist()
        self.choose(self.level.whole)
        self.follow(frame)
        self.submit(MEASURE, since_key)
        self.answer()
        x, y, *_, bent_x, bent_y = self._maps["scratch"].read()[:7].astype(np.float64)
        return x + 1j * y, np.stack([bent_x, bent_y])

    def _launch(self) -> None:
        """Start the submitted work."""
        rows, columns = self.part
        maps = self.level.maps
        self._device.kernel("slip", "slip_windows", GROUP=self._device.layout.group)(
            self._device.layout.group,
            **self._constants,
            top=rows.start,
            bottom=rows.stop,
            left=columns.start,
            right=columns.stop,
            least=self._least,
            **self._work,
            answer=maps["answer"],
            field=maps["field"],
            state=self._state,
            found=self._found,
            known=self._maps["known"],
            scratch=self._maps["scratch"],
            sums=self._maps["sums"],
            moved=self._state.nbytes,
        )

    def _search(self) -> None:
        """Find windows by coarser resolutions, as too few converged."""
        self._least, part, maps = 0, self.part, self.level.maps
        begin = maps["field"].read().astype(np.float64)
        best, field = self.level.answered(begin, part)
        best, field = self._tracker.search(self._frame, best, begin, field, part)
        answer = maps["answer"].read()
        contrast, change = best.converged * 1.0, np.where(best.converged, 0.0, np.nan)
        answer[:, *part] = [*field[:, *part], contrast, best.variance, change]
        maps["answer"].write(answer)
        maps["field"].write(field)
