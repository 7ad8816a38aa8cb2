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
from mirrorskin.engine.slip.tracking import NodeField, Tracker
from mirrorskin.io import InputError, Map, Result, pixel_axes
from mirrorskin.io.base.arguments import check_count, check_number, checked
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.model.maps import SlipStatus, status_of
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device

Mask = NDArray[np.bool_]

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
        name: Map(f"{caption} of the skin that sticks, since the first frame", unit, "float64", "none")
        for name, caption, unit in (
            ("angle", "rotation, counter-clockwise,", "rad"),
            ("centre_x", "centre of the rotation along x,", "mm"),
            ("centre_y", "centre of the rotation along y,", "mm"),
            ("shift_x", "displacement along x, at the middle of the contact,", "mm"),
            ("shift_y", "displacement along y, at the middle of the contact,", "mm"),
        )
    },
}
_WINDOWS = 200  # about as many are followed
_MARGIN = 2  # windows around the contact that are followed, too
_MEMORY = 64  # frames over which the noise is averaged
_FIRST = 4  # frames in which any residual is noise
_USUAL, _OUTLIER = (
    1.5,
    9.0,
)  # variances of residuals, relative to the noise: of noise; of a window without value
_KINK = 9.0  # squared bias of a window with a kink at its centre, relative to that of a smooth bend
_MIN_COMMON = 0.6  # share of the windows found first, below which a frame becomes the key
_MIN_MATCHED = 0.3  # minimum share in a frame that becomes the key
_LEAST_STUCK = 4  # windows, for the motion of the object
_ROUNDS = 2  # fits of the motion
_FITS, _SLIPS = 9.0, 20.0  # chi square of a departure, two degrees of freedom: up to it none; from it slip
_LEAST_ANGLE = 3.0  # standard deviations of the angle, from which the rotation has a centre
_CANCELS = 0.75  # share of the noise of a key that cancels where its windows overlap those of the last one
_PASSES = 5  # of the search for the points of the skin that are at the windows of a new key


class _Motion(NamedTuple):
    """A rigid motion ``to + turn (place - about)`` of places x + i y, mm; variances of ``to`` and angle."""

    about: complex
    to: complex
    turn: complex
    variance: float
    angle_variance: float


