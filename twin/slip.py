"""The effect of friction on the skin, frame by frame, while the pressed body moves along the object."""

from __future__ import annotations

import functools
import math
from tempfile import TemporaryFile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.twin.skin import drive, material, on_object
from mirrorskin.twin.elastic import HalfSpace, Window
from mirrorskin.twin.friction import Friction
from mirrorskin.twin.movement import Horizontal, Twist, pose_at_press
from mirrorskin.twin.skin import Elastic

_STEPS = 16  # minimum number of steps to full sliding; maximum number between two frames
_POINTS_MAX = 8_000_000


class _Course(NamedTuple):
    """Results of `Friction` along a movement."""

    window: Window  # part of the grid with traction
    loads: NDArray[np.float32]  # (T, 2, h, w), N/mm^2
    forces: Floats  # (T, 2), N
    onset: Floats  # on the grid


class Drag(NamedTuple):
    """The displacement of the skin by friction at one moment: see `mirrorskin.kernels.twin.skin`.

    Attributes
    ----------
    shift : ndarray, (2, rows, columns), float32
        How far traction shifts the surface, mm, in the object's frame.
    place : ndarray, (2,) or (1,)
        Of the body, mm, or its angle.
    pixel_size : (float, float)
        Millimetres along x and y.
    """

    shift: NDArray[Any]
    place: Floats
    pixel_size: tuple[float, float]

    @classmethod
    def by(
        cls,
        space: HalfSpace,
        window: Window,
        load: NDArray[np.float32],
        margin: tuple[int, int],
        place: Floats,
    ) -> Drag:
        """Return the drag of the traction in a window of a grid, on the grid extended by a margin."""
        rows, columns = (size + 2 * more for size, more in zip(space.shape, margin, strict=True))
        across, along = (
            slice(part.start + more, part.stop + more) for part, more in zip(window, margin, strict=True)
        )
        shift = space.window(rows, columns, (across, along)).tangential(load)
        return cls(shift, place, space.pixel_size)

    def material(self, points: Floats) -> Floats:
        """Return the positions at the press of the skin that is now at points, (2, ...), mm along x and y."""
        return material(self.shift, self.pixel_size, self.place, points)

    def launch(self, name: str, device: Device, shape: tuple[int, ...], **arguments: Any) -> None:
        """Run a kernel of ``skin.cl`` on maps of a shape."""
        (rows, columns), (along_x, along_y) = shape, self.pixel_size
        place_x, place_y = (*self.place, 0.0)[:2]
        shift = device.from_host("shift", self.shift)
        device.kernel("skin", name, TWIST=int(len(self.place) == 1))(
            -(-rows * columns // device.layout.tile),
            rows=rows,
            columns=columns,
            grid_rows=shift.shape[1],
            grid_columns=shift.shape[2],
            along_x=along_x,
            along_y=along_y,
            place_x=place_x,
            place_y=place_y,
            shift=shift,
            moved=shift.nbytes + 16 * rows * columns,
            **arguments,
        )


class SkinHistory:
    """Stick and slip along a horizontal movement or a twist, and the displacement of each point of the skin.

    The pressure of the press moves with the object. In the object's frame it is constant, and there
    `Friction` computes the traction q and the displacement u of the surface by q. `kernels/twin/skin.py`
    computes the resulting displacement of the skin.

    The number of steps per frame is such that full sliding takes at least 16. A point breaks loose when its
    traction reaches the limit mu p. Close to that, the square of the difference decreases linearly with the
    travel (exactly so under a ball, by Cattaneo and Mindlin), and the onset is extrapolated to 0. Between two
    frames the traction is interpolated linearly.

    Parameters
    ----------
    skin : Elastic
    movement : Horizontal or Twist
    coefficient : float
        Coulomb's, between sheet and object.
    device : Device

    Attributes
    ----------
    travel : ndarray, (T,), float64
        Distance travelled by the body since the press: mm, or radians of a twist.

    Raises
    ------
    InputError
        The distance is too long for pixels this small.
    """

    def __init__(
        self, skin: Elastic, movement: Horizontal | Twist, coefficient: float, device: Device
    ) -> None:
        self._skin, self._movement, self._coefficient, self._device = skin, movement, coefficient, device
        self._path: Floats = movement.path.reshape(len(movement.path), -1)
        self._steps = np.diff(self._path, axis=0, prepend=np.zeros_like(self._path[:1]))
        self.travel: Floats = np.cumsum(np.sqrt(np.sum(self._steps**2, axis=1)))
        self._margin = _margin(skin, self._path)
        rows, columns = (size + 2 * more for size, more in zip(skin.space.shape, self._margin, strict=True))
        if rows * columns > _POINTS_MAX:
            raise InputError(
                f"a displacement of {self.travel[-1]:g} "
                f"{'rad' if isinstance(movement, Twist) else 'mm'} over the skin needs {rows} x "
                f"{columns} points, but the maximum is {_POINTS_MAX}: use larger pixels"
            )

    @property
    def force(self) -> Floats:
        """Force of the object on the body along x and y, (T, 2), N."""
        return self._course.forces

    @property
    def slip_onset(self) -> Floats:
        """The travel at which each point broke loose, (H, W); NaN where it sticks or was not pressed."""
        onset: Floats = self._skin.crop(self._course.onset)
        return onset

    def drag(self, frame: float) -> Drag:
        """Return the drag of the skin at a frame.

        The number may be fractional, from half a frame before the first to half a frame after the last.
        """
        before, after, fraction = self._between(frame)
        window, loads, *_ = self._course
        load = (1 - fraction) * loads[before] + fraction * loads[after]
        place = self._path[before] + fraction * (self._path[after] - self._path[before])
        return Drag.by(self._skin.space, window, load, self._margin, place)

    def displacements(self) -> NDArray[np.float32]:
        """Return the displacement of the skin along itself in each frame, (T, H, W, 2), mm; on the disk.

        The points are those at the pixels at the press. NaN where the skin's surface would fold.
        """
        shape = self._skin.places.shape
        with TemporaryFile() as file:
            maps = np.memmap(file, np.float32, "w+", shape=(len(self._path), *shape[1:], 2))
        displacement = self._device.array("displacement", shape, np.float32)
        for frame, kept in enumerate(maps):
            # It starts from the displacement of the preceding frame.
            self.drag(frame).launch("skin_displacement", self._device, shape[1:], displacement=displacement)
            kept[...] = np.moveaxis(displacement.read(), 0, -1)
        return maps

    @functools.cached_property
    def _course(self) -> _Course:
        """Results of all frames in their order."""
        skin = self._skin
        pressure = skin.solve(pose_at_press(self._movement.deepest)).pressure
        friction = Friction(skin.space, pressure, self._coefficient)
        slide = _Slide(friction, skin, self._coefficient * pressure)
        window = friction.window
        loads = np.zeros((len(self._steps), *friction.traction[:, *window].shape), np.float32)
        forces = np.zeros((len(self._steps), 2))
        for frame, step in enumerate(self._steps):
            slide.go(step)
            loads[frame], forces[frame] = friction.traction[:, *window], friction.force
        return _Course(window, loads, forces, slide.onset)

    def _between(self, frame: float) -> tuple[int, int, float]:
        """Return the frames before and after a moment, and the fraction in between."""
        last = len(self._steps) - 1
        before = min(max(math.floor(frame), 0), max(last - 1, 0))
        return before, min(before + 1, last), frame - before


class Grip(NamedTuple):
    """Friction at one moment.

    Attributes
    ----------
    force : ndarray, (2,)
        Force of the object on the body along x and y, N.
    slid : ndarray, (2,)
        How far the object has slid over the sheet since it touched, where the pressure is greatest, mm.
    """

    force: Floats
    slid: Floats


class SkinState:
    """Stick and slip of a pressed body as it moves, of which only the current state is kept.

    Equivalent to `SkinHistory` of a movement through the same positions without another press.

    Parameters
    ----------
    skin : Elastic
    travel : float
        Travel of the press, mm.
    coefficient : float
        Coulomb's, between sheet and object.
    """

    def __init__(self, skin: Elastic, travel: float, coefficient: float) -> None:
        self._skin, self._coefficient = skin, coefficient
        self._pressure = skin.solve(pose_at_press(travel)).pressure
        self._friction = Friction(skin.space, self._pressure, coefficient)
        self._slide = _Slide(self._friction, skin, coefficient * self._pressure)
        self._place: Floats | None = None
        self._margin = 0, 0

    @property
    def grip(self) -> Grip:
        """The present force along the sheet, and how far the object has slid."""
        most = int(np.argmax(self._pressure))
        return Grip(self._friction.force, self._friction.slid.reshape(2, -1)[:, most].copy())

    @property
    def touches(self) -> bool:
        """Whether there is contact."""
        return bool(self._pressure.any())

    def press(self, travel: float) -> None:
        """Press to another travel, mm, at the same position."""
        self._pressure = self._skin.solve(pose_at_press(travel)).pressure
        self._friction.press(self._pressure)
        self._slide.press(self._coefficient * self._pressure)
        if self._place is not None:
            self._take_drag(self._place)

    def go(self, place: Floats) -> None:
        """Move the body along a straight line to a position: x and y, (2,), mm, or a twist, (1,), radians."""
        before = np.zeros_like(place) if self._place is None else self._place
        if self._place is not None and np.array_equal(before, place):
            return
        self._slide.go(place - before)
        self._place = place
        rows, columns = _margin(self._skin, place[np.newaxis])
        self._margin = max(rows, self._margin[0]), max(columns, self._margin[1])
        self._take_drag(place)

    def _take_drag(self, place: Floats) -> None:
        window = self._friction.window
        load = self._friction.traction[:, *window].astype(np.float32)
        self._drag = Drag.by(self._skin.space, window, load, self._margin, place)

    def drag(self, frame: float) -> Drag:
        """Return the current drag of the skin, whatever the frame."""
        return self._drag


class _Slide:
    """The motion of one body in steps that are small compared with full sliding, and where it slips."""

    def __init__(self, friction: Friction, skin: Elastic, limit: Floats) -> None:
        self.onset = np.full(limit.shape, np.nan)
        self._friction, self._space, self._places = friction, skin.space, skin.grid_places
        self._place: Floats | None = None
        self._now = 0.0, limit**2
        self.press(limit)

    def press(self, limit: Floats) -> None:
        """Continue with another limit of the traction, N/mm^2."""
        self._limit, self._pressed = limit, self._places[:, limit > 0]
        self._far = float(self._space.tangential(np.stack([limit, np.zeros_like(limit)]))[0].max())
        # The travel, and the squared difference of the traction from its limit: now, and one step before.
        lacking = (limit - np.hypot(*self._friction.traction)) ** 2
        self._now = self._before = self._now[0], lacking

    def go(self, step: Floats) -> None:
        """Move from one frame to the next."""
        start = np.zeros_like(step) if self._place is None else self._place
        self._place = start + step
        moved = float(np.hypot(*drive(step, self._pressed)).max(initial=0.0))
        count = min(max(1, math.ceil(_STEPS * moved / self._far)), _STEPS) if self._far > 0 else 1
        for number in range(count if step.any() else 0):
            slips = self._friction.move(drive(start + (number + 1) / count * step, self._places))
            travel = self._now[0] + math.hypot(*step) / count
            self._note(slips & np.isnan(self.onset), travel)
            lacking = (self._limit - np.hypot(*self._friction.traction)) ** 2
            self._before, self._now = self._now, (travel, lacking)

    def _note(self, new: NDArray[np.bool_], travel: float) -> None:
        """Record the travel at which points broke loose in a step that ends at a travel."""
        (before, lacked), (now, lacks) = self._before, self._now
        falls = np.maximum(lacked[new] - lacks[new], 0.0)
        middle = np.full_like(falls, (travel - now) / 2)
        more = np.divide(lacks[new] * (now - before), falls, out=middle, where=falls > 0)
        self.onset[new] = np.minimum(now + more, travel)


def _margin(skin: Elastic, path: Floats) -> tuple[int, int]:
    """Return the rows and columns by which the grid must be extended for the positions that pixels see."""
    corners = skin.places[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    at = np.concatenate([on_object(place, corners) for place in np.unique(path, axis=0)], axis=1)
    far_x, far_y = np.abs(at).max(axis=1)
    (rows, columns), (along_x, along_y) = skin.space.shape, skin.space.pixel_size
    return max(0, math.ceil(far_y / along_y - rows / 2)), max(0, math.ceil(far_x / along_x - columns / 2))
