"""Layout of a recording: names and readers of its header, positions, state and truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, TypeGuard, cast

import h5py
import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.arguments import as_array
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.selection import Selection
from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.base.types import MOTIONS, PROPERTIES, Floats, Header, InputError, Motion, Truth
from mirrorskin.io.model.coordinates import Coordinates
from mirrorskin.io.model.maps import TWIST, declaration_of
from mirrorskin.io.model.positions import Positions, check_finite
from mirrorskin.io.storage.atomic import is_locked
from mirrorskin.io.storage.hdf5 import Hdf5File, Node, Shape

MARK, RESULT_MARK = "mirrorskin_recording", "mirrorskin_result"
STACK = "/entry/instrument/detector/data"
DETECTOR, STAGE, TRUTH = "/entry/instrument/detector", "/entry/instrument/stage", "/entry/truth"
GROUPS = {"camera": DETECTOR, "stage": STAGE}
"""The group of a declared property, by the table of the rig file that contains it."""
TRUTH_MAPS = tuple(field.name for field in fields(Truth))
"""Contents of the truth of a simulation."""

# Values of each frame: name of the dataset, and unit.
SERIES = {
    "time": (f"{DETECTOR}/frame_time", "s"),
    "travel": (f"{STAGE}/travel", "mm"),
    "phase": (f"{STAGE}/phase", "rad"),
    "displacement": (f"{STAGE}/displacement", "mm"),
    "twist": (f"{STAGE}/twist", "rad"),
    "tilt": (f"{STAGE}/tilt", "rad"),
}
ROW_SHAPES: Mapping[str, Shape] = {"displacement": (2,)}
"""Shapes of the values of one frame in series that have several."""
# Datasets of recordings that are written live: the positions estimated when the frames arrived, whether a
# frame was used, the number of frames lost before it, and the state of the recording.
LIVE = {name: (f"{place}_live", unit) for name, (place, unit) in SERIES.items() if name != "time"}
FINDINGS = "/entry/findings"
USED, DROPPED, STATE = f"{DETECTOR}/used", f"{DETECTOR}/dropped", "/entry/state"
# The CRC-32 of each frame's bytes when it was recorded.
CHECKSUM = f"{DETECTOR}/frame_checksum"
UNDER_WAY, COMPLETE, CUT_SHORT = "under way", "complete", "cut short: "


POSITIONS: dict[Motion, str] = {
    "vertical": "travel",
    "axial": "phase",
    "horizontal": "displacement",
    "twist": "twist",
}
"""The series that contains the positions, for each motion."""

REMEDIES = {"travel": "give --travel-step or --travel", "phase": "give --phase-step or --phases"}


def as_series(name: str, values: Any) -> Any:
    """Return times, positions or weights of frames as an array in their unit; `Positions` unchanged."""
    return values if isinstance(values, Positions) else as_array(name, values, SERIES.get(name, ("", ""))[1])


@dataclass(frozen=True, slots=True)
class RecordingState:
    """State of a recording, and the frames used by a live run.

    While it is written, frames and their values are appended separately; ``count`` frames are complete.
    ``state`` is "under way", "complete", or "cut short: " and the reason.
    """

    count: int
    state: str = COMPLETE
    used: NDArray[np.bool_] | None = None  # whether a live reconstruction used a frame
    dropped: NDArray[np.int32] | None = None  # number of frames lost before a frame

    def of(self, frames: slice | NDArray[np.intp]) -> RecordingState:
        """Return the state of some frames."""
        used = None if self.used is None else self.used[frames]
        return replace(self, used=used, dropped=None if self.dropped is None else self.dropped[frames])


def read_state(file: Hdf5File, ours: bool, stack: h5py.Dataset, count: int) -> RecordingState:
    """Read the state of a recording; stacks of other programs, of ``count`` frames, are complete."""
    node = file.find(STATE) if ours else None
    if node is None:
        lost = file.find(DROPPED) if ours else None
        return RecordingState(count, dropped=None if lost is None else file.read(lost, (count,)))
    state = str(file.value(node))
    if state == UNDER_WAY and not (file.root.swmr_mode and is_locked(file.path)):
        state = f"{CUT_SHORT}its writer was killed"
    places = [place for place, _ in (*SERIES.values(), *LIVE.values())]
    with translate_os_errors(str(file.path)):
        nodes = {place: file.find(place) for place in (*places, USED, DROPPED)}
        grown = {place: node for place, node in nodes.items() if _grows(node)}
        count = min(int(node.shape[0]) for node in (stack, *grown.values()))
    used, dropped = (
        file.read(grown[place], (count,), rows=count) if place in grown else None for place in (USED, DROPPED)
    )
    return RecordingState(count, state, None if used is None else used != 0, dropped)


def read_checksums(file: Hdf5File, node: Node, state: RecordingState) -> NDArray[np.uint32]:
    """Read the checksums of a recording's frames; while it is written, those of the last may be missing."""
    remedy = "copy the file again, or read the frames without them with --no-verify"
    rows = state.count
    if state.state != COMPLETE and _grows(node):
        rows = min(rows, int(node.shape[0]))
    values = file.read(node, (rows,), rows=rows if _grows(node) else None, remedy=remedy)
    if values.dtype != np.uint32:
        raise InputError(f"{file.where(node)} is of type {values.dtype} where uint32 is needed: {remedy}")
    return values


