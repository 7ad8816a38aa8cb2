"""Where the skin follows the object, and where and when it slips: displacement of all frames together."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_dtype, check_frames
from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.nearest_fill import fill_with_nearest
from mirrorskin.engine.slip.displacement import (
    FOUND,
    NO_TEXTURE,
    STEP,
    Texture,
    bending_variance,
    check_noise,
    check_windows,
    misfit,
    node_status,
)
from mirrorskin.engine.slip.onset_map import Expected, OnsetMap, fit_onsets
from mirrorskin.engine.slip.tracking import NodeField, Tracker
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, pixel_axes
from mirrorskin.io.maps import SlipStatus
from mirrorskin.io.result import Shown
from mirrorskin.kernels.device import Device, open_device

Doubles = NDArray[np.float64]
SlipMotion = Literal["horizontal", "twist"]
MOTIONS: tuple[SlipMotion, ...] = get_args(SlipMotion)

WINDOW = 8
"""Pixels: smaller than for displacement alone, as all frames together tell an onset."""

_EXPECTED = {  # see docs/method/slip.md
    "displacement": Expected(power=1.6, onset_bend=12.0, growth_bend=32.0),
    "twist": Expected(power=1.4, onset_bend=24.0, growth_bend=4.0),
}
# A contact that is estimated is too wide: what windows see at its rim in a slide is free skin.
_BEND_ESTIMATED = {"displacement": 64.0, "twist": 24.0}
_FOLLOWS = 0.5  # of the object's movement, from which on skin is taken to have touched it
_LEAST_STUCK = 4  # nodes that a twist's centre and angle are made of
_STILL = 1e-9  # of the way, by which nobody moves


@dataclass(frozen=True, slots=True, repr=False)
class Slip(Shown):
    """How the skin went along with an object that the body slid or turned over.

    Attributes
    ----------
    displacement : ndarray, (H, W, 2) or (T, H, W, 2), float32
        Millimetres along x and y that the skin has moved in the picture since the first frame, in the last
        frame or in each: of the point that was seen at the pixel first.
    displacement_sigma : ndarray, (H, W), float32
        Millimetres: standard deviation along either axis, the root of their mean square.
    slip_onset, slip_onset_sigma : ndarray, (H, W), float32
        The way of the body since the first frame, mm or radians, after which the skin broke loose; NaN where
        it did not.
    status : ndarray, (H, W), uint8
        0 unknown, 1 slipped, 2 sticks, 3 no contact, 4 no texture.
    contact : ndarray, (H, W), uint8
        1 where the skin touches the object: given, or estimated.
    way : ndarray, (T,), float64
        How far the body has come along its path in each frame, mm or radians.
    stick_ratio : ndarray, (T,), float64
        Share of the contact that sticks, frame by frame; NaN from where the body first turns back.
    centre : (float, float) or None
        Of a twist: what the skin that sticks turned about, mm from the picture's centre; NaN where too
        little of it is left.
    angle : float or None
        Of a twist: by how much it turned, radians, counter-clockwise; the body's own is the opposite.
    noise : float
        Standard deviation of a sample, counts, given or estimated.
    """

    displacement: NDArray[np.float32]
    displacement_sigma: NDArray[np.float32]
    slip_onset: NDArray[np.float32]
    slip_onset_sigma: NDArray[np.float32]
    status: NDArray[np.uint8]
    contact: NDArray[np.uint8]
    way: Doubles
    stick_ratio: Doubles
    centre: tuple[float, float] | None
    angle: float | None
    noise: float


class SlipSearch(ThreadSafe):
    """Find displacement and slip in frames that come block by block; see `engine.streaming.Estimator`.

    The first frame is the reference. In the body's frame, skin that sticks to an object at rest moves as the
    object does, against the body; by what it lags behind it has slipped. When that began is fitted to all
    frames (`mirrorskin.engine.slip.onset_map.fit_onsets`); see the documentation, "Slip".

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    pixel_size : float or (float, float)
        Millimetres, along x and y.
    motion : {"horizontal", "twist"}
    contact : array_like, (H, W), optional
        Not 0 where the skin touches the object in the first frame, as a press tells. Without it, contact is
        where the skin went along by half of the way or more: free skin round the contact does so, too, so
        that the contact comes out 2 to 9 % too wide.
    centre : (float, float)
        Of a twist: where the body's axis is, mm from the picture's centre.
    window, step, noise, device
        As for `mirrorskin.engine.find_displacement`.
    per_frame : bool
        Whether the displacement is that of each frame.
    memory_limit : int
        Bytes of host memory for frames on the move; half of it is the room for one block.

    Examples
    --------
    >>> import cv2
    >>> texture = np.random.default_rng(1).normal(100, 20, (60, 80))
    >>> texture = cv2.GaussianBlur(texture, (0, 0), 1.5).astype(np.float32)
    >>> search = SlipSearch((60, 80), np.float32, 0.1, contact=np.ones((60, 80)), noise=0.1)
    >>> for k in range(4):  # the body goes to the right, the skin sticks and stays behind
    ...     search.push(np.roll(texture, -k, axis=1)[None], displacement=[[0.1 * k, 0.0]])
    >>> found = search.result()
    >>> [round(float(part), 3) for part in found.displacement[30, 40]], int(found.status[30, 40])
    ([-0.3, 0.0], 2)
    """

    window: int
    step: int

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        pixel_size: ArrayLike,
        *,
        motion: SlipMotion = "horizontal",
        contact: ArrayLike | None = None,
        centre: tuple[float, float] = (0.0, 0.0),
        window: int = WINDOW,
        step: int = STEP,
        noise: float | None = None,
        per_frame: bool = False,
        device: str | Device | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        if motion not in MOTIONS:
            raise InputError(f"motion {motion!r} does not slip: {' and '.join(MOTIONS)} do")
        check_windows(shape, window, step)
        check_noise(noise)
        self.position = "displacement" if motion == "horizontal" else "twist"
        self.device: Device = open_device(device)
        self._shape, self._dtype, self._size = shape, check_dtype(dtype), check_pixel_size(pixel_size)
        self._contact = None if contact is None else check_contact(contact, shape)
        self._centre, self.window, self.step = centre, window, step
        self._noise, self._per_frame = noise, per_frame
        self._length = max(1, memory_limit // (2 * math.prod(shape) * self._dtype.itemsize))
        self.reset()

    @cached_property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W)."""
        return np.empty((min(self._length, 16), *self._shape), self._dtype)

    def reset(self) -> None:
        """Forget the frames so far."""
        self._tracker: Tracker | None = None
        self._places: list[Doubles] = []
        self._fields: list[NodeField] = []

    def push(
        self,
        frames: NDArray[Any],
        *,
        displacement: ArrayLike | None = None,
        twist: ArrayLike | None = None,
        lent: bool = False,
    ) -> None:
        """Take in the next frames, (n, H, W), and where the body was: (n, 2) mm, or (n,) radians.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another shape or type, or positions that are missing or not finite.
        """
        check_frames(frames, self._dtype, self._shape)
        places = self._check_places(displacement if self.position == "displacement" else twist, len(frames))
        for frame, place in zip(frames, places, strict=True):
            if self._tracker is None:
                self._tracker = Tracker(frame.copy(), self.window, self.step, self.device)
            else:
                self._fields.append(self._tracker.follow(frame, self._stride(place)))
            self._places.append(place)

    def _check_places(self, given: ArrayLike | None, count: int) -> Doubles:
        if given is None:
            raise InputError(f"frames without {self.position}: say where the body was in each")
        places = np.asarray(given, np.float64)
        wanted = (count, 2) if self.position == "displacement" else (count,)
        if places.shape != wanted or not np.isfinite(places).all():
            raise InputError(
                f"{self.position} of shape {places.shape}: finite numbers of shape {wanted} are needed"
            )
        return places.reshape(count, -1)

    def _stride(self, place: Doubles) -> float:
        """Return how long the step to a place is, as a multiple of the step before; 0 where that was none."""
        if len(self._places) < 2:
            return 0.0
        before = self._places[-1] - self._places[-2]
        square = float(before @ before)
        return float(np.clip((place - self._places[-1]) @ before / square, -4, 4)) if square > 0 else 0.0

    def newest(self) -> NDArray[np.float32] | None:
        """Return the displacement in the newest frame, (H, W, 2), mm; None before the second."""
        if self._tracker is None or not self._fields:
            return None
        field = self._fields[-1]
        moved = np.where(field.found, field.moved, np.nan)
        return self._tracker.to_pixels(np.moveaxis(moved, 0, -1) * self._scale)

    @property
    def _scale(self) -> Doubles:
        """Millimetres along x and y that pixels to the right and down are."""
        return np.array([self._size[0], -self._size[1]])

    def result(self) -> Slip:
        """Return the maps of the frames so far; more may follow.

        Raises
        ------
        mirrorskin.io.InputError
            Too few frames, a body that does not move, or a sheet without texture.
        """
        if self._tracker is None or len(self._fields) < 2:
            raise InputError(f"{len(self._places)} frames tell no slip: at least 3 are needed")
        tracker, fields = self._tracker, self._fields
        variance = np.mean([field.variance for field in fields], axis=0)
        texture = Texture.of(tracker, variance, self._noise)
        texture.refuse_clear("the frames")
        codes = node_status(fields[-1], texture)
        moved = self._in_mm(tracker, fields, texture)
        course = _Course(np.array(self._places), *self._node_places(tracker), self._centre)
        departure, sigma = course.departures(moved, self._covariance(texture))
        if course.way[course.forward - 1] <= 0:
            raise InputError("the body does not move in these frames: take some along a slide or a twist")
        touched = self._touched(tracker, course, departure)
        drawn = np.sin(2 * np.pi * moved / self._scale) * self._scale  # to halves of a pixel, amplitude 1
        onsets = self._fit(tracker, course, departure, sigma, touched, drawn)
        contact = self._contact
        if contact is None:
            contact = (tracker.to_pixels(touched.astype(np.float64)) > 0.5) & (
                tracker.to_pixels(onsets.onset) > 0
            )
        status, onset = self._pixels(tracker, codes, onsets, contact, course.end)
        slipped = status == SlipStatus.SLIPPED
        noisy = np.einsum("yxii->yxi", self._covariance(texture))
        bent = bending_variance(moved[-1], noisy, self.step, self.window)
        noisy = noisy * misfit(fields[-1], texture, self.window) ** 2
        spread = tracker.positive_to_pixels(np.sqrt(np.mean(noisy + bent, axis=-1)))
        centre, angle = (
            (None, None)
            if self.position == "displacement"
            else self._turn(tracker, moved[-1], codes == FOUND, onsets.onset, course, touched)
        )
        last = tracker.to_pixels(moved[-1])
        return Slip(
            displacement=self._each(tracker, moved) if self._per_frame else last,
            displacement_sigma=np.where(np.isfinite(last[..., 0]), spread, np.float32(np.nan)),
            slip_onset=np.where(slipped, np.maximum(onset, 0), np.float32(np.nan)),
            slip_onset_sigma=np.where(slipped, tracker.positive_to_pixels(onsets.sigma), np.float32(np.nan)),
            status=status,
            contact=contact.astype(np.uint8),
            way=np.append(0.0, course.way),
            stick_ratio=course.stick_ratio(
                onset[(status == SlipStatus.SLIPPED) | (status == SlipStatus.STICKS)]
            ),
            centre=centre,
            angle=angle,
            noise=texture.noise,
        )

    def _in_mm(self, tracker: Tracker, fields: list[NodeField], texture: Texture) -> Doubles:
        """Return the displacement of the nodes, (T - 1, rows, columns, 2), mm; NaN where it was not found."""
        found = [(node_status(field, texture) == FOUND)[..., None] for field in fields]
        moved = [np.moveaxis(field.moved, 0, -1) * self._scale for field in fields]
        return np.where(np.stack(found), np.stack(moved), np.nan)

    def _covariance(self, texture: Texture) -> Doubles:
        """Return the covariance of a displacement, (rows, columns, 2, 2), mm^2 along x and y."""
        return np.asarray(texture.covariance * self._scale[:, None] * self._scale)

    def _each(self, tracker: Tracker, moved: Doubles) -> NDArray[np.float32]:
        rest = np.where(np.isfinite(moved[:1]).any(axis=0), 0.0, np.nan)
        return np.stack([tracker.to_pixels(part) for part in (rest, *moved)])

    def _node_places(self, tracker: Tracker) -> tuple[Doubles, Doubles]:
        """Return x and y of the nodes, mm from the picture's centre, (rows, columns)."""
        level = tracker.finest
        x, y = pixel_axes(self._shape, self._size)
        rows, columns = (level.start + level.step * np.arange(n) for n in level.grid)
        across, up = x[0] + columns * self._size[0], y[0] - rows * self._size[1]
        return np.broadcast_to(across, level.grid), np.broadcast_to(up[:, None], level.grid)

    def _touched(self, tracker: Tracker, course: _Course, departure: Doubles) -> NDArray[np.bool_]:
        """Return the nodes in contact: as given, or those that have gone along in the middle of the way."""
        if self._contact is not None:
            return np.asarray(tracker.at_nearest_pixels(self._contact))
        way = course.way[: course.forward, None, None] * course.reach
        with np.errstate(invalid="ignore", divide="ignore"):
            share = departure[: course.forward] / way
        known = np.isfinite(share).any(axis=0)
        lag = np.full(share.shape[1:], np.nan)
        lag[known] = np.nanmedian(share[:, known], axis=0)
        touched: NDArray[np.bool_] = np.nan_to_num(fill_with_nearest(lag), nan=1.0) < 1 - _FOLLOWS
        return touched

    def _fit(
        self,
        tracker: Tracker,
        course: _Course,
        departure: Doubles,
        sigma: Doubles,
        touched: NDArray[np.bool_],
        drawn: Doubles,
    ) -> OnsetMap:
        """Fit the onsets of the nodes in contact, in a box round them; elsewhere they are NaN."""
        onset, spread = np.full(touched.shape, np.nan), np.full(touched.shape, np.nan)
        if touched.any():
            rows, columns = np.nonzero(touched)
            box = np.s_[
                max(rows.min() - 2, 0) : rows.max() + 3, max(columns.min() - 2, 0) : columns.max() + 3
            ]
            # Windows overlap: what they say together is worth less.
            overlap = max(1.0, self.window / self.step)
            expected, radius = _EXPECTED[self.position], math.sqrt(touched.sum() / math.pi)
            if self._contact is None:
                expected = replace(expected, onset_bend=_BEND_ESTIMATED[self.position])
            known = np.where(touched, overlap * sigma, np.nan)
            locking = -np.nan_to_num(course.along(drawn * np.identity(2)[:, None, None, None]))
            found = fit_onsets(
                departure[: course.forward, *box],
                known[box],
                course.way[: course.forward],
                self.window / self.step,
                radius,
                expected,
                locking[:, : course.forward, *box],
            )
            onset[box], spread[box] = found.onset, found.sigma
        return OnsetMap(onset, spread)

    def _pixels(
        self,
        tracker: Tracker,
        codes: NDArray[np.uint8],
        onsets: OnsetMap,
        contact: NDArray[np.bool_],
        end: float,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the status, and the onset that it is of."""
        onset = tracker.to_pixels(onsets.onset)
        near = tracker.nearest(codes)
        status = np.where(onset < end, SlipStatus.SLIPPED, SlipStatus.STICKS)
        status = np.where(np.isfinite(onset), status, SlipStatus.UNKNOWN)
        status = np.where(
            near == FOUND, status, np.where(near == NO_TEXTURE, SlipStatus.NO_TEXTURE, SlipStatus.UNKNOWN)
        )
        return np.where(contact, status, SlipStatus.NO_CONTACT).astype(np.uint8), onset

    def _turn(
        self,
        tracker: Tracker,
        moved: Doubles,
        found: NDArray[np.bool_],
        onset: Doubles,
        course: _Course,
        touched: NDArray[np.bool_],
    ) -> tuple[tuple[float, float], float]:
        """Return what the skin that sticks turned about, and by how much (least squares: Kabsch, 1976)."""
        stuck = touched & found & ~(onset < course.end)
        if np.count_nonzero(stuck) < _LEAST_STUCK:
            return (math.nan, math.nan), math.nan
        first = course.x[stuck] + 1j * course.y[stuck]
        last = first + moved[stuck] @ np.array([1, 1j])
        about, to = first.mean(), last.mean()
        angle = float(np.angle(np.sum((last - to) * np.conj(first - about))))
        turn = np.exp(1j * angle)
        if abs(turn - 1) < _STILL:
            return (math.nan, math.nan), angle
        centre = (to - turn * about) / (1 - turn)
        return (float(centre.real), float(centre.imag)), angle


class _Course:
    """Where the body went, and with it the object in the body's frame.

    ``way``, (T - 1,), is its path since the first frame, to the last frame ``end``; ``forward`` says how many
    frames there are before it turns back, ``reach`` by how many millimetres a node goes along for each unit
    of the way.
    """

    def __init__(self, places: Doubles, x: Doubles, y: Doubles, centre: tuple[float, float]) -> None:
        self.x, self.y = x, y
        steps = np.diff(places, axis=0)
        lengths = np.sqrt(np.sum(steps**2, axis=1))
        self.way: Doubles = np.cumsum(lengths)
        from_start = np.sqrt(np.sum((places[1:] - places[0]) ** 2, axis=1))
        back = np.flatnonzero(np.diff(from_start, prepend=0.0) < -_STILL * self.way[-1])
        self.forward = int(back[0]) if back.size else len(self.way)
        self.end = float(self.way[self.forward - 1])
        self._moved = -(places[1:] - places[0])
        self._arms = x - centre[0], y - centre[1]
        twist = places.shape[1] == 1
        self.reach: Doubles = np.hypot(*self._arms) if twist else np.ones(x.shape)

    def _object(self, frame: int) -> Doubles:
        """Return how far the object has moved at the nodes, (rows, columns, 2), mm."""
        moved = self._moved[frame]
        if len(moved) == 2:
            return np.broadcast_to(moved, (*self.x.shape, 2))
        x, y = self._arms
        cosine, sine = math.cos(moved[0]) - 1, math.sin(moved[0])
        return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)

    @cached_property
    def _unit(self) -> Doubles:
        """The object's way in the last frame, of length 1, or 0 where it does not move."""
        last = self._object(self.forward - 1)
        length = np.sqrt(np.sum(last**2, axis=-1, keepdims=True))
        unit: Doubles = np.divide(last, length, out=np.zeros(last.shape), where=length > 0)
        return unit

    def along(self, moved: Doubles) -> Doubles:
        """Return what of displacements, (..., rows, columns, 2), is along the object's way."""
        return np.asarray(np.sum(moved * self._unit, axis=-1))

    def departures(self, moved: Doubles, covariance: Doubles) -> tuple[Doubles, Doubles]:
        """Return how far nodes lag behind the object, along its way in the last frame, and the sigma."""
        lags = [self.along(self._object(k) - part) for k, part in enumerate(moved)]
        variance = np.einsum("yxi,yxij,yxj->yx", self._unit, covariance, self._unit)
        return np.stack(lags), np.where(variance > 0, np.sqrt(np.maximum(variance, 0)), np.nan)

    def stick_ratio(self, onsets: NDArray[np.float32]) -> Doubles:
        """Return the share of onsets that are still to come, frame by frame."""
        ratio = np.full(len(self.way) + 1, np.nan)
        if onsets.size:
            behind = np.searchsorted(np.sort(onsets), self.way[: self.forward], side="left") / onsets.size
            ratio[0], ratio[1 : self.forward + 1] = 1.0, 1 - behind
        return ratio


def check_contact(contact: ArrayLike, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return where a map is not 0; raise InputError unless it is so somewhere in a picture of this shape."""
    given = np.asarray(contact)
    if given.shape != shape:
        size = f"{shape[0]} x {shape[1]}"
        raise InputError(
            f"contact has shape {given.shape}, the frames are {size}: give that of the same camera and region"
        )
    if not np.nan_to_num(given).any():
        raise InputError("contact is nowhere: give a map that is not 0 where the skin touches the object")
    return np.asarray(np.nan_to_num(given) != 0)
