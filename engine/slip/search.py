"""Displacement of the skin in all frames, where it sticks, and where and when it slips."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.slip.displacement import (
    XY,
    Texture,
    bending_variance,
    check_windows,
    misfit,
    node_status,
)
from mirrorskin.engine.slip.onset_map import Expected, Locking, OnsetMap, fit_onsets
from mirrorskin.engine.slip.tracking import NodeField, Tracker
from mirrorskin.io import Calibrated, InputError, Map, Recording, Result, pixel_axes
from mirrorskin.io.base.arguments import check_pixel_size
from mirrorskin.io.base.findings import carried
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.model.maps import TABLE, TWIST, DisplacementStatus, SlipStatus, status_of
from mirrorskin.io.model.positions import check_finite
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.io import Source
    from mirrorskin.io.base.types import ProcessValue


_EXPECTED = {  # see docs/method/slip.md
    "horizontal": Expected(power=1.6, onset_bend=12.0, growth_bend=32.0),
    "twist": Expected(power=1.4, onset_bend=24.0, growth_bend=4.0),
}
# At the rim of an estimated contact, windows of a slide contain free skin.
_BEND_ESTIMATED = {"horizontal": 64.0, "twist": 24.0}
_RIM, _ENOUGH = 0.5, 0.25  # windows left out at that rim, and least share of the nodes that are left
_ROUNDS = 2  # fits with an estimated contact: the first shows where free skin only followed the object
_MIN_FOLLOWING = 0.5  # minimum displacement of skin in contact, as a share of the object's
_LEAST_STUCK = 4  # minimum number of nodes for the centre and the angle of a twist
_REST_TOLERANCE = 1e-9  # motion, relative to the body's path, up to which it is at rest
_BLOCK = 16  # frames read at once


class SlipOnset(Operation):
    """Displacement of the skin, and where and when it slips while the body slides or twists.

    The first frame is the reference. In the body's frame, skin that sticks to an object at rest moves with
    the object; skin that lags behind it has slipped. The onset of slip is fitted to all frames
    (`mirrorskin.engine.slip.onset_map.fit_onsets`); see the documentation, "Slip".

    ``process`` contains the ``noise``, counts, and the origin of the ``contact``. For a twist it also
    contains the rotation of the sticking skin: its ``angle``, radians counter-clockwise, and its centre,
    ``centre_x`` and ``centre_y``, mm from the body's axis; they are NaN if too little skin sticks.

    Examples
    --------
    >>> import cv2
    >>> from mirrorskin import engine
    >>> texture = np.random.default_rng(1).normal(100, 20, (60, 80))
    >>> texture = cv2.GaussianBlur(texture, (0, 0), 1.5).astype(np.float32)
    >>> slip = engine.slip.SlipOnset(pixel_size=0.1, contact=np.ones((60, 80)), noise=0.1)
    >>> frames = [np.roll(texture, -k, axis=1) for k in range(4)]  # the skin sticks to the object
    >>> found = engine.run(frames, slip, displacement=np.outer(range(4), [0.1, 0.0]))
    >>> [round(float(part), 3) for part in found.displacement[30, 40]], int(found.status[30, 40])
    ([-0.3, 0.0], 2)
    """

    motions = ("horizontal", "twist")
    dtypes = FRAME_DTYPES
    least_frames = 3

    contact: Maps | None = option(
        default=None,
        file="RES.h5",
        help="where the skin touches the object in the first frame: the result of a press, or a map that is"
        " not 0 there. With a pressure, this is the contact; with heights only, the area of light, which is"
        " ahead of an elastic contact",
        shown_default="where the skin followed the object and did not slip from the start",
    )
    per_frame: bool = option(
        default=False, help="return the displacement in each frame, not only in the last"
    )
    window_size: int = option(
        default=8,
        unit="pixels",
        within=(6, None),
        help="side of the windows in which the texture is followed",
    )
    window_step: int = option(
        default=4, unit="pixels", within=(1, None), help="distance between the centres of adjacent windows"
    )
    noise: float | None = option(
        default=None,
        unit="counts",
        above=0,
        help="standard deviation of a sample",
        shown_default="estimated from the residuals, window by window",
    )
    motion: Literal["horizontal", "twist"] = option(
        default="horizontal",
        help="motion of the body: a slide along the sheet, or a rotation about its axis; from the source",
        python_only=True,
    )
    pixel_size: ArrayLike | None = option(
        default=None,
        unit="mm",
        help="millimetres along x and y, one number or both; from the source",
        python_only=True,
    )
    centre: tuple[float, float] = option(
        default=(0.0, 0.0),
        unit="mm",
        help="position of the body's axis, mm from the centre of the frames along x and y; from the source",
        python_only=True,
    )

    displacement = TABLE["displacement"]
    slip_onset = TABLE["slip_onset"]
    status = status_of(SlipStatus)
    slide_distance = TABLE["slide_distance"]
    twist_angle = TABLE["twist_angle"]
    stick_ratio = TABLE["stick_ratio"]
    optional_maps = ("slide_distance", "twist_angle")  # depending on the motion

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._position = "displacement" if self.motion == "horizontal" else "twist"
        self.positions = {self._position: True}  # type: ignore[misc]

    @property
    def declarations(self) -> Mapping[str, Map]:
        """Declarations of the maps; the onset in a twist is an angle."""
        return {**self.maps, "contact": TABLE["contact"], **(TWIST if self.motion == "twist" else {})}

    def configured_for(self, source: Source) -> Self:
        """Return the operation with motion, pixel size and axis of a source."""
        changes: dict[str, Any] = {"motion": source.motion}
        if self.pixel_size is None:
            changes["pixel_size"] = source.header.pixel_size
        recording = source.source if isinstance(source, Calibrated) else source
        if isinstance(recording, Recording) and source.header.pixel_size is not None:
            _, rows, columns = recording.full_shape
            right, up = recording.region.centre((rows, columns), source.header.pixel_size)
            changes["centre"] = -right, -up
        return self.with_options(**changes)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Check windows and contact."""
        if self.pixel_size is None:
            raise InputError("the pixel size is missing, which slip needs: give --pixel-size (pixel_size=)")
        self._size = check_pixel_size(self.pixel_size)
        check_windows(shape, self.window_size, self.window_step)
        self._contact, self._contact_origin, self._findings = read_contact(self.contact, shape)
        self._tracker: Tracker | None = None
        self._places: list[Doubles] = []
        self._fields: list[NodeField] = []

    @property
    def frames_at_once(self) -> int:
        """Number of frames that are read at once: few, as each takes long."""
        return min(_BLOCK, super().frames_at_once)

    def push(
        self, frames: NDArray[Any], *, displacement: ArrayLike | None = None, twist: ArrayLike | None = None
    ) -> None:
        """Process the next frames, (n, H, W), and the body's displacement, (n, 2) mm, or twist, (n,) rad."""
        width, values = ((2,), displacement) if twist is None else ((), twist)
        assert values is not None
        places = check_finite(values, len(frames), self._position, width=width).reshape(len(frames), -1)
        for frame, place in zip(frames, places, strict=True):
            if self._tracker is None:
                self._tracker = Tracker(frame.copy(), self.window_size, self.window_step, self.device)
            else:
                self._fields.append(self._tracker.follow(frame, self._stride(place)))
            self._places.append(place)

    def _stride(self, place: Doubles) -> float:
        """Return the step to a place as a multiple of the step before; 0 if the body was at rest."""
        if len(self._places) < 2:
            return 0.0
        before = self._places[-1] - self._places[-2]
        square = float(before @ before)
        return float(np.clip((place - self._places[-1]) @ before / square, -4, 4)) if square > 0 else 0.0

    def precompile(self) -> None:
        """Push a few frames of a texture, so that all kernels are compiled."""
        texture = np.random.default_rng(0).uniform(0, 200, self.shape).astype(self.dtype)
        place = np.zeros((1, 2) if self.motion == "horizontal" else 1)
        for _ in range(3):
            self.push(texture[np.newaxis], **{self._position: place})
            self.preview(0.0)

    def preview(self, seconds: float) -> Result:  # it takes a moment
        """Return the displacement in the newest frame, (H, W, 2); none before the second."""
        if self._tracker is None or not self._fields:
            return Result()
        field = self._fields[-1]
        moved = np.where(field.converged, field.moved, np.nan)
        return Result(displacement=self._tracker.to_pixels(np.moveaxis(moved, 0, -1) * self._scale))

    @property
    def _scale(self) -> Doubles:
        """Millimetres along x and y that correspond to a pixel to the right and down."""
        return np.array([self._size[0], -self._size[1]])

    def result(self) -> Result:
        """Return displacement and slip in the frames so far.

        Raises
        ------
        mirrorskin.io.InputError
            Too few frames, a body that does not move, or a sheet without texture.
        """
        assert self._tracker is not None
        tracker, fields = self._tracker, self._fields
        variance = np.mean([field.variance for field in fields], axis=0)
        texture = Texture.of(tracker.finest, variance, self.noise)
        texture.refuse_clear("the frames")
        codes = node_status(fields[-1], texture)
        moved = self._in_mm(tracker, fields, texture)
        course = _Course(np.array(self._places), *self._node_places(tracker), self.centre)
        departure, sigma = course.departures(moved, self._covariance(texture))
        if course.distance[course.forward - 1] <= 0:
            raise InputError("the body does not move in these frames: take some along a slide or a twist")
        touched = self._touched(tracker, course, departure)
        contact, followed = self._contact, touched
        for _ in range(_ROUNDS if contact is None else 1):
            onsets = self._fit(tracker, course, departure, sigma, touched)
            if contact is None:
                touched = touched & (onsets.onset > 0)
        if contact is None:
            contact = (tracker.to_pixels(followed.astype(np.float64)) > 0.5) & (
                tracker.to_pixels(onsets.onset) > 0
            )
        status, onset = self._pixels(tracker, codes, onsets, contact, course.end)
        slipped = status == SlipStatus.SLIPPED
        noisy = np.einsum("yxii->yxi", self._covariance(texture))
        bent = np.moveaxis(
            bending_variance(moved[-1] @ XY, np.moveaxis(noisy, -1, 0), self.window_step, self.window_size),
            0,
            -1,
        )
        noisy = noisy * misfit(fields[-1].variance, texture.variance, self.window_size)[..., None]
        spread = tracker.positive_to_pixels(np.sqrt(np.mean(noisy + bent, axis=-1)))
        last = tracker.to_pixels(moved[-1])
        process: dict[str, ProcessValue] = {
            "motion": self.motion,
            "frames": self.count,
            "noise": texture.noise,
            "contact": self._contact_origin,
            **self._findings,
        }
        if self.motion == "twist":
            detected = codes == DisplacementStatus.FOUND
            (x, y), angle = self._turn(tracker, moved[-1], detected, onsets.onset, course, touched)
            process |= {"angle": angle, "centre_x": x - self.centre[0], "centre_y": y - self.centre[1]}
        maps = {
            "displacement": self._each(tracker, moved) if self.per_frame else last,
            "displacement_sigma": np.where(np.isfinite(last[..., 0]), spread, np.float32(np.nan)),
            "slip_onset": np.where(slipped, np.maximum(onset, 0), np.float32(np.nan)),
            "slip_onset_sigma": np.where(
                slipped, tracker.positive_to_pixels(onsets.sigma), np.float32(np.nan)
            ),
            "status": status,
            "contact": contact.astype(np.uint8),
            "twist_angle" if self.motion == "twist" else "slide_distance": np.append(0.0, course.distance),
            "stick_ratio": course.stick_ratio(
                onset[(status == SlipStatus.SLIPPED) | (status == SlipStatus.STICKS)]
            ),
        }
        return Result(maps, process=process, declarations=self.declarations)

    def _in_mm(self, tracker: Tracker, fields: list[NodeField], texture: Texture) -> Doubles:
        """Return the displacement of the nodes, (T - 1, rows, columns, 2), mm; NaN where it was not found."""
        detected = [(node_status(field, texture) == DisplacementStatus.FOUND)[..., None] for field in fields]
        moved = [np.moveaxis(field.moved, 0, -1) * self._scale for field in fields]
        return np.where(np.stack(detected), np.stack(moved), np.nan)

    def _covariance(self, texture: Texture) -> Doubles:
        """Return the covariance of a displacement, (rows, columns, 2, 2), mm^2 along x and y."""
        return np.asarray(texture.covariance * self._scale[:, None] * self._scale)

    def _each(self, tracker: Tracker, moved: Doubles) -> NDArray[np.float32]:
        rest = np.where(np.isfinite(moved[:1]).any(axis=0), 0.0, np.nan)
        return np.asarray(tracker.to_pixels(np.stack([rest, *moved])))

    def _node_places(self, tracker: Tracker) -> tuple[Doubles, Doubles]:
        """Return x and y of the nodes, mm from the picture's centre, (rows, columns)."""
        level = tracker.finest
        x, y = pixel_axes(self.shape, self._size)
        rows, columns = (level.start + level.step * np.arange(n) for n in level.grid)
        across, up = x[0] + columns * self._size[0], y[0] - rows * self._size[1]
        return np.broadcast_to(across, level.grid), np.broadcast_to(up[:, None], level.grid)

    def _touched(self, tracker: Tracker, course: _Course, departure: Doubles) -> NDArray[np.bool_]:
        """Return the nodes in contact: as specified, or those that followed the object by half."""
        if self._contact is not None:
            return np.asarray(tracker.at_nearest_pixels(self._contact))
        distance = course.distance[: course.forward, None, None] * course.reach
        with np.errstate(invalid="ignore", divide="ignore"):
            fraction = departure[: course.forward] / distance
        measured = np.isfinite(fraction).any(axis=0)
        lag = np.full(fraction.shape[1:], np.nan)
        lag[measured] = np.nanmedian(fraction[:, measured], axis=0)
        touched: NDArray[np.bool_] = np.nan_to_num(fill_with_nearest(lag), nan=1.0) < 1 - _MIN_FOLLOWING
        return touched

    def _fit(
        self,
        tracker: Tracker,
        course: _Course,
        departure: Doubles,
        sigma: Doubles,
        touched: NDArray[np.bool_],
    ) -> OnsetMap:
        """Fit the onsets of the nodes in contact, in a box around them; elsewhere they are NaN."""
        onset, spread = np.full(touched.shape, np.nan), np.full(touched.shape, np.nan)
        if touched.any():
            rows, columns = np.nonzero(touched)
            box = np.s_[
                max(rows.min() - 2, 0) : rows.max() + 3, max(columns.min() - 2, 0) : columns.max() + 3
            ]
            # Windows overlap, so that the errors of adjacent nodes are correlated.
            overlap = max(1.0, self.window_size / self.window_step)
            expected, radius = _EXPECTED[self.motion], math.sqrt(touched.sum() / math.pi)
            if self._contact is None:
                expected = replace(expected, onset_bend=_BEND_ESTIMATED[self.motion])
            lock_sigma = np.where(self._inside(touched), overlap * sigma, np.nan)
            fit = fit_onsets(
                departure[: course.forward, *box],
                lock_sigma[box],
                course.distance[: course.forward],
                self.window_size / self.window_step,
                radius,
                expected,
                course.locking(np.array(self._size)).part(np.s_[..., *box]),
            )
            onset[box], spread[box] = fit.onset, fit.sigma
        return OnsetMap(onset, spread)

    def _inside(self, touched: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the nodes of a contact whose windows contain no free skin: all, if the contact is given.

        All nodes of an estimated contact are returned if few would be left.
        """
        if self._contact is not None:
            return touched
        reach = math.ceil(_RIM * self.window_size / self.window_step)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        inside = cv2.erode(touched.view(np.uint8), disc, borderValue=1) > 0
        return inside if np.mean(inside[touched]) > _ENOUGH else touched

    def _pixels(
        self,
        tracker: Tracker,
        codes: NDArray[np.uint8],
        onsets: OnsetMap,
        contact: NDArray[np.bool_],
        end: float,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the status and the onset of all pixels."""
        onset = tracker.to_pixels(onsets.onset)
        near = tracker.nearest(codes)
        status = np.where(onset < end, SlipStatus.SLIPPED, SlipStatus.STICKS)
        status = np.where(np.isfinite(onset), status, SlipStatus.UNKNOWN)
        missing = np.where(near == DisplacementStatus.NO_TEXTURE, SlipStatus.NO_TEXTURE, SlipStatus.UNKNOWN)
        status = np.where(near == DisplacementStatus.FOUND, status, missing)
        return np.where(contact, status, SlipStatus.NO_CONTACT).astype(np.uint8), onset

    def _turn(
        self,
        tracker: Tracker,
        moved: Doubles,
        detected: NDArray[np.bool_],
        onset: Doubles,
        course: _Course,
        touched: NDArray[np.bool_],
    ) -> tuple[tuple[float, float], float]:
        """Return centre and angle of the rotation of the skin that sticks (least squares: Kabsch, 1976)."""
        stuck = touched & detected & ~(onset < course.end)
        if np.count_nonzero(stuck) < _LEAST_STUCK:
            return (math.nan, math.nan), math.nan
        first = course.x[stuck] + 1j * course.y[stuck]
        last = first + moved[stuck] @ np.array([1, 1j])
        about, to = first.mean(), last.mean()
        angle = float(np.angle(np.sum((last - to) * np.conj(first - about))))
        turn = np.exp(1j * angle)
        if abs(turn - 1) < _REST_TOLERANCE:
            return (math.nan, math.nan), angle
        centre = (to - turn * about) / (1 - turn)
        return (float(centre.real), float(centre.imag)), angle


class _Course:
    """Trajectory of the body, and of the object in the body's frame.

    ``distance``, (T - 1,), mm or radians, is the length of the path since the first frame. ``end`` is its
    length before the body turns back, after ``forward`` frames. ``reach`` is the displacement of a node, mm,
    per unit of the path.
    """

    def __init__(self, places: Doubles, x: Doubles, y: Doubles, centre: tuple[float, float]) -> None:
        self.x, self.y = x, y
        steps = np.diff(places, axis=0)
        lengths = np.sqrt(np.sum(steps**2, axis=1))
        self.distance: Doubles = np.cumsum(lengths)
        from_start = np.sqrt(np.sum((places[1:] - places[0]) ** 2, axis=1))
        back = np.flatnonzero(np.diff(from_start, prepend=0.0) < -_REST_TOLERANCE * self.distance[-1])
        self.forward = int(back[0]) if back.size else len(self.distance)
        self.end = float(self.distance[self.forward - 1])
        self._moved = -(places[1:] - places[0])
        self._arms = x - centre[0], y - centre[1]
        twist = places.shape[1] == 1
        self.reach: Doubles = np.hypot(*self._arms) if twist else np.ones(x.shape)

    def _object(self, frame: int) -> Doubles:
        """Return the displacement of the object at the nodes, (rows, columns, 2), mm."""
        moved = self._moved[frame]
        if len(moved) == 2:
            return np.broadcast_to(moved, (*self.x.shape, 2))
        x, y = self._arms
        cosine, sine = math.cos(moved[0]) - 1, math.sin(moved[0])
        return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)

    @cached_property
    def _unit(self) -> Doubles:
        """Unit vector of the object's displacement in the last frame; 0 if it does not move."""
        last = self._object(self.forward - 1)
        length = np.sqrt(np.sum(last**2, axis=-1, keepdims=True))
        unit: Doubles = np.divide(last, length, out=np.zeros(last.shape), where=length > 0)
        return unit

    def along(self, moved: Doubles) -> Doubles:
        """Return the components of displacements, (..., rows, columns, 2), along the object's."""
        return np.asarray(np.sum(moved * self._unit, axis=-1))

    def locking(self, size: Doubles) -> Locking:
        """Return the bias of displacements with pixels of a size, (2,) mm, before the body turns back."""
        rest = np.stack([self._object(frame) for frame in range(self.forward)]) / size
        return Locking(np.moveaxis(rest, -1, 0), np.moveaxis(self._unit / size, -1, 0), size)

    def departures(self, moved: Doubles, covariance: Doubles) -> tuple[Doubles, Doubles]:
        """Return the lag of nodes behind the object, along its displacement, and its sigma."""
        lags = [self.along(self._object(k) - part) for k, part in enumerate(moved)]
        variance = np.einsum("yxi,yxij,yxj->yx", self._unit, covariance, self._unit)
        return np.stack(lags), np.where(variance > 0, np.sqrt(np.maximum(variance, 0)), np.nan)

    def stick_ratio(self, onsets: NDArray[np.float32]) -> Doubles:
        """Return the share of onsets later than each frame."""
        ratio = np.full(len(self.distance) + 1, np.nan)
        if onsets.size:
            behind = (
                np.searchsorted(np.sort(onsets), self.distance[: self.forward], side="left") / onsets.size
            )
            ratio[0], ratio[1 : self.forward + 1] = 1.0, 1 - behind
        return ratio


