"""What friction does to the skin, frame by frame, while the pressed body moves along the object."""

from __future__ import annotations

import functools
import math
from tempfile import TemporaryFile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.elastic import HalfSpace, Window
from mirrorskin.hw.twin.friction import Friction
from mirrorskin.hw.twin.movement import Horizontal, Twist, pose_at_press
from mirrorskin.hw.twin.skin import Elastic
from mirrorskin.io.types import Floats, InputError

_STEPS = 16  # that full sliding takes, at least; and the most between two frames
_ROUNDS = 200  # fixed-point steps to a point of the skin; each gains a factor of the surface's strain
_CLOSE = 1e-4  # of a pixel, within which a point of the skin is found
_POINTS_MAX = 8_000_000


class _Course(NamedTuple):
    """What `Friction` finds along a movement."""

    window: Window  # of the grid, outside of which there is no traction
    loads: NDArray[np.float32]  # (T, 2, h, w), N/mm^2
    forces: Floats  # (T, 2), N
    onset: Floats  # on the grid


class SkinHistory:
    """Stick and slip along a horizontal movement or a twist, and where each point of the skin goes.

    The press's pressure goes with the object. In the object's own frame it stands still, and there `Friction`
    finds the traction q, and u, how far q shifts the surface, while the object moves by U. A point of the
    object is ahead of the skin by U - u, so that there lies the skin that was at its place plus U - u at the
    press. Of a twist U is proportional to the angle, as in the linear theory, and U - u is taken for an arc
    about the body's axis and a way along the radius: this is exact where all sticks and where nothing does.

    A frame takes as many steps as are needed for 16 to full sliding. A point breaks loose when its traction
    reaches the limit mu p; near to that, the square of what is missing falls evenly with the travel (exactly
    so under a ball, by Cattaneo and Mindlin), and the onset is where it comes to 0. Between two frames the
    traction goes evenly.

    Parameters
    ----------
    skin : Elastic
    movement : Horizontal or Twist
    coefficient : float
        Coulomb's, between sheet and object.

    Attributes
    ----------
    travel : ndarray, (T,), float64
        The way of the body since the press, along its path: mm, or radians of a twist.

    Raises
    ------
    InputError
        The way is too long for so small pixels.
    """

    def __init__(self, skin: Elastic, movement: Horizontal | Twist, coefficient: float) -> None:
        self._skin, self._movement, self._coefficient = skin, movement, coefficient
        self._path: Floats = movement.path.reshape(len(movement.path), -1)
        self._steps = np.diff(self._path, axis=0, prepend=np.zeros_like(self._path[:1]))
        self.travel: Floats = np.cumsum(np.sqrt(np.sum(self._steps**2, axis=1)))
        self._margin = _margin(skin, self._path)
        rows, columns = (size + 2 * more for size, more in zip(skin.space.shape, self._margin, strict=True))
        if rows * columns > _POINTS_MAX:
            raise InputError(
                f"a way of {self.travel[-1]:g} {'rad' if isinstance(movement, Twist) else 'mm'} over the skin"
                f" needs {rows} x {columns} points, and {_POINTS_MAX} are the most: take larger pixels"
            )
        self._space = skin.space.window(rows, columns)
        self._kept: tuple[float, Floats] | None = None

    @property
    def force(self) -> Floats:
        """Newtons that the object exerts on the body along x and y, (T, 2)."""
        return self._course.forces

    @property
    def slip_onset(self) -> Floats:
        """The travel at which each point broke loose, (H, W); NaN where it sticks or was not pressed."""
        onset: Floats = self._skin.crop(self._course.onset)
        return onset

    def material(self, frame: float, points: Floats) -> Floats:
        """Return where the skin was at the press that lies at points, (2, ...), mm along x and y.

        ``frame`` is a number with fractions, which may lie half a frame before the first or after the last.
        """
        return _material(self._space, self._shift(frame), self._place(frame), points)

    def displacement(self, frame: int, start: Floats) -> Floats:
        """Return how far points of the skin that lay at the pixels at the press have moved, (2, H, W), mm.

        ``start`` is a guess, as that of the frame before. NaN where the skin's surface would fold.
        """
        rest = self._skin.places
        reached = rest + np.nan_to_num(start)
        open_ = np.ones(rest.shape[1:], bool)
        close = _CLOSE * min(self._space.pixel_size)
        for _ in range(_ROUNDS):
            missing = rest[:, open_] - self.material(frame, reached[:, open_])
            reached[:, open_] += missing
            open_[open_] = np.hypot(*missing) > close
            if not open_.any():
                break
        reached[:, open_] = np.nan
        return reached - rest

    def displacements(self) -> NDArray[np.float32]:
        """Return how far the skin has moved along itself in each frame, (T, H, W, 2), mm; on the disk."""
        moved: Floats = np.zeros_like(self._skin.places)
        with TemporaryFile() as file:
            maps = np.memmap(file, np.float32, "w+", shape=(len(self._path), *moved.shape[1:], 2))
        for frame, kept in enumerate(maps):
            moved = self.displacement(frame, moved)
            kept[...] = np.moveaxis(moved, 0, -1)
        return maps

    @functools.cached_property
    def _course(self) -> _Course:
        """All frames in their order."""
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
        """Return the frames before and after a moment, and its share of the way between."""
        last = len(self._steps) - 1
        before = min(max(math.floor(frame), 0), max(last - 1, 0))
        return before, min(before + 1, last), frame - before

    def _place(self, frame: float) -> Floats:
        before, after, share = self._between(frame)
        place: Floats = self._path[before] + share * (self._path[after] - self._path[before])
        return place

    def _shift(self, frame: float) -> Floats:
        """Return how far traction shifts the surface, (2, rows, columns), mm, in the object's frame."""
        if self._kept is None or self._kept[0] != frame:
            before, after, share = self._between(frame)
            window, loads, *_ = self._course
            load = (1 - share) * loads[before] + share * loads[after]
            self._kept = frame, _shifted(self._skin.space, window, load, self._margin)
        return self._kept[1]