class SlipTracker(ThreadSafe):
    """Finds where the skin sticks to an object, and where it starts to slip, in each frame of a stream.

    Windows of the first frame, in and around the contact, are followed one by one. The skin that sticks moves
    like a rigid body, with the object, whose motion need not be known. A window departs from it significantly
    when it slips; see the documentation, "Slip". `SlipOnset` is more accurate, but takes longer, and needs
    the motion of the body.

    The first frame is the key. If windows are lost, as they leave the picture, a later frame becomes the key,
    and the errors up to then are added.

    Parameters
    ----------
    contact : Result, mapping, xarray.Dataset, path or array_like, (H, W)
        Where the skin touches the object, as of `SlipOnset`.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the contact.
    window_size : int
        Side of a window, pixels. Larger ones have less noise, but are biased more where the movement bends.
    window_step : int
        Distance between the centres of adjacent windows, pixels; by default at least half a window, and such
        that about 200 windows cover the contact and its surroundings.
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
        contact: Maps,
        pixel_size: ArrayLike | None = None,
        *,
        window_size: int = 12,
        window_step: int | None = None,
        noise: float | None = None,
        device: str | Device | None = None,
    ) -> None:
        check_noise(noise)
        self.keys: int = 0
        self._contact = as_result(contact, "contact", quantity="contact")
        self._size = pixel_size_of(self._contact, "contact", pixel_size)
        self._scale = np.array([self._size[0], -self._size[1]])  # mm per pixel to the right and down
        self._window, self._chosen_step, self._noise = window_size, window_step, noise
        self._device = open_device(device)
        self._frames = 0
        self._tracker: Tracker | None = None
        self._texture: Texture
        self._covariance: Doubles  # of a displacement, by noise, mm^2
        self._diagonal: Doubles

    takes_frames = True

    def precompile(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Compile what frames of a shape and type need, with another tracker, so that none is delayed."""
        noise = 1.0 if self._noise is None else self._noise
        options: dict[str, Any] = {"window_step": self._chosen_step, "noise": noise, "device": self._device}
        trial = SlipTracker(self._contact, self._size, window_size=self._window, **options)
        texture = np.random.default_rng(0).integers(0, 256, shape).astype(dtype)
        with suppress(InputError):  # refused when the first frame is
            for shift in range(3):
                trial.push(np.roll(texture, shift, axis=1))

    def push(self, frame: AnyArray) -> Result:
        """Return displacement and slip in the next frame, (H, W), uint8, uint16 or float32.

        Returns
        -------
        Result
            Maps of the windows in and around the contact, (rows, columns), whose places are ``x`` and ``y``:

            - ``displacement``, (rows, columns, 2), since the first frame, mm; its ``displacement_sigma``, and
              ``displacement_covariance``, (rows, columns, 3). NaN where a window is not found, as it has left
              the picture or does not resemble the key.
            - ``status``, codes as of `SlipOnset`, and ``contact``.
            - ``frame`` in which the slip started, from 0; -1 where the skin has not slipped.

            Numbers: ``stick_ratio``, (1,), the share of the contact that has not slipped; ``angle``,
            ``centre_x`` and ``centre_y`` of the skin that sticks, and its displacement ``shift_x`` and
            ``shift_y`` at the middle of the contact, with their standard deviations. These are NaN if less
            than four windows stick; a centre also if there is no significant rotation.

            `mirrorskin.engine.force.find_tangential_force` takes it.

        Raises
        ------
        mirrorskin.io.InputError
            A frame of another type or shape, a contact of another shape, or a sheet without texture.
        """
        frame = on_host(as_frames("frame", frame))
        if self._tracker is None:
            self._start(frame)
        check_frames(frame[np.newaxis], self._cropped.dtype, self._shape)
        np.copyto(self._cropped, frame[self._box])
        motion: _Motion | None
        if self._tracker is None:
            tracker = self._take_key()
            self._place_windows(tracker)
            moved, covariance = self._before, self._before_covariance
            found = self._followed = tracker.finest.usable
            motion = _Motion(self._middle, self._middle, 1.0, 0.0, 0.0)
            self._frames = 1
            return self._result(moved, covariance, found, motion)
        field = self._tracker.follow(self._cropped)
        self._since_key += 1
        self._learn(self._tracker, field)
        texture = self._texture
        with np.errstate(invalid="ignore"):
            found = field.converged & texture.textured & (field.variance < _OUTLIER * texture.variance)
        found &= np.isfinite(self._before[..., 0])
        moved = np.where(found[..., None], np.moveaxis(field.moved, 0, -1) * self._scale, np.nan)
        bent = bending_variance(moved, self._diagonal, self._step, self._window) * self._kinks
        moved += self._before
        noisy = self._covariance * misfit(field, texture, self._window)[..., None] ** 2
        noisy += self._before_covariance
        # Skin that sticks does not bend.
        motion = self._find_slip(moved, _added(noisy, np.where(self._whole[..., None], 0.0, bent)), found)
        covariance = _added(noisy, bent)
        self._frames += 1
        result = self._result(moved, covariance, found, motion)
        matched = int(np.count_nonzero(found & self._touched))
        if self._since_key == 1:
            self._common = matched
        elif _MIN_MATCHED * self._common < matched < _MIN_COMMON * self._common:
            self._change_key(field, found, moved, bent)
        return result

    def _start(self, frame: NDArray[Any]) -> None:
        """Find the contact, and the part of the picture that is followed."""
        check_frames(frame[np.newaxis], frame.dtype, frame.shape)
        contact, origin, findings = read_contact(self._contact, frame.shape)
        assert contact is not None
        margin = _MARGIN * self._window
        extent = (np.flatnonzero(contact.any(axis=axis)) for axis in (1, 0))
        self._box = tuple(slice(max(int(part[0]) - margin, 0), int(part[-1]) + 1 + margin) for part in extent)
        self._inside, self._process = contact[self._box], {"contact": origin, **findings}
        needed = math.ceil(math.sqrt(self._inside.size / _WINDOWS))
        self._step = self._chosen_step or max(needed, self._window // 2)
        check_windows(self._inside.shape, self._window, self._step)
        self._cropped = np.empty(self._inside.shape, frame.dtype)
        self._shape: tuple[int, int] = frame.shape

    def _take_key(self) -> Tracker:
        """Let the newest frame be the key."""
        self.keys += 1
        self._since_key, self._common = 0, 0
        self._tracker = tracker = Tracker(
            self._cropped.copy(), self._window, self._step, self._device, separate=True
        )
        self._variance = np.full(tracker.finest.grid, np.nan)
        return tracker

    def _place_windows(self, tracker: Tracker) -> None:
        """Compute the places of the windows, and which of them are in contact; none has moved or slipped."""
        level, window = tracker.finest, self._window
        sums = cv2.integral(self._inside.astype(np.uint8))
        first = [
            np.clip(np.rint(level.start + level.step * np.arange(nodes) - (window - 1) / 2), 0, size).astype(
                int
            )
            for nodes, size in zip(level.grid, self._inside.shape, strict=True)
        ]
        last = [np.minimum(part + window, size) for part, size in zip(first, self._inside.shape, strict=True)]
        share = sums[np.ix_(*last)] - sums[np.ix_(first[0], last[1])] - sums[np.ix_(last[0], first[1])]
        share = (share + sums[np.ix_(*first)]) / window**2
        self._touched, self._whole = share > 0.5, share == 1
        self._kinks = np.where(self._whole, 1.0, _KINK)[..., None]
        x, y = pixel_axes(self._shape, self._size)
        rows, columns = (
            level.start + level.step * np.arange(nodes) + part.start
            for nodes, part in zip(level.grid, self._box, strict=True)
        )
        self._x, self._y = x[0] + columns * self._size[0], y[0] - rows * self._size[1]
        self._places = self._x + 1j * self._y[:, None]
        self._middle = complex(self._places[self._touched].mean()) if self._touched.any() else 0j
        self._before, self._before_covariance = np.zeros((*share.shape, 2)), np.zeros((*share.shape, 2, 2))
        self._slipped, self._exceeded = np.zeros((2, *share.shape), bool)
        self._fitted, self._onset = np.zeros(share.shape, np.int32), np.full(share.shape, -1, np.int32)

    def _learn(self, tracker: Tracker, field: NodeField) -> None:
        """Average the noise of the windows, except for residuals that are not noise."""
        with np.errstate(invalid="ignore"):
            usual = (field.variance < _USUAL * self._variance) | (self._since_key < _FIRST)
        change = np.where(usual & np.isfinite(field.variance), field.variance - self._variance, 0.0)
        averaged = self._variance + change / min(self._since_key, _MEMORY)
        self._variance = np.where(np.isfinite(self._variance), averaged, field.variance)
        if self._since_key & (self._since_key - 1) == 0 or self._since_key % _MEMORY == 0:
            self._texture = Texture.of(tracker, self._variance, self._noise)
            self._texture.refuse_clear("the frames")
            self._covariance = self._texture.covariance * self._scale[:, None] * self._scale
            self._diagonal = np.einsum("yxii->yxi", self._covariance)
            self._followed = self._texture.textured & tracker.finest.usable

    def _find_slip(self, moved: Doubles, covariance: Doubles, found: Mask) -> _Motion | None:
        """Find the windows that slip, and return the motion of those that stick; None if too few stick."""
        now = self._places + moved[..., 0] + 1j * moved[..., 1]
        xx, yy, xy = covariance[..., 0, 0], covariance[..., 1, 1], covariance[..., 0, 1]
        candidates = used = self._whole & found & ~self._slipped
        motion, chi_square = None, np.zeros(found.shape)
        for _ in range(_ROUNDS):
            if np.count_nonzero(used) < _LEAST_STUCK:
                return None
            motion = _fit_motion(self._places[used], now[used], 2 / (xx + yy)[used])
            arms = self._places - motion.about
            left = now - motion.to - motion.turn * arms
            # What takes part in the fit is closer to it.
            fit = np.where(used, -1, 1) * (motion.variance + np.abs(arms) ** 2 * motion.angle_variance)
            chi_square = _chi_square(left, xx + fit, yy + fit, xy)
            with np.errstate(invalid="ignore"):
                fitting = candidates & (chi_square < _FITS)
            if np.array_equal(fitting, used):
                break
            used = fitting
        with np.errstate(invalid="ignore"):
            exceeds, fits = chi_square > _SLIPS, chi_square < _FITS
        departs = self._touched & exceeds & ~self._slipped
        neighbours = cv2.boxFilter(
            departs.view(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        starts = departs & (self._exceeded | (neighbours > 1))
        self._onset[starts] = self._fitted[starts] + 1
        self._fitted[fits] = self._frames
        self._slipped |= starts
        self._exceeded = exceeds
        return motion

    def _change_key(self, field: NodeField, found: Mask, moved: Doubles, bent: Doubles) -> None:
        """Let the newest frame be the key: its windows show skin that was between those of the last key.

        Their displacement until now is interpolated linearly. The noise of this frame is in it, and in the
        next displacements with the opposite sign, so that most of it cancels where windows overlap. Where the
        displacement may bend by more than its noise between the windows, it is lost.
        """
        steps = np.stack([fill_with_nearest(np.where(found, part, np.nan)) for part in field.moved[::-1]])
        grid = np.stack(np.meshgrid(*map(np.arange, found.shape), indexing="ij")).astype(np.float64)
        place = grid
        for _ in range(_PASSES):
            place = grid - _between(steps, place) / self._step
        last = np.array(found.shape)[:, None, None] - 1
        known = ((place >= 0) & (place <= last)).all(axis=0)
        known &= _between(found[np.newaxis].astype(np.float64), place)[0] > 1 - 1e-6
        before = np.moveaxis(
            _between(np.moveaxis(np.where(found[..., None], moved, 0.0), -1, 0), place), 0, -1
        )
        # Variance of a mean of adjacent windows, whose errors are correlated as far as they overlap.
        part, ratio = place - np.floor(place), self._step / self._window
        squares = np.prod(1 - 2 * min(ratio, 1.0) * part * (1 - part), axis=0)
        overlap = part * np.maximum(1 - (1 - part) * ratio, 0) + (1 - part) * np.maximum(1 - part * ratio, 0)
        weight = np.maximum(squares - _CANCELS * np.prod(overlap, axis=0), 0.0)
        bent = np.where(np.isfinite(bent), bent, 0.0) * (_KINK * ratio**4 / self._kinks)
        covariance = _added(self._before_covariance, bent)
        known &= (_between(np.moveaxis(bent - self._diagonal, -1, 0), place) < 0).all(axis=0)
        covariance = _between(np.moveaxis(covariance.reshape(*found.shape, 4), -1, 0), place)
        self._before = np.where(known[..., None], before, np.nan)
        self._before_covariance = np.moveaxis(covariance, 0, -1).reshape(*found.shape, 2, 2)
        self._before_covariance += weight[..., None, None] * self._covariance
        self._places = self._x + 1j * self._y[:, None] - before[..., 0] - 1j * before[..., 1]
        nearest = tuple(
            np.clip(np.rint(part).astype(int), 0, n - 1) for part, n in zip(place, found.shape, strict=True)
        )
        self._slipped, self._exceeded = self._slipped[nearest], self._exceeded[nearest]
        self._fitted, self._onset = self._fitted[nearest], self._onset[nearest]
        self._take_key()

    def _result(self, moved: Doubles, covariance: Doubles, found: Mask, motion: _Motion | None) -> Result:
        """Return the maps of a frame."""
        variances = np.stack([covariance[..., 0, 0], covariance[..., 1, 1], covariance[..., 0, 1]], axis=-1)
        variances = np.where(found[..., None], variances, np.nan)
        status = np.where(self._slipped, SlipStatus.SLIPPED, SlipStatus.STICKS)
        status = np.where(found, status, SlipStatus.UNKNOWN)
        status = np.where(self._followed, status, SlipStatus.NO_TEXTURE)
        counted = self._touched & self._followed
        stuck = float(np.mean(~self._slipped[counted])) if counted.any() else np.nan
        maps = {
            "displacement": np.where(found[..., None], moved, np.nan).astype(np.float32),
            "displacement_sigma": np.sqrt(variances[..., :2]).astype(np.float32),
            "displacement_covariance": variances.astype(np.float32),
            "status": np.where(self._touched, status, SlipStatus.NO_CONTACT).astype(np.uint8),
            "frame": self._onset.copy(),
            "contact": self._touched.astype(np.uint8),
            "stick_ratio": np.array([stuck]),
            **_numbers(motion, self._middle),
        }
        process: dict[str, ProcessValue] = {"keys": self.keys, **self._process}
        return Result(maps, x=self._x, y=self._y, process=process, declarations=_DECLARATIONS)


def _fit_motion(places: NDArray[Any], now: NDArray[Any], weights: Doubles) -> _Motion:
    """Fit a rigid motion by least squares (Kabsch, 1976); ``weights`` are inverse variances along an axis."""
    total = float(weights.sum())
    about, to = complex(weights @ places) / total, complex(weights @ now) / total
    arms = places - about
    turn = complex(np.sum(weights * (now - to) * arms.conj()))
    turn = turn / abs(turn) if turn else 1 + 0j
    squares = float(np.sum(weights * np.abs(arms) ** 2))
    return _Motion(about, to, turn, 1 / total, 1 / squares if squares > 0 else np.inf)


def _chi_square(left: NDArray[Any], xx: Doubles, yy: Doubles, xy: Doubles) -> Doubles:
    """Return the squares of vectors x + i y relative to their covariances."""
    x, y = left.real, left.imag
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))


def _added(covariance: Doubles, variances: Doubles) -> Doubles:
    """Return covariances, (rows, columns, 2, 2), with variances, (rows, columns, 2), added."""
    total = covariance.copy()
    total[..., 0, 0] += variances[..., 0]
    total[..., 1, 1] += variances[..., 1]
    return total


def _numbers(motion: _Motion | None, middle: complex) -> dict[str, float]:
    """Return the angle, the centre and the displacement of the middle of a motion, with their sigmas."""
    angle = spread = centre_spread = shift_spread = np.nan
    centre = shift = complex(np.nan, np.nan)
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
