"""Slip along a stream of frames, from windows that are followed one by one."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from mirrorskin.engine.base.device_arrays import AnyArray, on_host
from mirrorskin.engine.base.frames import as_frames, check_frames
from mirrorskin.engine.base.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.slip.displacement import (
    MAPS,
    Texture,
    bending_variance,
    check_noise,
    check_windows,
    misfit,
)
from mirrorskin.engine.slip.search import read_contact
from mirrorskin.engine.slip.tracking import NodeField, Part, Tracker
from mirrorskin.io import InputError, Map, Result, pixel_axes
from mirrorskin.io.base.arguments import check_count, check_number, check_pixel_size, checked
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.model.maps import SlipStatus, status_of
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device

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
_MEMORY = 64  # frames over which the noise is averaged
_FIRST = 4  # frames in which any residual is noise
_USUAL, _OUTLIER = (
    1.5,
    9.0,
)  # variances of residuals, relative to the noise: of noise; of a window without value
_KINK = 9.0  # squared bias of a window with a kink at its centre, relative to that of a smooth bend
_MIN_COMMON = 0.6  # share of the windows found with the key, below which a frame becomes the key
_MIN_MATCHED = 0.3  # minimum share in a frame that becomes the key
_LEAST_STUCK = 4  # windows, for the motion of the object
_ROUNDS = 2  # fits of the motion
_FITS, _SLIPS = 9.0, 20.0  # chi square of a departure, two degrees of freedom: up to it none; from it slip
_LEAST_ANGLE = 3.0  # standard deviations of the angle, from which the rotation has a centre
_CANCELS = 0.75  # share of the noise of a key that cancels where its windows overlap those of the last one
_UNKNOWN = complex(np.nan, np.nan)  # place or displacement of a window
_PASSES = 5  # of the search for the points of the skin that are at the windows of a new key


class _Motion(NamedTuple):
    """A rigid motion ``to + turn (place - about)``; variances of ``to`` and of the angle."""

    about: complex
    to: complex
    turn: complex
    variance: float
    angle_variance: float


class _Windows(NamedTuple):
    """Displacements of windows since the key, (rows, columns), mm, with variances xx, yy and xy."""

    found: Mask
    moved: Places
    noise: Doubles  # (3, rows, columns)
    bending: Doubles  # (2, rows, columns)


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
        self._device = open_device(device)
        self._frames = 0
        self._tracker: Tracker | None = None
        self._texture: Texture
        self._covariance: Doubles  # xx, yy and xy of a displacement, by noise, mm^2

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
        frame = on_host(as_frames("frame", frame))
        tracker = self._tracker
        if tracker is None:
            check_frames(frame[np.newaxis], frame.dtype, frame.shape)
            self._shape, self._dtype = frame.shape, frame.dtype
            touched = self._read_contact(self._contact if contact is None else contact, contact is None)
            self._step = self._chosen_step or self._usual_step(touched)
            check_windows(self._shape, self._window, self._step)
            self._place_windows(self._take_key(frame))
            self._change_contact(touched)
            windows = self._at_rest()
        else:
            check_frames(frame[np.newaxis], self._dtype, self._shape)
            if contact is not None:
                self._change_contact(self._read_contact(contact))
            field = tracker.follow(frame, part=self._part)
            self._since_key += 1
            with np.errstate(invalid="ignore", divide="ignore"):
                self._learn(tracker, field)
                windows = self._measured(field, self._part)
        with np.errstate(invalid="ignore", divide="ignore"):
            motion = self._find_slip(windows)
            result = self._result(windows, motion)
            self._frames += 1
            if self._lacks_windows(windows.found):
                self._change_key(frame)
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

    def _take_key(self, frame: NDArray[Any]) -> Tracker:
        """Let a frame be the key."""
        self.keys += 1
        self._since_key = 0
        self._tracker = tracker = Tracker(frame.copy(), self._window, self._step, self._device, separate=True)
        grid = tracker.finest.grid
        self._variance, self._seen = np.full(grid, np.nan), np.zeros(grid, bool)
        self._followed = tracker.finest.usable
        return tracker

    def _place_windows(self, tracker: Tracker) -> None:
        """Compute the places of the windows; none has moved or touches."""
        level, grid = tracker.finest, tracker.finest.grid
        x, y = pixel_axes(self._shape, self._size)
        rows, columns = (level.start + level.step * np.arange(nodes) for nodes in grid)
        self._x, self._y = x[0] + columns * self._size[0], y[0] - rows * self._size[1]
        self._nodes: Places = self._x + 1j * self._y[:, None]
        half = (self._window - 1) / 2
        self._corners = np.rint(rows - half).astype(int)[:, None], np.rint(columns - half).astype(int)
        self._part: Part = level.whole
        self._touched, self._partial = np.zeros(grid, bool), np.ones(grid, bool)
        self._before: Places = np.zeros(grid, complex)  # displacements until the key
        self._before_covariance = np.zeros((3, *grid))
        # Of windows that have touched: places on the object, as it was when the contact started; variances of
        # its motion until then, along an axis and of the angle; whether the window was then in contact as a
        # whole; and slip.
        self._fixed: Places = np.full(grid, _UNKNOWN)
        self._drift = np.zeros((2, *grid))
        self._settled, self._slipped, self._exceeded = np.zeros((3, *grid), bool)
        self._fitted, self._onset = np.zeros(grid, np.int32), np.full(grid, -1, np.int32)
        self._started, self._middle = False, 0j

    def _change_contact(self, contact: Mask) -> None:
        """Let windows enter and leave the contact, and choose those that are followed."""
        assert self._tracker is not None
        before = self._part
        self._tracker.spread(before)
        self._sums = cv2.integral(contact.view(np.uint8))
        share = self._share_in_contact(self._tracker.moved)
        touched = share > np.where(self._touched, _LEAVES, _TOUCHES)
        lost = self._touched & ~touched
        self._fixed[lost], self._onset[lost] = _UNKNOWN, -1
        for states in (self._settled, self._slipped, self._exceeded):
            states[lost] = False
        self._touched, self._partial = touched, share < 1
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
        if self._frames and self._fixed[rows, columns].size > _SHRUNK * self._fixed[before].size:
            rows, columns = both
        self._part = rows, columns

    def _share_in_contact(self, moved: Doubles) -> Doubles:
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

    def _at_rest(self) -> _Windows:
        """Return the windows of the first frame."""
        found = self._followed[self._part]
        noise, bending = np.zeros((3, *found.shape)), np.zeros((2, *found.shape))
        return _Windows(found, np.where(found, 0j, _UNKNOWN), noise, bending)

    def _learn(self, tracker: Tracker, field: NodeField) -> None:
        """Average the noise of the windows, except for residuals that are not noise."""
        learned, variance = self._variance[self._part], field.variance
        usual = variance < _USUAL * learned
        if self._since_key < _FIRST:
            usual = np.isfinite(variance)
        np.add(learned, (variance - learned) / min(self._since_key, _MEMORY), out=learned, where=usual)
        np.copyto(learned, variance, where=np.isnan(learned))
        if self._since_key & (self._since_key - 1) == 0 or self._since_key % _MEMORY == 0:
            self._texture = Texture.of(tracker, self._variance, self._noise)
            self._texture.refuse_clear("the frames")
            covariance, (x, y) = self._texture.covariance, self._size
            self._covariance = np.stack(
                [covariance[..., 0, 0] * x**2, covariance[..., 1, 1] * y**2, -covariance[..., 0, 1] * x * y]
            )
            self._followed = self._texture.textured & tracker.finest.usable

    def _measured(self, field: NodeField, part: Part) -> _Windows:
        """Return the displacements of a part of the windows."""
        variance, covariance = self._texture.variance[part], self._covariance[:, *part]
        found = field.converged & self._followed[part] & (field.variance < _OUTLIER * variance)
        right, down = field.moved
        moved = np.where(found, right * self._size[0] - 1j * self._size[1] * down, _UNKNOWN)
        bending = bending_variance(moved, covariance[:2], self._step, self._window)
        bending[:, self._partial[part]] *= _KINK
        noise = covariance * misfit(field.variance, variance, self._window)
        return _Windows(found, moved, noise, bending)

    def _find_slip(self, windows: _Windows) -> _Motion | None:
        """Find the windows that slip, and return the motion of those that stick; None if too few stick."""
        part = self._part
        now, found = self._nodes[part] + windows.moved, windows.found
        touched, fixed, slipped = self._touched[part], self._fixed[part], self._slipped[part]
        if not self._started:
            return self._start_contact(now, found & touched)
        settled, exceeded, fitted = self._settled[part], self._exceeded[part], self._fitted[part]
        partial = self._partial[part] | ~settled
        used = found & touched & np.isfinite(fixed)
        place, at, before, sticks = fixed[used], now[used], slipped[used], ~(partial | slipped)[used]
        drift, turned = self._drift[:, *part][:, used]
        xx, yy, xy = windows.noise[:, used]
        if self.keys > 1:
            more_xx, more_yy, more_xy = self._before_covariance[:, *part][:, used]
            xx, yy, xy = xx + more_xx, yy + more_yy, xy + more_xy
        # Skin that sticks does not bend.
        bent_x, bent_y = windows.bending[:, used] * partial[used]
        xx, yy = xx + bent_x + drift, yy + bent_y + drift
        weights, fit, motion = 2 / (xx + yy), sticks, None
        chi_square = np.zeros(at.shape)
        for _ in range(_ROUNDS):
            if np.count_nonzero(fit) < _LEAST_STUCK:
                return None
            motion = _fit_motion(place, at, weights * fit, drift, turned)
            arms = place - motion.about
            left = at - motion.to - motion.turn * arms
            # What takes part in the fit is closer to it.
            spread = motion.variance + (arms.real**2 + arms.imag**2) * motion.angle_variance
            spread = np.where(fit, -spread, spread)
            chi_square = _chi_square(left, xx + spread, yy + spread, xy)
            fitting = sticks & (chi_square < _FITS)
            if (fitting == fit).all():
                break
            fit = fitting
        exceeds = chi_square > _SLIPS
        departs = exceeds & ~before
        if departs.any():
            starts = np.zeros(found.shape, bool)
            starts[used] = departs
            neighbours = cv2.boxFilter(
                starts.view(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
            )
            starts &= exceeded | (neighbours > 1)
            self._onset[part][starts] = fitted[starts] + 1
            slipped |= starts
        exceeded[...] = False
        exceeded[used] = exceeds
        fitted[used] = np.where(chi_square < _FITS, self._frames, fitted[used])
        entering = found & touched & ~(settled | slipped | (np.isfinite(fixed) & self._partial[part]))
        if motion is not None and entering.any():
            arms = (now[entering] - motion.to) * motion.turn.conjugate()
            fixed[entering], fitted[entering] = motion.about + arms, self._frames
            settled[entering] = ~self._partial[part][entering]
            inherited = motion.variance + np.abs(arms) ** 2 * motion.angle_variance
            inherited += (windows.bending.mean(axis=0) * ~settled)[entering]
            self._drift[:, *part][:, entering] = inherited, np.full(arms.shape, motion.angle_variance)
        return motion

    def _start_contact(self, now: Places, found: Mask) -> _Motion | None:
        """Let all windows in contact stick; return the motion, which is none, if they are enough."""
        part = self._part
        self._fixed[part] = np.where(found, now, _UNKNOWN)
        self._settled[part] = found & ~self._partial[part]
        self._drift[:, *part] = 0
        self._fitted[part] = self._frames
        if np.count_nonzero(found & ~self._partial[part]) < _LEAST_STUCK:
            return None
        self._started = True
        self._middle = middle = complex(self._nodes[self._touched].mean())
        return _Motion(middle, middle, 1.0, 0.0, 0.0)

    def _lacks_windows(self, found: Mask) -> bool:
        """Return whether too many windows in contact, of those that were found with this key, are lost."""
        touched, seen = self._touched[self._part], self._seen[self._part]
        if self._since_key:
            seen |= found
        common, matched = np.count_nonzero(seen & touched), np.count_nonzero(found & touched)
        return bool(_MIN_MATCHED * common < matched < _MIN_COMMON * common)

    def _change_key(self, frame: NDArray[Any]) -> None:
        """Let the newest frame be the key: its windows show skin that was between those of the last key.

        All windows of the picture are followed to it. Their displacement until now is interpolated linearly.
        The noise of this frame is in it, and in the next displacements with the opposite sign, so that most
        of it cancels where windows overlap. Where the displacement may bend by more than its noise between
        the windows, it is lost.
        """
        assert self._tracker is not None
        self._tracker.spread(self._part)
        field = self._tracker.follow(frame, 0.0)
        found, moved, _, bending = self._measured(field, self._tracker.finest.whole)
        shape = found.shape
        steps = np.stack([fill_with_nearest(np.where(found, part, np.nan)) for part in field.moved[::-1]])
        grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij")).astype(np.float64)
        place = grid
        for _ in range(_PASSES):
            place = grid - _between(steps, place) / self._step
        last = np.array(shape)[:, None, None] - 1
        inside = np.all((place >= 0) & (place <= last), axis=0)
        # Variance of a mean of adjacent windows, whose errors are correlated as far as they overlap.
        part, ratio = place - np.floor(place), self._step / self._window
        squares = np.prod(1 - 2 * min(ratio, 1.0) * part * (1 - part), axis=0)
        overlap = part * np.maximum(1 - (1 - part) * ratio, 0) + (1 - part) * np.maximum(1 - part * ratio, 0)
        weight = np.maximum(squares - _CANCELS * np.prod(overlap, axis=0), 0.0)
        bending = bending * (ratio**4 * np.where(self._partial, 1.0, _KINK))
        inside = inside & np.all(_between(bending - self._covariance[:2], place) < 0, axis=0)
        covariance = self._before_covariance.copy()
        covariance[:2] += bending
        covariance = _between(covariance, place) + weight * self._covariance
        found &= np.isfinite(self._before)
        self._before, known = self._interpolated(moved + self._before, found, place, inside)
        self._before_covariance = np.where(known, covariance, 0.0)
        self._fixed, _ = self._interpolated(self._fixed, np.isfinite(self._fixed) & found, place, inside)
        nearest = tuple(
            np.clip(np.rint(axis).astype(int), 0, size - 1) for axis, size in zip(place, shape, strict=True)
        )
        self._drift = self._drift[:, *nearest]
        share = self._share_in_contact(np.zeros((2, *shape)))
        self._touched, self._partial = share > _TOUCHES, share < 1
        entered = np.isfinite(self._fixed) & self._touched
        self._fixed[~entered] = _UNKNOWN
        self._settled, self._slipped, self._exceeded = (
            states[nearest] & entered for states in (self._settled, self._slipped, self._exceeded)
        )
        self._fitted = self._fitted[nearest]
        self._onset = np.where(entered, self._onset[nearest], -1).astype(np.int32)
        self._take_key(frame)

    @staticmethod
    def _interpolated(values: Places, known: Mask, place: Doubles, inside: Mask) -> tuple[Places, Mask]:
        """Return values between windows that are known, else NaN, and where they are known."""
        inside = inside & (_between(known[np.newaxis].astype(np.float64), place)[0] > 1 - 1e-6)
        values = np.where(known, values, 0.0)
        real, imaginary = _between(np.stack([values.real, values.imag]), place)
        return np.where(inside, real + 1j * imaginary, _UNKNOWN), inside

    def _result(self, windows: _Windows, motion: _Motion | None) -> Result:
        """Return the maps of a frame."""
        part, grid = self._part, self._nodes.shape
        touched, slipped, followed = self._touched[part], self._slipped[part], self._followed[part]
        moved = np.full((*grid, 2), np.nan, np.float32)
        covariance = np.full((*grid, 3), np.nan, np.float32)
        total = windows.moved + self._before[part]
        moved[part] = total.view(np.float64).reshape(*total.shape, 2)
        noise = windows.noise + self._before_covariance[:, *part]
        noise[:2] += windows.bending
        np.copyto(noise, np.nan, where=np.isnan(total))
        covariance[part] = noise.transpose(1, 2, 0)
        status = np.full(grid, SlipStatus.NO_CONTACT, np.uint8)
        counted, inner = touched & followed, status[part]
        inner[touched] = SlipStatus.NO_TEXTURE
        inner[counted] = SlipStatus.UNKNOWN
        known = counted & windows.found & np.isfinite(self._fixed[part])
        inner[known] = SlipStatus.STICKS
        inner[known & slipped] = SlipStatus.SLIPPED
        count = np.count_nonzero(counted)
        stuck = 1 - np.count_nonzero(counted & slipped) / count if count and self._started else np.nan
        maps = {
            "displacement": moved,
            "displacement_sigma": np.sqrt(covariance[..., :2]),
            "displacement_covariance": covariance,
            "status": status,
            "frame": self._onset.copy(),
            "contact": self._touched.astype(np.uint8),
            "stick_ratio": np.array([stuck]),
            **_numbers(motion, self._middle),
        }
        process: dict[str, ProcessValue] = {"keys": self.keys, **self._process}
        return Result(maps, x=self._x, y=self._y, process=process, declarations=_DECLARATIONS)


def _fit_motion(places: Places, now: Places, weights: Doubles, drift: Doubles, turned: Doubles) -> _Motion:
    """Fit a rigid motion by least squares (Kabsch, 1976); ``weights`` are inverse variances along an axis.

    The errors of windows that entered the contact later, ``drift`` and that of the angle, are common to them.
    """
    total = float(weights.sum())
    about, to = complex(weights @ places) / total, complex(weights @ now) / total
    arms = places - about
    turn = complex(np.vdot(arms, weights * (now - to)))
    turn = turn / abs(turn) if turn else 1 + 0j
    moments = weights * (arms.real**2 + arms.imag**2)
    squares = float(moments.sum())
    variance = (1 + float(weights @ drift)) / total
    return _Motion(
        about, to, turn, variance, (1 + float(moments @ turned)) / squares if squares > 0 else np.inf
    )


def _chi_square(left: Places, xx: Doubles, yy: Doubles, xy: Doubles) -> Doubles:
    """Return the squares of vectors x + i y relative to their covariances."""
    x, y = left.real, left.imag
    return np.asarray((yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))


def _numbers(motion: _Motion | None, middle: complex) -> dict[str, float]:
    """Return the angle, the centre and the displacement of the middle of a motion, with their sigmas."""
    angle = spread = centre_spread = shift_spread = np.nan
    centre = shift = _UNKNOWN
    if motion is not None:
        angle, spread = float(np.angle(motion.turn)), float(np.sqrt(motion.angle_variance))
        arm = middle - motion.about
        shift = motion.to + motion.turn * arm - middle
        shift_spread = float(np.sqrt(motion.variance + abs(arm) ** 2 * motion.angle_variance))
        if abs(angle) > _LEAST_ANGLE * spread:
            centre = (motion.to - motion.turn * motion.about) / (1 - motion.turn)
            square = motion.variance + abs(centre - motion.about) ** 2 * motion.angle_variance
            centre_spread = float(np.sqrt(square)) / abs(angle)
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