class SkinState:
    """Stick and slip of a pressed body as it is moved along, of which only the present is known.

    The same as `SkinHistory` of a movement that goes to the same places, at none of which a press is renewed.

    Parameters
    ----------
    skin : Elastic
    travel : float
        How far the body was pressed, mm.
    coefficient : float
        Coulomb's, between sheet and object.
    """

    def __init__(self, skin: Elastic, travel: float, coefficient: float) -> None:
        self._skin = skin
        pressure = skin.solve(pose_at_press(travel)).pressure
        self._friction = Friction(skin.space, pressure, coefficient)
        self._slide = _Slide(self._friction, skin, coefficient * pressure)
        self._place: Floats | None = None
        self._space, self._margin = skin.space, (0, 0)

    def go(self, place: Floats) -> None:
        """Move the body straight on to a place: x and y, (2,), mm, or a twist, (1,), radians."""
        before = np.zeros_like(place) if self._place is None else self._place
        if self._place is not None and np.array_equal(before, place):
            return
        self._slide.go(place - before)
        self._place = place
        rows, columns = map(max, _margin(self._skin, place[np.newaxis]), self._margin)
        if (rows, columns) != self._margin:
            height, width = self._skin.space.shape
            self._space = self._skin.space.window(height + 2 * rows, width + 2 * columns)
            self._margin = rows, columns
        window = self._friction.window
        load = self._friction.traction[:, *window].astype(np.float32)
        self._shift = _shifted(self._skin.space, window, load, self._margin)

    def material(self, frame: float, points: Floats) -> Floats:
        """Return where the skin was at the press that lies at points now, whatever the frame."""
        assert self._place is not None  # it has gone somewhere
        return _material(self._space, self._shift, self._place, points)