def read_contact(
    contact: Maps | None, shape: tuple[int, int], needed: bool = True
) -> tuple[NDArray[np.bool_] | None, str, dict[str, str]]:
    """Return the contact, if it is specified, its origin for ``process``, and the findings of its result.

    If a contact is not ``needed``, it may be nowhere.
    """
    if contact is None:
        return None, "estimated", {}
    result = as_result(contact, "contact", quantity="contact")
    try:
        touched, origin = _contact_of(result, shape)
        if needed and not touched.any():
            raise InputError("contact is nowhere: give a map that is not 0 where the skin touches the object")
        return touched, origin, carried({}, contact=result.process)
    except InputError as error:
        path = os.fspath(contact) if isinstance(contact, str | os.PathLike) else ""
        raise (error if path in str(error) else InputError(f"{path}: {error}")) from None


def _contact_of(result: Result, shape: tuple[int, int]) -> tuple[NDArray[np.bool_], str]:
    if result.fitted.undistorted:
        raise InputError("the contact is undistorted, and the frames are not: make it without a lens")
    if result.pressure is not None:
        return _check_contact(result.pressure > 0, shape), "given"
    if result.contact is not None:
        return _check_contact(result.contact, shape), "given"
    if result.height is None:
        raise InputError("the contact's result has neither contact nor heights: give that of a press")
    return _check_contact(np.isfinite(result.height), shape), "given, by light"


def _check_contact(contact: NDArray[Any], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels where a map is not 0; raise InputError for another shape."""
    if contact.shape != shape:
        size = f"{shape[0]} x {shape[1]}"
        raise InputError(
            f"contact has shape {contact.shape}, the frames are {size}:"
            " give that of the same camera and region"
        )
    touched = np.asarray(contact != 0)
    return touched & ~np.isnan(contact) if contact.dtype.kind == "f" else touched
