"""The motion of an object along the frames of an endless rotation."""

from __future__ import annotations

import itertools
import math
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import on_host
from mirrorskin.engine.base.frames import as_frames
from mirrorskin.engine.base.running import Run
from mirrorskin.engine.integration import integrate
from mirrorskin.engine.pose.fit import BlockEquations, PairFit, complement
from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.engine.pose.motion import STILL, Motion
from mirrorskin.engine.pose.pose import IDENTITY, Pose, pose_of
from mirrorskin.engine.pose.tracker import MOST_KEYS
from mirrorskin.engine.rotation.moving_normals import MovingNormals
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.scale import make_scale
from mirrorskin.io import InputError, pixel_axes
from mirrorskin.io.base.arguments import check_number, check_pixel_size
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.io.base.types import body_axes
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.skin.pose import BLOCK, FEWEST, NO_LIMIT
from mirrorskin.kernels.skin.turn_pose import LIGHT, NUMBERS

Floats = NDArray[np.float32]

_SIDE = 100  # least pixels along the shorter side of averaged frames
_MIN_COMMON = 0.6  # share of the key's pixels below which another key is taken
_MAX_STEPS, _EXACT = 8, 0.5  # largest number of steps of a frame; error that they may leave, sigmas
_MIN_KEPT = 0.5  # share of the pixels that are not outliers
_OUTLIER, _LOST = 30.0, 4.0  # limits of the chi square of a pixel and of a frame, in units of the key's
_PASSES = 2  # of the first turn: without and with the light of its frames
_STILL = 6.0  # largest motion in the first turn, sigmas
_HEIGHT_PASSES = 2  # of a key: its heights decide where frames show its pixels
_RETURN = 0.1  # additional share that an earlier key must have to be taken again
_STRIDE = 4  # pixel step of the coarse fit
_CLOSE = 3.0  # error, sigmas, from which outliers are left out
_ROWS, _COLUMNS = np.triu_indices(6)