class _Slide:
    """One body that goes on, in steps that are small against what full sliding takes, and where it slips."""

    def __init__(self, friction: Friction, skin: Elastic, limit: Floats) -> None:
        self.onset = np.full(limit.shape, np.nan)
        self._friction, self._limit, self._places = friction, limit, skin.grid_places
        self._pressed = skin.grid_places[:, limit > 0]
        self._far = float(skin.space.tangential(np.stack([limit, np.zeros_like(limit)]))[0].max())
        self._place: Floats | None = None
        # The travel, and the square of what the traction lacks of its limit: now, and a step ago.
        self._now, self._before = (0.0, limit**2), (0.0, limit**2)

    def go(self, step: Floats) -> None:
        """Go on from one frame to the next."""
        start = np.zeros_like(step) if self._place is None else self._place
        self._place = start + step
        moved = float(np.hypot(*_drive(step, self._pressed)).max(initial=0.0))
        count = min(max(1, math.ceil(_STEPS * moved / self._far)), _STEPS) if self._far > 0 else 1
        for number in range(count if step.any() else 0):
            slips = self._friction.move(_drive(start + (number + 1) / count * step, self._places))
            travel = self._now[0] + math.hypot(*step) / count
            self._note(slips & np.isnan(self.onset), travel)
            lacking = (self._limit - np.hypot(*self._friction.traction)) ** 2
            self._before, self._now = self._now, (travel, lacking)

    def _note(self, new: NDArray[np.bool_], travel: float) -> None:
        """Note when points broke loose in a step that ends at a travel."""
        (before, lacked), (now, lacks) = self._before, self._now
        falls = np.maximum(lacked[new] - lacks[new], 0.0)
        middle = np.full_like(falls, (travel - now) / 2)
        more = np.divide(lacks[new] * (now - before), falls, out=middle, where=falls > 0)
        self.onset[new] = np.minimum(now + more, travel)


def _shifted(space: HalfSpace, window: Window, load: NDArray[np.float32], margin: tuple[int, int]) -> Floats:
    """Return how far traction in a window shifts the surface of the grid, grown by a margin, (2, ...), mm."""
    rows, columns = (size + 2 * more for size, more in zip(space.shape, margin, strict=True))
    across, along = (
        slice(part.start + more, part.stop + more) for part, more in zip(window, margin, strict=True)
    )
    return space.window(rows, columns, (across, along)).tangential(load)


def _material(space: HalfSpace, shift: Floats, place: Floats, points: Floats) -> Floats:
    """Return where the skin was that lies at points; the traction's shift is that of the object's frame."""
    from scipy.ndimage import map_coordinates

    at = _on_object(place, points)
    rows, columns = space.shape
    along_x, along_y = space.pixel_size
    index = np.stack([(rows - 1) / 2 - at[1] / along_y, at[0] / along_x + (columns - 1) / 2])
    shifted = [map_coordinates(part, index, order=1, mode="nearest") for part in shift]
    return _behind(place, at, _drive(place, at) - np.stack(shifted))


def _margin(skin: Elastic, path: Floats) -> tuple[int, int]:
    """Return by how many rows and columns the grid must grow to hold the places that pixels see."""
    corners = skin.places[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    at = np.concatenate([_on_object(place, corners) for place in np.unique(path, axis=0)], axis=1)
    far_x, far_y = np.abs(at).max(axis=1)
    (rows, columns), (along_x, along_y) = skin.space.shape, skin.space.pixel_size
    return max(0, math.ceil(far_y / along_y - rows / 2)), max(0, math.ceil(far_x / along_x - columns / 2))


def _drive(place: Floats, at: Floats) -> Floats:
    """Return how far points of the object have moved, (2, ...), mm, in the linear theory of small angles."""
    if len(place) == 1:
        return np.stack([place[0] * at[1], -place[0] * at[0]])
    return np.broadcast_to(-place.reshape(2, *[1] * (at.ndim - 1)), at.shape)


def _on_object(place: Floats, points: Floats) -> Floats:
    """Return the points of the object, by their places at the press, that now lie at points, (2, ...)."""
    if len(place) == 1:
        return _as_plane((points[0] + 1j * points[1]) * np.exp(1j * place[0]))
    return points + place.reshape(2, *[1] * (points.ndim - 1))


def _behind(place: Floats, at: Floats, lag: Floats) -> Floats:
    """Return where the skin was at the press over which points of the object are ahead by a lag."""
    if len(place) != 1:
        return at + lag
    point, ahead = at[0] + 1j * at[1], lag[0] + 1j * lag[1]
    share = np.divide(ahead, point, out=np.zeros_like(point), where=point != 0)
    return _as_plane(np.where(point != 0, point * (1 + share.real) * np.exp(1j * share.imag), ahead))


def _as_plane(number: NDArray[np.complex128]) -> Floats:
    return np.stack([number.real, number.imag])
