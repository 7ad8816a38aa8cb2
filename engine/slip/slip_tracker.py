"""Slip along a stream of frames, from windows that are followed one by one."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from mirrorskin.engine.base.device_arrays import AnyArray, on_host
from mirrorskin.engine.base.frames import as_frames, check_frames
from mirrorskin.engine.base.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.slip.displacement import MAPS, Texture, check_noise, check_windows
from mirrorskin.engine.slip.search import read_contact
from mirrorskin.engine.slip.tracking import Level
from mirrorskin.engine.slip.windows import Found, Motion, Windows
from mirrorskin.io import InputError, Map, Result, pixel_axes
from mirrorskin.io.base.arguments import check_count, check_number, check_pixel_size, checked
from mirrorskin.io.base.threads import ThreadSafe, locked
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.model.maps import SlipStatus, status_of
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.skin.slip import (
    EXCEEDED,
    FIND_SLIP,
    FIXED,
    FLAGS,
    FOLLOWED,
    KINK,
    LAST,
    LEARN,
    LEARNED,
    MEASURE,
    MEMORY,
    ONSET,
    PARTIAL,
    SETTLED,
    SLIPPED,
    TOUCHED,
)

Mask = NDArray[np.bool_]
Places = NDArray[np.complex128]
"""Places or displacements x + i y, mm."""

_DECLARATIONS = {
    "displacement_sigma": MAPS["displacement_sigma"],
    "displacement_covariance": Map(
        "variances of the displacement along x and y, and their covariance",
        "mm^2",
        components=("xx", "yy", "xy"),
        overview=False,
    ),
    "status": status_of(SlipStatus),
    **{
        name: Map(f"{caption} of the skin that sticks, since the contact started", unit, "float64", "none")
        for name, caption, unit in (
            ("angle", "rotation, counter-clockwise,", "rad"),
            ("centre_x", "centre of the rotation along x,", "mm"),
            ("centre_y", "centre of the rotation along y,", "mm"),
            ("shift_x", "displacement along x, at the middle of the contact,", "mm"),
            ("shift_y", "displacement along y, at the middle of the contact,", "mm"),
        )
    },
}
_WINDOWS = 200  # about as many are followed in the first contact
_MOST_WINDOWS = 800  # in the whole picture
_MARGIN = 2  # windows around the contact that are followed, too
_TOUCHES, _LEAVES = 0.5, 0.25  # share of a window in contact, above which it touches; below which no longer
_SHRUNK = 0.7  # share of the windows followed so far, below which only those of a smaller contact are
_MIN_COMMON = 0.6  # share of the windows found with the key, below which a frame becomes the key
_MIN_MATCHED = 0.3  # minimum share in a frame that becomes the key
_LEAST_ANGLE = 3.0  # standard deviations of the angle, from which the rotation has a centre
_CANCELS = 0.75  # share of the noise of a key that cancels where its windows overlap those of the last one
_UNKNOWN = complex(np.nan, np.nan)  # place or displacement of a window
_PASSES = 5  # of the search for the points of the skin that are at the windows of a new key


class SlipTracker(ThreadSafe):
    """Finds where the skin sticks to an object, and where it starts to slip, in each frame of a stream.

    Windows of the first frame, in and around the contact, are followed one by one. The skin that sticks moves
    like a rigid body, with the object, whose motion need not be known. A window departs from it significantly
    when it slips; see the documentation, "Slip". `SlipOnset` is more accurate, but takes longer, and needs
    the motion of the body.

    The contact may change. A window that enters it sticks to the object from then on; one that leaves it
    neither sticks nor has slipped. A contact that is lost and found again starts anew.

    The first frame is the key. If windows are lost, as they leave the picture, a later frame becomes the key,
    and the errors up to then are added.

    Parameters
    ----------
    contact : Result, mapping, xarray.Dataset, path or array_like, (H, W), optional
        Where the skin touches the object, as of `SlipOnset`. By default nothing touches until `push` is given
        a contact.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the contact.
    window_size : int
        Side of a window, pixels. Larger ones have less noise, but are biased more where the movement bends.
    window_step : int
        Distance between the centres of adjacent windows, pixels; by default at least half a window, and such
        that about 200 windows cover the contact and its surroundings, and at most 800 the picture. Only
        windows in and around the contact take time.
    noise : float, optional
        Standard deviation of a sample, counts; by default estimated from the residuals, window by window.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Attributes
    ----------
    keys : int
        Number of frames that became keys.

    Raises
    ------
    mirrorskin.io.InputError
        The pixel size is unknown, or a number is not possible.

    Examples
    --------
    >>> import cv2
    >>> from mirrorskin import engine
    >>> texture = np.random.default_rng(1).normal(100, 20, (60, 80))
    >>> texture = cv2.GaussianBlur(texture, (0, 0), 1.5).astype(np.float32)
    >>> tracker = engine.slip.SlipTracker(np.ones((60, 80)), pixel_size=0.1, noise=0.1)
    >>> for k in range(3):  # the skin sticks to the object
    ...     found = tracker.push(np.roll(texture, -k, axis=1))
    >>> [round(float(part), 3) for part in found.displacement[2, 3]], int(found.status[2, 3])
    ([-0.2, 0.0], 2)
    >>> round(found.shift_x, 3), float(found.stick_ratio[0])
    (-0.2, 1.0)
    """

    @checked(window_size=check_count, window_step=check_count, noise=check_number)
    def __init__(
        self,
        contact: Maps | None = None,
        pixel_size: ArrayLike | None = None,
        *,
        window_size: int = 12,
        window_step: int | None = None,
        noise: float | None = None,
        device: str | Device | None = None,
    ) -> None:
        check_noise(noise)
        self.keys: int = 0
        self._contact = None if contact is None else as_result(contact, "contact", quantity="contact")
        if self._contact is None:
            self._size = check_pixel_size(pixel_size)
        else:
            self._size = pixel_size_of(self._contact, "contact", pixel_size)
        self._window, self._chosen_step, self._noise = window_size, window_step, noise
        self._device = open_device(device).with_new_queue()
        self._frames = 0
        self._windows: Windows | None = None

    takes = "picture", "contact"  # of the updates of a loop

    def precompile(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Compile what frames of a shape and type need, with another tracker, so that none is delayed."""
        noise = 1.0 if self._noise is None else self._noise
        options: dict[str, Any] = {"window_step": self._chosen_step, "noise": noise, "device": self._device}
        trial = SlipTracker(np.ones(shape), self._size, window_size=self._window, **options)
        texture = np.random.default_rng(0).integers(0, 256, shape).astype(dtype)
        with suppress(InputError):  # refused when the first frame is
            for shift in range(3):
                trial.push(np.roll(texture, shift, axis=1))

    def push(self, frame: AnyArray, contact: Maps | None = None) -> Result:
        """Return displacement and slip in the next frame.

        Parameters
        ----------
        frame : ndarray or device array, (H, W), uint8, uint16 or float32
        contact : Result, mapping, xarray.Dataset, path or array_like, (H, W), optional
            Where the skin touches the object in this frame; it may be nowhere. By default as before.

        Returns
        -------
        Result
            Maps of windows all over the picture, (rows, columns), whose places are ``x`` and ``y``:

            - ``displacement``, (rows, columns, 2), since the first frame, mm; its ``displacement_sigma``, and
              ``displacement_covariance``, (rows, columns, 3). NaN where a window is not found, as it has left
              the picture or does not resemble the key, and far from the contact.
            - ``status``, codes as of `SlipOnset`, and ``contact``.
            - ``frame`` in which the slip started, from 0; -1 where the skin has not slipped.

            Numbers: ``stick_ratio``, (1,), the share of the contact that has not slipped; ``angle``,
            ``centre_x`` and ``centre_y`` of the skin that sticks, and its displacement ``shift_x`` and
            ``shift_y`` at the middle of the contact, with their standard deviations, since the contact
            started. These are NaN if less than four windows stick; a centre also if there is no significant
            rotation; the share until a contact of four windows has started.

            `mirrorskin.engine.force.find_tangential_force` takes it.

        Raises
        ------
        mirrorskin.io.InputError
            A frame of another type or shape, a contact of another shape, or a sheet without texture.
        """
        return self.submit(frame, contact)()

    def submit(self, frame: AnyArray, contact: Maps | None = None) -> Callable[[], Result]:
        """Start the work on the next frame, and return a function that waits for the result of `push`.

        Call it before the next frame is pushed or submitted. Arguments and errors are those of `push`.
        """
        frame = on_host(as_frames("frame", frame))
        windows, work = self._windows, MEASURE | FIND_SLIP
        if windows is None:
            check_frames(frame[np.newaxis], frame.dtype, frame.shape)
            self._shape, self._dtype = frame.shape, frame.dtype
            touched = self._read_contact(self._contact if contact is None else contact, contact is None)
            self._step = self._chosen_step or self._usual_step(touched)
            check_windows(self._shape, self._window, self._step)
            windows = self._take_key(frame)
            self._place_windows(windows.level)
            self._change_contact(windows, touched)
        else:
            check_frames(frame[np.newaxis], self._dtype, self._shape)
            if contact is not None:
                self._change_contact(windows, self._read_contact(contact))
            windows.follow(frame)
            self._since_key += 1
            if self._since_key & (self._since_key - 1) == 0 or self._since_key % MEMORY == 0:
                windows.submit(LEARN, self._since_key)
                windows.answer()
                self._learn(windows)
            else:
                work |= LEARN
        windows.submit(work, self._since_key, self._frames, self._started)
        return partial(self._answer, windows, frame)

    @locked
    def _answer(self, windows: Windows, frame: NDArray[Any]) -> Result:
        """Wait for the work on a frame, and return its result."""
        found = windows.answer()
        assert found is not None
        result = self._result(found)
        self._frames += 1
        # Too many windows in contact, of those that were found with this key, are lost.
        if _MIN_MATCHED * found.seen < found.matched < _MIN_COMMON * found.seen:
            with np.errstate(invalid="ignore", divide="ignore"):
                self._change_key(windows, frame)
        return result

    def _read_contact(self, contact: Maps | None, needed: bool = False) -> Mask:
        """Return where the skin touches the object."""
        touched, origin, findings = read_contact(contact, self._shape, needed)
        if touched is None:
            touched, origin = np.zeros(self._shape, bool), "none"
        self._process = {"contact": origin, **findings}
        return touched

    def _usual_step(self, touched: Mask) -> int:
        """Return the step of windows, pixels, for a first contact."""
        margin, area = 2 * _MARGIN * self._window, 1
        for axis, size in zip((1, 0), self._shape, strict=True):
            extent = np.flatnonzero(touched.any(axis=axis))
            area *= min(int(extent[-1] - extent[0]) + 1 + margin, size) if extent.size else size
        fewest = max(area / _WINDOWS, math.prod(self._shape) / _MOST_WINDOWS)
        return max(math.ceil(math.sqrt(fewest)), self._window // 2)

    def _take_key(self, frame: NDArray[Any]) -> Windows:
        """Let a frame be the key."""
        self.keys += 1
        self._since_key = 0
        self._windows = Windows(frame.copy(), self._window, self._step, self._size, self._device)
        self._followed = self._windows.level.usable
        return self._windows

    def _place_windows(self, level: Level) -> None:
        """Compute the places of the windows; none has moved or touches."""
        grid = level.grid
        x, y = pixel_axes(self._shape, self._size)
        rows, columns = (level.start + level.step * np.arange(nodes) for nodes in grid)
        self._x, self._y = x[0] + columns * self._size[0], y[0] - rows * self._size[1]
        self._nodes: Places = self._x + 1j * self._y[:, None]
        half = (self._window - 1) / 2
        self._corners = np.rint(rows - half).astype(int)[:, None], np.rint(columns - half).astype(int)
        self._touched, self._partial = np.zeros(grid, bool), np.ones(grid, bool)
        self._before: Places = np.zeros(grid, complex)  # displacements until the key
        self._before_covariance = np.zeros((3, *grid))
        self._covariance = np.zeros((3, *grid))  # xx, yy and xy of a displacement, by noise, mm^2
        self._started, self._middle = False, 0j

    def _change_contact(self, windows: Windows, contact: Mask) -> None:
        """Let windows enter and leave the contact, and choose those that are followed."""
        before = windows.part
        state = windows.read()
        numbers = state.view(np.float32)
        self._sums = cv2.integral(contact.view(np.uint8))
        share = self._share_in_contact(numbers[LAST : LAST + 2])
        touched = share > np.where(self._touched, _LEAVES, _TOUCHES)
        lost = self._touched & ~touched
        numbers[FIXED : FIXED + 2, lost], state[ONSET][lost] = np.nan, -1
        state[FLAGS][lost] &= ~(SETTLED | SLIPPED | EXCEEDED)
        self._touched, self._partial = touched, share < 1
        self._write(windows, state)
        near = share > 0
        if not near.any():
            self._started = False
            return
        margin, part = max(_MARGIN * self._window // self._step, 1), []
        for axis, size in zip((1, 0), near.shape, strict=True):
            places = np.flatnonzero(near.any(axis=axis))
            part.append(slice(max(int(places[0]) - margin, 0), min(int(places[-1]) + 1 + margin, size)))
        rows, columns = part
        both = tuple(
            slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in zip(part, before, strict=True)
        )
        if self._frames and touched[rows, columns].size > _SHRUNK * touched[before].size:
            rows, columns = both
        windows.choose((rows, columns))

    def _write(self, windows: Windows, state: NDArray[np.int32]) -> None:
        """Write a state of the windows, with the present contact and texture."""
        flags = state[FLAGS]
        flags &= ~(TOUCHED | PARTIAL | FOLLOWED)
        flags |= TOUCHED * self._touched + PARTIAL * self._partial + FOLLOWED * self._followed
        windows.write(state)

    def _share_in_contact(self, moved: NDArray[np.floating]) -> Doubles:
        """Return the share of each window in contact, if displaced by pixels to the right and down."""
        right, down = np.rint(moved).astype(int)
        top, left = self._corners[0] + down, self._corners[1] + right
        (top, bottom), (left, right) = (
            [np.clip(part, 0, size) for part in (first, first + self._window)]
            for first, size in zip((top, left), self._shape, strict=True)
        )
        sums = self._sums
        inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        return np.asarray(inside / self._window**2)

    def _learn(self, windows: Windows) -> None:
        """Evaluate the texture, given the noise of the frames until now."""
        state = windows.read()
        variance = state.view(np.float32)[LEARNED].astype(np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            texture = Texture.of(windows.level, variance, self._noise)
        texture.refuse_clear("the frames")
        covariance, (x, y) = texture.covariance, self._size
        self._variance, self._followed = texture.variance, texture.textured & texture.usable
        self._covariance = np.stack(
            [covariance[..., 0, 0] * x**2, covariance[..., 1, 1] * y**2, -covariance[..., 0, 1] * x * y]
        )
        self._write(windows, state)
        before = np.stack([self._before.real, self._before.imag])
        windows.know(self._variance[np.newaxis], self._covariance, before, self._before_covariance)

    def _change_key(self, windows: Windows, frame: NDArray[Any]) -> None:
        """Let the newest frame be the key: its windows show skin that was between those of the last key.

        All windows of the picture are followed to it. Their displacement until now is interpolated linearly.
        The noise of this frame is in it, and in the next displacements with the opposite sign, so that most
        of it cancels where windows overlap. Where the displacement may bend by more than its noise between
        the windows, it is lost.
        """
        part, state = windows.part, windows.read()
        moved, bending = windows.measure_all(frame, self._since_key)
        found = np.isfinite(moved)
        shape = found.shape
        pixels = -moved.imag / self._size[1], moved.real / self._size[0]
        steps = np.stack([fill_with_nearest(values) for values in pixels])
        grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij")).astype(np.float64)
        place = grid
        for _ in range(_PASSES):
            place = grid - _between(steps, place) / self._step
        last = np.array(shape)[:, None, None] - 1
        inside = np.all((place >= 0) & (place <= last), axis=0)
        # Variance of a mean of adjacent windows, whose errors are correlated as far as they overlap.
        share, ratio = place - np.floor(place), self._step / self._window
        squares = np.prod(1 - 2 * min(ratio, 1.0) * share * (1 - share), axis=0)
        overlap = share * np.maximum(1 - (1 - share) * ratio, 0)
        overlap += (1 - share) * np.maximum(1 - share * ratio, 0)
        weight = np.maximum(squares - _CANCELS * np.prod(overlap, axis=0), 0.0)
        bending = bending * (ratio**4 * np.where(self._partial, 1.0, KINK))
        inside = inside & np.all(_between(bending - self._covariance[:2], place) < 0, axis=0)
        covariance = self._before_covariance.copy()
        covariance[:2] += bending
        covariance = _between(covariance, place) + weight * self._covariance
        found &= np.isfinite(self._before)
        self._before, known = self._interpolated(moved + self._before, found, place, inside)
        self._before_covariance = np.where(known, covariance, 0.0)
        numbers = state.view(np.float32)
        fixed = self._nodes + numbers[FIXED] + 1j * numbers[FIXED + 1]
        fixed, _ = self._interpolated(fixed, np.isfinite(fixed) & found, place, inside)
        nearest = tuple(
            np.clip(np.rint(axis).astype(int), 0, size - 1) for axis, size in zip(place, shape, strict=True)
        )
        inside_contact = self._share_in_contact(np.zeros((2, *shape)))
        self._touched, self._partial = inside_contact > _TOUCHES, inside_contact < 1
        entered = np.isfinite(fixed) & self._touched
        windows = self._take_key(frame)
        windows.choose(part)
        state, new = state[:, *nearest], windows.read()
        state[FLAGS] = np.where(entered, state[FLAGS] & (SETTLED | SLIPPED | EXCEEDED), 0)
        state[ONSET] = np.where(entered, state[ONSET], -1)
        moved = np.where(entered, fixed - self._nodes, np.nan)
        state[FIXED : FIXED + 2] = np.stack([moved.real, moved.imag]).astype(np.float32).view(np.int32)
        state[LEARNED], state[LAST:] = new[LEARNED], new[LAST:]
        self._write(windows, state)

    @staticmethod
    def _interpolated(values: Places, known: Mask, place: Doubles, inside: Mask) -> tuple[Places, Mask]:
        """Return values between windows that are known, else NaN, and where they are known."""
        inside = inside & (_between(known[np.newaxis].astype(np.float64), place)[0] > 1 - 1e-6)
        values = np.where(known, values, 0.0)
        real, imaginary = _between(np.stack([values.real, values.imag]), place)
        return np.where(inside, real + 1j * imaginary, _UNKNOWN), inside

    def _result(self, found: Found) -> Result:
        """Return the maps of a frame."""
        if found.started and not self._started:
            self._middle = complex(self._nodes[self._touched].mean())
        self._started = found.started
        is_known = found.counted and found.started
        maps = {
            "displacement": found.displacement,
            "displacement_sigma": found.sigma,
            "displacement_covariance": found.covariance,
            "status": found.status,
            "frame": found.onset,
            "contact": self._touched.astype(np.uint8),
            "stick_ratio": np.array([1 - found.slipped / found.counted if is_known else np.nan]),
            **_numbers(found.motion, self._middle),
        }
        process: dict[str, ProcessValue] = {"keys": self.keys, **self._process}
        return Result(maps, x=self._x, y=self._y, process=process, declarations=_DECLARATIONS)


def _numbers(motion: Motion | None, middle: complex) -> dict[str, float]:
    """Return the angle, the centre and the displacement of the middle of a motion, with their sigmas."""
    angle = spread = centre_spread = shift_spread = math.nan
    centre = shift = _UNKNOWN
    if motion is not None:
        about, moved, turn_less_1, variance, angle_variance = motion
        angle, spread = cmath.phase(1 + turn_less_1), math.sqrt(angle_variance)
        arm = middle - about
        shift = moved + turn_less_1 * arm
        shift_spread = math.sqrt(variance + abs(arm) ** 2 * angle_variance)
        if abs(angle) > _LEAST_ANGLE * spread:
            centre = about - moved / turn_less_1
            centre_spread = math.sqrt(variance + abs(centre - about) ** 2 * angle_variance) / abs(angle)
    numbers = {
        "angle": (angle, spread),
        "centre_x": (centre.real, centre_spread),
        "centre_y": (centre.imag, centre_spread),
        "shift_x": (shift.real, shift_spread),
        "shift_y": (shift.imag, shift_spread),
    }
    return {
        name if n == 0 else f"{name}_sigma": value[n] for name, value in numbers.items() for n in range(2)
    }


def _between(values: Doubles, place: Doubles) -> Doubles:
    """Return maps, (n, rows, columns), at places between their nodes, by linear interpolation."""
    return np.stack([map_coordinates(part, place, order=1, mode="nearest") for part in values])