class TurnTracker(ThreadSafe):
    """Estimates the motion of an object in each frame of an endless rotation of the body.

    The first turn gives the normals of the object and, integrated, its shape: the key. Each later frame shows
    the zenith of each normal relative to the body's axis in that frame; from the motion predicted by the last
    two frames, Gauss-Newton steps on the differences give the motion. The light of a frame is a seventh
    unknown. So a pose has the time of its frame, whereas normals of a moving object, from a window of a turn,
    are those of a mean position, and wrong by a multiple of the motion.

    The object must be at rest in the first turn, and may move in all others. If a frame shares few pixels
    with the key, the frames of the last turn, moved back, become the key, or an earlier key is taken again.
    Errors increase with the number of keys, not of frames. A turn shows no motion along z: it is
    undetermined, and taken as none.

    Parameters
    ----------
    normals : Normals
        With ``tilt``, radians, ``zenith_gain``, ``zenith_offset`` and ``window_frames``, the number of frames
        of a turn; ``dark`` and ``bright`` limit the linear range.
    pixel_size : float or (float, float)
        Millimetres along x and y.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Attributes
    ----------
    keys : int
        Number of turns that became keys.

    Raises
    ------
    mirrorskin.io.InputError
        An option is missing, or is not supported.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> x, y = np.meshgrid(np.arange(-30, 31) * 0.1, np.arange(20, -21, -1) * 0.1)
    >>> tilt = 0.05
    >>> def frame(phase, at):
    ...     p, q = -0.1 * (x - at) + 0.1 * np.cos(2 * (x - at)), -0.1 * y + 0.1 * np.cos(2 * y)
    ...     axis = -np.sin(tilt) * np.cos(phase), -np.sin(tilt) * np.sin(phase), np.cos(tilt)
    ...     cosine = (axis[2] - p * axis[0] - q * axis[1]) / np.sqrt(1 + p * p + q * q)
    ...     return (20 + 300 * np.arccos(cosine)).round().astype(np.uint8)
    >>> turn = engine.Normals(tilt=tilt, zenith_gain=300, zenith_offset=20, window_frames=8)
    >>> tracker = engine.pose.TurnTracker(turn, pixel_size=0.1)
    >>> for number in range(11):
    ...     phase, at = number * np.pi / 4, 0.05 * max(0, number - 8)
    ...     pose = tracker.push(frame(phase, at), phase=phase)
    >>> round(float(pose.translation[0]), 2)
    0.1
    """

    takes, motions = ("picture", "position"), ("axial",)  # of the updates of a loop

    def __init__(
        self, normals: Normals, pixel_size: ArrayLike, *, device: str | Device | None = None
    ) -> None:
        self.keys: int = 0
        self._tilt = _check(normals)
        self._normals, self._pixel_size = normals, check_pixel_size(pixel_size)
        self._device = open_device(device)
        self._window: _Window | None = None
        self._key: _Key | None = None
        self._earlier: list[_Key] = []
        self._frames = 0
        self._motion, self._step = STILL, STILL  # from the first frame to the last one, and before that one

    def precompile(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Compile what frames of a shape and type need, with another tracker, so that none is delayed."""
        trial = TurnTracker(self._normals, self._pixel_size, device=self._device)
        count = _turn_of(self._normals) + 2
        scale = make_scale(self._normals.zenith_gain, self._normals.zenith_offset, None, None, shape).planes
        row, column = np.indices(shape)
        slopes = 0.2 + 0.1 * np.stack([np.cos(0.1 * column), np.sin(0.07 * row)])
        normals = (
            np.stack([*-slopes, np.ones(shape)], axis=-1) / np.sqrt(1 + np.sum(slopes**2, axis=0))[..., None]
        )
        top = np.iinfo(dtype).max - 1 if dtype.kind == "u" else np.inf
        with suppress(InputError):
            for phase in 2 * np.pi * np.arange(count) / (count - 2):
                counts = scale[0] + np.arccos(normals @ body_axes([phase], self._tilt)[0]) / scale[1]
                trial.push(np.clip(np.nan_to_num(counts), 1, top).astype(dtype), phase)

    def push(self, frame: ArrayLike, phase: float) -> Pose | None:
        """Return the motion from the first frame to this one; None in the first turn and one more frame.

        Parameters
        ----------
        frame : array_like, (H, W)
            uint8, uint16 or float32; all of one size and type.
        phase : float
            Radians.

        Raises
        ------
        mirrorskin.io.InputError
            A frame of another size or type, or in which the object is not found: it is ignored. Or a first
            turn in which the object moved, or that determines no normals: then another one begins.
        """
        values = on_host(as_frames("frame", frame))
        alpha = float(check_number("phase", phase, "rad"))
        if not math.isfinite(alpha):
            raise InputError(f"phase is {alpha}: a finite angle is needed")
        if self._window is None:
            self._window = _Window(self._normals, self._tilt, values, self._pixel_size, self._device)
        window = self._window
        zeniths, axis = window.zeniths_of(values), body_axes([alpha], self._tilt)[0]
        if self._key is None:
            window.keep(zeniths, axis, STILL)
            self._frames += 1
            return self._first_turn() if self._frames == len(window) else None
        window.show(zeniths)
        found = next(filter(None, (self._key.follow(axis, at) for at in self._expected())), None)
        if found is None:
            self._step = STILL
            raise InputError(
                f"frame {self._frames}: the object is not found near its last place: it has moved too far, or"
                " lost contact. It is looked for there in the next frames"
            )
        pose = self._key.pose_of(found)
        self._step, self._motion = self._motion.inverse().then(pose.motion), pose.motion
        window.keep(zeniths, axis, pose.motion, found.light)
        self._frames += 1
        if self._key.share(found) < _MIN_COMMON:
            self._change_key(axis, found, pose)
        return pose

    def _expected(self) -> tuple[Motion, Motion]:
        """Return the motions to the next frame that are tried: like the last one, and none."""
        return self._motion.then(self._step), self._motion

    def _first_turn(self) -> Pose:
        """Take the first turn as the key, and return the pose of its last frame."""
        window = self._window
        assert window is not None
        self._frames = 0
        for _ in range(_PASSES):
            key = _Key.of(window, IDENTITY)
            frames = [
                key.follow(window.show_kept(number), STILL, number == 0) for number in range(len(window))
            ]
            window.lights.extend(found.light if found else 0.0 for found in frames)
        found = frames[-1]
        moved = max((key.sigmas(found) if found else math.inf) for found in frames)
        if found is None or moved > _STILL:
            raise InputError(
                "the frames of the first turn do not fit together: hold the object still until there is a"
                " pose, or press on more relief"
            )
        self._frames, self.keys, self._key = len(window), 1, key
        return key.pose_of(found)

    def _change_key(self, axis: Doubles, found: _Found, pose: Pose) -> None:
        """Take an earlier key that shares more pixels, or the last turn."""
        assert self._window is not None
        assert self._key is not None
        for key in self._earlier:
            there = key.follow(axis, pose.motion)
            if there is not None and key.share(there) > _MIN_COMMON + _RETURN:
                break
        else:
            try:
                key = _Key.of(self._window, pose, found.motion.apply(self._key.fit.second.points))
                there = key.follow(self._window.show_kept(0), self._window.motions[0])
            except InputError:
                there = None
            if there is None:  # the present one is used as long as it is shared
                return
            self.keys += 1
        others = [other for other in (*self._earlier, self._key) if other is not key]
        self._earlier = others[-MOST_KEYS:]
        self._key = key


class _Window:
    """The frames of the last turn and the one before: averaged zeniths, axis, motion and light of each.

    They are in the order of time. A key is made of all but the first one, which shows what the key
    determines: the errors of the others are those of the key, too.
    """

    motions: deque[Motion]  # from the first frame
    lights: deque[float]  # shares by which they are stronger

    def __init__(
        self,
        normals: Normals,
        tilt: float,
        frame: NDArray[Any],
        pixel_size: tuple[float, float],
        device: Device,
    ) -> None:
        if frame.ndim != 2:
            raise InputError(f"frame has shape {frame.shape}: push one frame, (H, W), at a time")
        self.length, self.device = _turn_of(normals), device
        self._full, self._dtype = frame.shape, frame.dtype
        rows, columns = frame.shape
        self._size = size = max(1, min(rows, columns) // _SIDE)
        self._shape = rows // size, columns // size
        x, y = pixel_axes((rows, columns), pixel_size)
        lines = [
            line[: size * count].reshape(count, size).mean(axis=1)
            for line, count in zip((y, x), self._shape, strict=True)
        ]
        self._y, self._x = lines
        self._pixel = pixel_size[0] * size, pixel_size[1] * size
        levels = normals.zenith_gain, normals.zenith_offset, normals.dark, normals.bright
        self._offset, self._per_count, *_ = make_scale(*levels, (rows, columns)).planes.astype(np.float32)
        ends = np.iinfo(frame.dtype) if frame.dtype.kind == "u" else None  # counts there are clipped
        self._low, self._high = (
            _limit(level, clipped)
            for level, clipped in (
                (normals.dark, -np.inf if ends is None else ends.min + 1),
                (normals.bright, np.inf if ends is None else ends.max - 1),
            )
        )
        dark = 0.0 if normals.dark is None else np.asarray(normals.dark, np.float64)
        self.base = float(np.nanmean((self._offset - dark) * self._per_count))
        self._zeniths: Floats = np.empty(frame.shape, np.float32)
        self._outside, self._above = (np.empty(frame.shape, np.bool_) for _ in range(2))
        self._kept = deque[Floats](maxlen=self.length + 1)
        self._axes = deque[Doubles](maxlen=self.length + 1)
        self.motions, self.lights = (
            deque[Motion](maxlen=self.length + 1),
            deque[float](maxlen=self.length + 1),
        )
        self._flat_limit = math.sin(tilt) ** 2
        self.shown = device.array("zeniths", self._shape, np.float32)

    @property
    def grid(self) -> tuple[float, float, float, float]:
        """Place of the first averaged pixel, x and y, and the size of one, mm."""
        return float(self._x[0]), float(self._y[0]), *self._pixel

    def zeniths_of(self, frame: NDArray[Any]) -> Floats:
        """Return the averaged zeniths of a frame; NaN where one of them is not known."""
        if frame.shape != self._full or frame.dtype != self._dtype:
            raise InputError(
                f"frame is {frame.dtype} {frame.shape}: earlier ones were {self._dtype} {self._full}"
            )
        zeniths, outside, above = self._zeniths, self._outside, self._above
        np.subtract(frame, self._offset, out=zeniths)
        np.multiply(zeniths, self._per_count, out=zeniths)
        np.less(frame, self._low, out=outside)
        np.greater(frame, self._high, out=above)
        np.logical_or(outside, above, out=outside)
        np.copyto(zeniths, np.nan, where=outside)
        rows, columns = self._shape
        part: Floats = zeniths[: rows * self._size, : columns * self._size]
        return np.asarray(cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)

    def keep(self, zeniths: Floats, axis: Doubles, motion: Motion, light: float = 0.0) -> None:
        """Add a frame, which replaces the oldest one."""
        self._kept.append(zeniths)
        self._axes.append(axis)
        self.motions.append(motion)
        self.lights.append(light)

    def __len__(self) -> int:
        return self.length + 1

    def show(self, zeniths: Floats) -> None:
        """Copy the zeniths of a frame to the device."""
        self.shown.write(zeniths)

    def show_kept(self, number: int) -> Doubles:
        """Copy those of a frame of the window to the device, and return its axis."""
        self.show(self._kept[number])
        return self._axes[number]

    def map_at(self, reference: Motion) -> PoseMap:
        """Return normals and heights where the object is after a motion, from all frames."""
        back = reference.inverse()
        kept, axes, motions, lights = (
            [*each][1:] for each in (self._kept, self._axes, self.motions, self.lights)
        )
        motions = [back.then(motion) for motion in motions]
        axes = [axis @ motion.turn for axis, motion in zip(axes, motions, strict=True)]
        points = np.dstack([*np.meshgrid(self._x, self._y), np.zeros(self._shape)])
        frames = np.empty((self.length, *self._shape), np.float32)
        moved = any(motion is not STILL for motion in self.motions)
        for _ in range(_HEIGHT_PASSES if moved else 1):
            for frame, zeniths, motion in zip(frames, kept, motions, strict=True):
                place = motion.apply(points)
                cv2.remap(
                    zeniths,
                    ((place[..., 0] - self._x[0]) / self._pixel[0]).astype(np.float32),
                    ((self._y[0] - place[..., 1]) / self._pixel[1]).astype(np.float32),
                    cv2.INTER_LINEAR,
                    dst=frame,
                    borderMode=cv2.BORDER_CONSTANT,
                    borderValue=math.nan,
                )
            frames += self.base
            frames /= 1 + np.array(lights, np.float32)[:, np.newaxis, np.newaxis]
            frames -= self.base
            run = Run(MovingNormals(zenith_gain=1.0, longest=self.length, device=self.device))
            run.push(frames, pose=np.array(axes))
            turn = run.preview(0.0)
            surface = integrate(turn, pixel_size=self._pixel, device=self.device)
            points[..., 2] = np.nan_to_num(surface.height)
        map_ = PoseMap.of(turn.assign(**surface, x=self._x, y=self._y), None, self.device)
        return replace(map_, flat_limit=self._flat_limit)


class _Found(NamedTuple):
    """A motion from a key to a frame, and the equations there."""

    fit: _FrameFit
    motion: Motion
    now: BlockEquations
    light: float  # share by which it is stronger


class _FrameFit(PairFit):
    """A turn on a device, and the motion from it to the frame that its window shows."""

    def __init__(self, map_: PoseMap, window: _Window) -> None:
        super().__init__(map_, map_, window.device)
        self._window = window
        self._pose = self.device.array("pose", (NUMBERS,), np.float32, zeroed=False)
        self._of_blocks: dict[tuple[int, bool], Array] = {}

    def at(
        self, axis: Doubles, motion: Motion, unbiased: bool, step: int, limit: float, other: bool
    ) -> tuple[BlockEquations, float]:
        """Return the sums at a motion, without the part that the light of the frame explains, and that."""
        map_, window = self.second, self._window
        (rows, columns), size = map_.shape, map_.extent.size
        blocks = -(-rows // (BLOCK * step)) * -(-columns // (BLOCK * step))
        if (step, unbiased) not in self._of_blocks:
            shape = blocks, LIGHT[-1 if unbiased else 3]
            self._of_blocks[step, unbiased] = self.device.array("sums", shape, np.float32, zeroed=False)
        sums = self._of_blocks[step, unbiased]
        numbers = [*motion.turn.ravel(), *motion.shift, *map_.extent.middle, *map_.grid, *window.grid]
        numbers += [map_.flat_limit, *axis, window.length, limit, other]
        self._pose.write(np.array(numbers, np.float32))
        self.device.kernel("turn_pose", "turn_pose_equations", BESIDE=int(unbiased))(
            blocks,
            rows=rows,
            columns=columns,
            other_rows=window.shown.shape[0],
            other_columns=window.shown.shape[1],
            step=step,
            base=window.base,
            turn=map_.records,
            zeniths=window.shown,
            pose=self._pose,
            sums=sums,
            moved=36 * rows * columns // step**2,
        )
        alone, light = _without_light(sums.read())
        return BlockEquations(alone, size), light


@dataclass(slots=True)
class _Key:
    """A turn with which frames are compared."""

    fit: _FrameFit
    pose: Pose  # from the first frame
    free: Doubles | None = None  # directions that are not determined
    directions: Doubles = field(default_factory=lambda: np.eye(6))  # the others
    pixels: float = 0.0  # that the first frame shares
    typical: float = 1.0  # its chi square

    @classmethod
    def of(cls, window: _Window, pose: Pose, surface: Doubles | None = None) -> _Key:
        """Return the last turn as a key at the place of a pose, at the height of known points, (n, 3)."""
        map_ = window.map_at(pose.motion)
        if surface is not None:
            _lift(map_, surface)
        pose = replace(pose, undetermined=IDENTITY.undetermined)  # z, which is taken as constant
        _ = map_.extent  # InputError for one without contents
        return cls(_FrameFit(map_, window), pose)

    def share(self, found: _Found) -> float:
        """Return the share of the pixels that a frame shares."""
        return found.now.pixels / self.pixels

    def sigmas(self, found: _Found) -> float:
        """Return how far a frame is from this key, in standard deviations, in determined directions."""
        change, extent = found.motion, self.fit.second.extent
        step = np.concatenate([change.vector * extent.size, change.apply(extent.middle) - extent.middle])
        step = self.directions @ (self.directions.T @ step)
        return math.sqrt(step @ found.now.normal_matrix @ step / max(found.now.chi_square, 1.0))

    def follow(self, axis: Doubles, expected: Motion, other: bool = True) -> _Found | None:
        """Return the motion from this key to the frame that is shown, near one from the first frame.

        ``other`` says that the frame is not one of the key's.
        """
        motion, limit, shared = self.pose.motion.inverse().then(expected), NO_LIMIT, 0.0
        last = math.inf
        for _ in range(_MAX_STEPS):
            stride = 1 if self.free is None or limit < NO_LIMIT else _STRIDE
            now, light = self.fit.at(axis, motion, self.free is None, stride, limit, other)
            if now.pixels < max(FEWEST, _MIN_KEPT * shared):
                return None
            if self.free is None:
                self._start(now)
            motion, moved, step = self.fit.step(motion, now, self.directions)
            if limit < NO_LIMIT and (moved < _EXACT or last / 2 < moved < 1):
                return self._accepted(_Found(self.fit, motion, now.after(step), light))
            last = moved
            if moved < _CLOSE:
                limit, shared = _OUTLIER * max(self.typical, now.chi_square), now.pixels * stride**2
        return None

    def _start(self, now: BlockEquations) -> None:
        """Keep which directions are determined."""
        self.free = now.free()
        if self.free.shape[1] == 6:
            raise InputError("a turn determines no motion: the surface is too plain for its noise")
        self.directions = complement(self.free)

    def _accepted(self, found: _Found) -> _Found | None:
        """Return a motion, unless the frame differs from the key by much more than the first one."""
        if not self.pixels:
            self.pixels, self.typical = found.now.pixels, max(found.now.chi_square, 1e-3)
        return found if found.now.chi_square < _LOST * self.typical else None

    def pose_of(self, found: _Found) -> Pose:
        """Return the motion from the first frame."""
        assert self.free is not None
        return self.pose.then(pose_of(found.fit, found.motion, found.now, self.free))


def _lift(map_: PoseMap, surface: Doubles) -> None:
    """Add to the heights of a map, whose offset is unknown, the median difference to points above it."""
    records, (x, y, step_x, step_y) = map_.records.read(), map_.grid
    places = np.rint([(y - surface[:, 1]) / step_y, (surface[:, 0] - x) / step_x]).astype(np.intp)
    inside = np.all((places >= 0) & (places < np.array([map_.shape]).T), axis=0)
    lift = np.nanmedian(surface[inside, 2] - records[(*places[:, inside], 3)])
    records[..., 3] += lift
    map_.records.write(records)


def _limit(level: ArrayLike | None, clipped: float) -> Floats:
    """Return a limit of counts, of the linear range or of those that are not clipped."""
    if level is None:
        return np.asarray(clipped, np.float32)
    limit = np.maximum if clipped < 2 else np.minimum
    return np.asarray(limit(np.nan_to_num(np.asarray(level, np.float64), nan=clipped), clipped), np.float32)


def _without_light(sums: Floats) -> tuple[Floats, float]:
    """Return sums as of `PARTS` for the motion alone, and the share by which the light is stronger."""
    values = sums.astype(np.float64)
    upper, right, chi = values[:, :21], values[:, 21:27], values[:, 27]
    with_light, light, of_light = (values[:, a:b] for a, b in itertools.pairwise(LIGHT[:4]))
    share = with_light.sum(axis=0) / max(float(light.sum()), 1e-12)
    change = of_light.sum() / max(float(light.sum()), 1e-12)
    crossed = with_light[:, _ROWS] * share[_COLUMNS] + with_light[:, _COLUMNS] * share[_ROWS]
    upper -= crossed / 2
    right -= change * with_light + (of_light - change * light) * share
    chi -= (2 * change * of_light - change**2 * light)[:, 0]
    parts = [values[:, :31]]
    if sums.shape[1] > LIGHT[3]:
        beside = values[:, LIGHT[4] :].sum(axis=0) / max(float(light.sum()), 1e-12)
        crossed = with_light[:, :, np.newaxis] * beside
        parts.append(values[:, LIGHT[3] : LIGHT[4]] - crossed.reshape(len(values), 36))
    return np.concatenate(parts, axis=1).astype(np.float32), float(change)


def _check(normals: Normals) -> float:
    """Return the tilt, or raise InputError for options that are missing, or not supported."""
    _turn_of(normals)
    if normals.response is not None:
        raise InputError(
            "a sensor with a calibrated response cannot be tracked by frames: leave response out"
        )
    if normals.tilt is None or isinstance(normals.tilt, str):
        raise InputError("tilt is missing: give the half-angle of the precession, such as 2.5deg")
    if normals.zenith_gain is None:
        raise InputError("zenith_gain is missing: give the counts per radian")
    return float(np.asarray(normals.tilt))


def _turn_of(normals: Normals) -> int:
    """Return the number of frames of a turn."""
    if normals.window_frames is None:
        raise InputError("window_frames is missing: give the number of frames of a turn")
    return normals.window_frames