def _grows(node: Node | None) -> TypeGuard[h5py.Dataset]:
    return isinstance(node, h5py.Dataset) and node.ndim > 0 and node.maxshape[0] is None


class Layout:
    """Reader of the properties of a part of a stack; for other programs' stacks, its coordinates."""

    def __init__(
        self,
        file: Hdf5File,
        ours: bool,
        shape: tuple[int, int, int],
        part: Selection,
        coordinates: Coordinates | None = None,
    ) -> None:
        self._file, self._ours, self._part = file, ours, part
        self._coordinates = coordinates or Coordinates()
        self._count, self._frame = shape[0], shape[1:]

    def header(
        self,
        motion: Motion | None,
        tilt: float | None,
        pixel_size: tuple[float, float] | None,
        override_motion: bool = False,
    ) -> Header:
        """Read the properties of the whole stack; given properties may be missing in the file."""
        stored = self._text(f"{STAGE}/motion")
        if motion and stored in MOTIONS and stored != motion and not override_motion:
            raise InputError(
                f"{self._file.path} states the motion {stored}, but --motion is {motion}: leave --motion out,"
                " or correct the file"
            )
        motion = motion or cast(Motion, stored) or self._coordinates.motion
        if motion not in MOTIONS:
            problem = (
                f"states the unknown motion {motion!r}" if motion else "does not state how the sensor moved"
            )
            raise InputError(f"{self._file.path} {problem}: give --motion, one of {', '.join(MOTIONS)}")
        # In a vertical press the dataset "travel" contains the positions, not the press.
        pressed = "vertical" not in (stored, motion)
        pixel_size = self._pixel_size() if pixel_size is None else self._above_zero(pixel_size)
        return Header(
            motion,
            title=self._text("/entry/title"),
            start_time=self._text("/entry/start_time"),
            pixel_size=pixel_size,
            dark=self._reference("dark"),
            bright=self._reference("bright"),
            press=self._one("travel", "correct it") if pressed else None,
            tilt=self._one("tilt", "give --tilt") if tilt is None else tilt,
            pivot=self._pivot(pixel_size),
            zenith_gain=self._map(f"{DETECTOR}/zenith_gain", "1/rad"),
            zenith_offset=self._map(f"{DETECTOR}/zenith_offset"),
            camera=self._text(f"{DETECTOR}/local_name"),
            **{
                name: self._scalar(f"{GROUPS[prop.of]}/{name}", prop.unit, "correct it")
                for name, prop in PROPERTIES.items()
            },
        )

    def positions(self, motion: Motion, positions: ArrayLike | None) -> dict[str, Floats | None]:
        """Read and check the times and positions of the frames; travel or phase may be given."""
        name, time = POSITIONS[motion], self._cut(self._series("time"))
        if name not in REMEDIES:
            return {"time": time, name: self._cut(self._series(name))}
        where = f"{self._file.path}: {SERIES[name][0] if positions is None else f'the {name} given'}"
        positions = self._series(name, remedy=REMEDIES[name]) if positions is None else positions
        if positions is None:
            remedy = REMEDIES[name]
            raise InputError(
                f"{self._file.path} does not state the position of the body in each frame: {remedy}"
            )
        series = {"time": time, name: check_finite(positions, self._count, where, self._part.frames)}
        pressed = self._text(f"{STAGE}/motion") != "vertical"
        also = ("tilt", "travel") if motion == "axial" and pressed else ()
        return series | {other: self._each(other) for other in also}

    def live(self, motion: Motion, chosen: NDArray[np.intp]) -> dict[str, Floats | None]:
        """Read the times of some frames of the part, and the positions that a live run used."""
        name = POSITIONS[motion]
        names = [name, "tilt"] if motion == "axial" and self._is_of_each("tilt") else [name]
        time = self._cut(self._series("time"))
        series = {"time": None if time is None else time[chosen]}
        for other in names:
            values = self._cut(self._series(other, LIVE))
            if values is None:
                raise InputError(f"{self._file.path} contains no positions of a live run: leave --live out")
            where = f"{self._file.path}: {LIVE[other][0]} of the frames that were used"
            series[other] = check_finite(values[chosen], len(chosen), where, width=ROW_SHAPES.get(other, ()))
        return series

    def findings(self) -> tuple[Finding, ...]:
        """Read the findings that were stored when the frames were imported."""
        text = self._text(FINDINGS)
        try:
            return msgspec.json.decode(text, type=tuple[Finding, ...]) if text else ()
        except msgspec.DecodeError as error:
            raise InputError(f"{self._file.path}: {FINDINGS} is damaged ({error}): import again") from None

    def truth(self) -> Truth | None:
        """Read the truth of a simulation, if there is one."""
        nodes = self.truth_nodes()
        return Truth(**{name: self._known(name, node) for name, node in nodes.items()}) if nodes else None

    def truth_nodes(self) -> dict[str, Node]:
        """Return the contents of the truth, by name; InputError if it is incomplete."""
        if self._find(TRUTH) is None:
            return {}
        maps = {name: self._find(f"{TRUTH}/{name}") for name in TRUTH_MAPS}
        present = {name: node for name, node in maps.items() if node is not None}
        missing = [f.name for f in fields(Truth) if f.default is MISSING and f.name not in present]
        if present and missing:
            raise InputError(f"{self._file.path}: {TRUTH} has no {', '.join(missing)}: simulate it again")
        return present

    def _known(self, name: str, node: Node) -> NDArray[Any]:
        """Read one part of the truth: a series, or a map."""
        unit = None if name in TWIST else declaration_of(name).unit or None  # the unit differs for a twist
        if name == "force":
            forces = self._file.read(node, (self._count, 3), unit=unit)
            return forces[slice(*self._part.frames)].astype(np.float64, copy=False)
        if name == "displacement":
            shape = (self._count, *self._frame, 2)
            maps = self._file.read(node, shape, unit=unit)
            return maps[slice(*self._part.frames), *self._part.region.slices].astype(np.float32, copy=False)
        values = self._file.read(node, self._frame, unit=unit)[self._part.region.slices]
        return np.ascontiguousarray(values, np.uint8 if name in ("contact", "slip") else np.float32)

    def _cut(self, values: Floats | None) -> Floats | None:
        return None if values is None else values[slice(*self._part.frames)]

    def _series(
        self, name: str, places: Mapping[str, tuple[str, str]] = SERIES, remedy: str = ""
    ) -> Floats | None:
        """Read a series; while a recording is written, it may be longer than needed."""
        if not self._ours:
            return self._coordinates.series.get(name)
        place, unit = places[name]
        rows = self._count if self._find(STATE) is not None else None
        shape = self._count, *ROW_SHAPES.get(name, ())
        return self._read(place, shape, unit=unit, remedy=remedy, rows=rows)

    def _pixel_size(self) -> tuple[float, float] | None:
        x, y = (self._scalar(f"{DETECTOR}/{axis}_pixel_size", "mm", "give --pixel-size") for axis in "xy")
        if x is y is None:
            size = self._coordinates.pixel_size
            return size and self._above_zero(size)
        if x is None or y is None:
            raise InputError(
                f"{self._file.path} states the pixel size along one axis only: give --pixel-size"
            )
        return self._above_zero((x, y))

    def _above_zero(self, pixel_size: tuple[float, float]) -> tuple[float, float]:
        if not all(1e-9 < size < 1e6 for size in pixel_size):
            raise InputError(
                f"{self._file.path}: pixel size {pixel_size} mm: give --pixel-size, above zero: 1e-9 to 1e6"
            )
        return pixel_size

    def _reference(self, name: str) -> NDArray[np.float32] | None:
        node = self._find(f"{DETECTOR}/{name}")
        if node is None:
            return None
        values = self._file.read(node, self._frame, remedy=f"give --{name}, or take the reference again")
        return np.ascontiguousarray(values[self._part.region.slices], np.float32)

    def _map(self, name: str, unit: str | None = None) -> Floats | None:
        """Read a map of the picture, or one number for all of it."""
        values = self._read(name, (), self._frame, unit=unit)
        if values is None or not values.ndim:
            return values
        return np.ascontiguousarray(values[self._part.region.slices])

    def _one(self, name: str, remedy: str) -> float | None:
        """Read a number that applies to all frames; None if the file contains one per frame."""
        place, unit = SERIES[name]
        return None if self._is_of_each(name) else self._scalar(place, unit, remedy)

    def _each(self, name: str) -> Floats | None:
        """Read a number for each frame of the part; None if the file does not contain one per frame."""
        values = self._series(name) if self._is_of_each(name) else None
        where = f"{self._file.path}: {SERIES[name][0]}"
        return None if values is None else check_finite(values, self._count, where, self._part.frames)

    def _is_of_each(self, name: str) -> bool:
        node = self._find(SERIES[name][0])
        return isinstance(node, h5py.Dataset) and (_grows(node) or (node.size or 0) > 1)

    def _pivot(self, pixel_size: tuple[float, float] | None) -> tuple[float, float, float] | None:
        """Read the pivot, and convert it to a position relative to the centre of the region."""
        values = self._finite(f"{STAGE}/pivot", (3,), unit="mm")
        if values is None:
            return None
        x, y, z = values.tolist()
        right, up = self._part.region.centre(self._frame, pixel_size) if pixel_size else (0.0, 0.0)
        return x - right, y - up, z

    def _scalar(self, name: str, unit: str, remedy: str) -> float | None:
        values = self._finite(name, (), (1,), unit=unit, remedy=remedy)
        return None if values is None else float(values.reshape(()))

    def _finite(self, name: str, *shapes: Shape, unit: str, remedy: str = "correct it") -> Floats | None:
        values = self._read(name, *shapes, unit=unit, remedy=remedy)
        if values is not None and not np.isfinite(values).all():
            raise InputError(f"{self._file.path}: {name} is {values}, which is not finite: {remedy}")
        return values

    def _read(self, name: str, *shapes: Shape, **how: Any) -> Floats | None:
        """Read numbers as float64 if they exist; see `Hdf5File.read`."""
        node = self._find(name)
        return None if node is None else self._file.read(node, *shapes, **how).astype(np.float64, copy=False)

    def _text(self, name: str) -> str:
        node = self._find(name)
        return "" if node is None else str(self._file.value(node))

    def _find(self, name: str) -> Node | None:
        return self._file.find(name) if self._ours else None
