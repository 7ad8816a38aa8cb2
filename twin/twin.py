"""The twin as a source of frames of a body that moves on an object."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Block, Closing, Floats, Header, InputError, Truth
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.twin.body import Body
from mirrorskin.twin.camera import Camera, Sensor
from mirrorskin.twin.catalogue import check_fits, make_object
from mirrorskin.twin.movement import Horizontal, Movement, Pose, Twist, Vertical, pose_at_press
from mirrorskin.twin.objects import Object, Shifted, zenith_azimuth
from mirrorskin.twin.obstacle import meet
from mirrorskin.twin.optics import Ideal, Wall
from mirrorskin.twin.pattern import Linear, Pattern, Uniform, make_pattern
from mirrorskin.twin.references import ReferenceName, ball_references, exact_references
from mirrorskin.twin.scene import Imprint, Scene, Shade, Witness
from mirrorskin.twin.skin import Conform, Elastic, Sheet
from mirrorskin.twin.slip import Grip, SkinHistory
from mirrorskin.twin.texture import Coat, DraggedCoat, SheetTexture
from mirrorskin.twin.view import View

ContactName = Literal["conform", "elastic"]
OpticsName = Literal["ideal", "cylinder"]

_CAMERA = "twin"
_PIXELS_MAX = 200_000_000
_MEMORY = 512_000_000  # maximum size of cached light, bytes
_REACH_POSES = 16  # number of poses that determine the reach of an object
_ALL = 1e3  # travel at which any object is completely below the body, mm
_IN_WORDS = {
    "conform": "sheet takes the object's shape",
    "elastic": "elastic body",
    "ideal": "ideal optics",
    "cylinder": "traced wall",
}


class Twin(Closing):
    """The simulated sensor: a `mirrorskin.io.Source` with ground truth.

    For each frame the position of the body, the sheet on the object (contact), the lit wall as seen in the
    sheet (optics), and the counts (camera) are computed.

    Parameters
    ----------
    object : Object, str or Path
        Object to press on; names and paths are passed to `make_object`.
    object_shift : (float, float)
        Position of the object's centre, mm along x and y from the picture's centre; its height is unchanged,
        so its highest point need not be in the picture.
    shape : (int, int)
        Rows and columns of a frame.
    pixel_size : float or (float, float)
        Millimetres at the sheet along x and y.
    movement : Movement
        `Vertical`, `Axial`, `Horizontal` or `Twist`.
    contact : {"conform", "elastic"}
        Whether the sheet takes the object's shape, as in eq. 1 of the paper, or is the surface of an elastic
        body.
    optics : {"ideal", "cylinder"}
        Whether brightness depends on the zenith only, or is traced to the wall.
    pattern : str or Path
        Of the wall: "uniform", "linear" in the zenith, or a picture, unrolled.
    body : Body
    camera : Camera
    texture : SheetTexture, optional
        Texture of the sheet, which moves with the skin; the skin moves along itself in
        horizontal movements and twists in elastic contact. References show the texture of the sheet at rest.
    references : {"exact", "ball"}
        Origin of the header's dark and bright: the camera's exact levels, or frames as taken in a laboratory
        them; see `ball_references`.
    device : str or Device, optional
        Device for rendering; see `mirrorskin.kernels.device.open_device`.

    Attributes
    ----------
    name, motion, shape, dtype, rewindable
        As for every source.
    movement : Movement
    travel : ndarray, (T,), float64, or None
        Millimetres, of a vertical movement.
    frame_rate : float
        Frames per second.
    exposure : float
        Seconds during which a frame gathers light.

    Raises
    ------
    InputError
        A value cannot be, the object is unknown or too large, or its file unusable.
    """

    frame_rate: float
    exposure: float

    rewindable = True

    def __init__(
        self,
        *,
        object: Object | str | Path,  # noqa: A002 - the word users know it by
        shape: tuple[int, int],
        pixel_size: float | tuple[float, float],
        movement: Movement,
        object_shift: tuple[float, float] = (0.0, 0.0),
        contact: ContactName = "conform",
        optics: OpticsName = "ideal",
        pattern: str | Path = "uniform",
        body: Body | None = None,
        camera: Camera | None = None,
        texture: SheetTexture | None = None,
        references: ReferenceName = "exact",
        device: str | Device | None = None,
    ) -> None:
        field = _check_shape(shape)
        pixel = _check_pixel_size(pixel_size)
        for name, value, kind in (
            ("contact", contact, ContactName),
            ("optics", optics, OpticsName),
            ("references", references, ReferenceName),
        ):
            if value not in get_args(kind):
                raise InputError(f"{name} {value!r} is unknown: take {', '.join(get_args(kind))}")
        self._body = body or Body()
        self._camera = camera or Camera()
        self._names, self._references, self._texture = (contact, optics), references, texture
        self._thing = make_object(object, field, pixel) if isinstance(object, str | Path) else object
        if any(object_shift):
            if not np.isfinite(object_shift).all():
                raise InputError(
                    f"object shift {object_shift} is not possible: give two finite numbers of mm"
                )
            self._thing = Shifted(self._thing, object_shift)

        self.name: str = f"twin: {self._thing.name}"
        self.movement = movement
        self.motion = movement.motion
        self.travel: Floats | None = movement.positions if isinstance(movement, Vertical) else None
        self.shape: tuple[int, int, int] = (len(movement.positions), *field)
        self.dtype: np.dtype[Any] = self._camera.dtype
        self.frame_rate, self.exposure = self._camera.frame_rate, self._camera.exposure

        check_fits(self._thing, self._body.radius)
        self._check_movement()
        self._view = View(field, pixel, self._body, self._camera.distance)
        if not self._view.on_body.any():
            raise InputError(
                f"no pixel of {pixel[0]:g} x {pixel[1]:g} mm lies on the sensor: take smaller ones"
            )
        self._pattern = make_pattern(pattern, self._body)
        self._sensor = Sensor(self._camera, field, open_device(device))
        self._skin = self._make_skin()
        self._history = self._make_history()
        self._optics = self._make_optics(self._pattern)
        self._witness = Witness(self._skin, field)
        self._scene = self._make_scene()
        self._next = 0

    @functools.cached_property
    def header(self) -> Header:
        """Metadata of all frames; the references are computed at the first access."""
        if self._references == "exact":
            dark, bright = exact_references(self._sensor, self._optics)
        else:
            dark, bright = ball_references(self._make_optics(Uniform()), self._sensor, self._view)
        gain, offset = self._zenith_scale() or (None, None)
        how = ", ".join(_IN_WORDS[name] for name in self._names)
        return replace(
            self.movement.header(),
            title=f"Digital twin, {self._thing.name}, {self.motion} motion, {how}",
            pixel_size=self._view.pixel_size,
            dark=dark,
            bright=bright,
            zenith_gain=gain,
            zenith_offset=offset,
            camera=_CAMERA,
        )

    @functools.cached_property
    def truth(self) -> Truth:
        """The object under the upright body, and where it touches, sticks and slips.

        Under an oblique view, the point that a pixel sees depends on the depth. The maps of a vertical
        movement then refer to the point at which its ray meets the rest plane. Those of other movements refer
        to the point that it sees of the pressed object, NaN where the object does not reach the rest plane.
        The azimuth is NaN where the surface is level. Contact is that at the greatest travel of a movement
        that presses, and contact in all frames of other movements. Slip and displacement are available for
        horizontal movements and twists in elastic contact, the force for all elastic contact.

        It is computed at the first access; after the last frame most of it is already available.
        """
        vertical, view, movement = isinstance(self.movement, Vertical), self._view, self.movement
        pressed = pose_at_press(movement.deepest)
        if vertical or view.orthographic:
            height, slopes = self._thing.height(view.x, view.y), self._thing.slope(view.x, view.y)
        else:
            obstacle = meet(self._thing, pressed, view)
            height, slopes = obstacle.height - movement.deepest, (obstacle.dz_dx, obstacle.dz_dy)
        zenith, azimuth = zenith_azimuth(*slopes)
        frames = range(self.shape[0])
        if movement.presses:
            contact = self._skin.drape(pressed).contact
        else:
            for frame, late in itertools.product(frames, self._scene.moments):
                self._witness.force(movement.pose_at(frame, late))
            contact = self._witness.touched
        force = slip = onset = displacement = None
        if isinstance(self._skin, Elastic):
            force = np.zeros((len(frames), 3))
            force[:, 2] = [self._witness.force(movement.pose_at(frame)) for frame in frames]
            if self._history is not None:
                force[:, :2], onset = self._history.force, self._history.slip_onset.astype(np.float32)
                slip = np.isfinite(onset).astype(np.uint8)
                displacement = self._history.displacements()
        return Truth(
            height=height.astype(np.float32),
            zenith=zenith.astype(np.float32),
            azimuth=azimuth.astype(np.float32),
            contact=contact.astype(np.uint8),
            slip=slip,
            force=force,
            displacement=displacement,
            slip_onset=onset,
        )

    def sheet(self, frame: int) -> Sheet:
        """Return the sheet at the middle of a frame's exposure; computed at each call."""
        return self._skin.drape(self.movement.pose_at(frame))

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def skip(self, count: int) -> None:
        """Skip some frames without rendering them."""
        self._next = min(self._next + count, self.shape[0])

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Render the next frames.

        Parameters
        ----------
        out : ndarray, (n, H, W), the source's dtype, optional
            Takes up to n frames; without it one frame comes in a new array.

        Returns
        -------
        Block or None
            The frames with their time and the body's positions; None after the last.

        Raises
        ------
        InputError
            The buffer does not fit the frames.
        """
        if out is None:
            out = np.empty((1, *self.shape[1:]), self.dtype)
        if out.dtype != self.dtype or out.shape[1:] != self.shape[1:] or len(out) == 0:
            raise InputError(
                f"{self.name}: a buffer of {out.dtype} {out.shape} does not fit:"
                f" give {self.dtype} (n, {self.shape[1]}, {self.shape[2]}), n 1 or more"
            )
        first = self._next
        frames = out[: self.shape[0] - first]
        if len(frames) == 0:
            return None
        history = self._history
        if history is not None:
            numbers = range(first, first + len(frames))
            poses = itertools.starmap(self.movement.pose_at, itertools.product(numbers, self._scene.moments))
            self._scene.render_ahead(poses, meanwhile=lambda: history.force)
        for k, frame in enumerate(frames, start=first):
            light = self._scene.light(functools.partial(self.movement.pose_at, k), k)
            self._sensor.expose(light, k, frame)
        self._next = first + len(frames)
        time = np.arange(first, self._next) / self._camera.frame_rate
        return self.movement.mark(Block(frames, index=first, time=time))

    def look(
        self, pose_at: Callable[[float], Pose], number: int, out: NDArray[Any], strength: float = 1.0
    ) -> None:
        """Render one frame at any position of the body, as for a camera next to a stage.

        The counts equal those of `read` for the same frame number and positions. In elastic contact, friction
        depends on the poses rendered before. The movement only bounds the positions; in elastic contact,
        parts of the object reached elsewhere are ignored.

        Parameters
        ----------
        pose_at : callable
            Returns the pose at a time after the exposure's middle, seconds.
        number : int
            Frame number, which determines the noise.
        out : ndarray, (H, W), the source's dtype
            Output.
        strength : float
            Light times exposure, relative to those of the camera's levels.
        """
        light = self._anywhere.light(pose_at)
        self._sensor.expose(light if strength == 1 else light * np.float32(strength), number, out)

    @property
    def grip(self) -> Grip:
        """Force along the sheet, and slide, at the last `look`, of a texture in elastic contact; else 0."""
        return Grip(np.zeros(2), np.zeros(2)) if self._dragged is None else self._dragged.grip

    @functools.cached_property
    def _anywhere(self) -> Scene:
        coat, skin, optics, shade = self._optics, self._skin, self._optics, None
        if self._dragged is not None and isinstance(coat, Coat):
            optics, shade = coat.optics, self._dragged.shade
        return Scene(skin, optics, self._camera.exposure, imprint=self._imprint, shade=shade)

    @functools.cached_property
    def _dragged(self) -> DraggedCoat | None:
        if isinstance(self._optics, Coat) and isinstance(self._skin, Elastic):
            return DraggedCoat(self._optics, self._skin, self._body.friction)
        return None

    @functools.cached_property
    def _imprint(self) -> Imprint | None:
        """The imprint of a press, if the frames need only their travel."""
        skin, optics, view = self._skin, self._optics, self._view
        if self._names != ("conform", "ideal") or not view.orthographic:
            return None
        touched, untouched = (skin.drape(pose_at_press(depth)) for depth in (_ALL, -_ALL))
        height = np.where(touched.contact, self._thing.height(view.x, view.y), np.nan)
        return Imprint(height, optics.light(touched), optics.light(untouched))

    def _check_movement(self) -> None:
        rise = self.movement.rise(self._body.radius)
        if rise >= self._body.height:
            raise InputError(
                f"the {self._thing.name} may rise {rise:g} mm into the sensor's body, whose "
                f"height is {self._body.height:g} mm: press less, or use a nearer pivot"
            )
        if self._compliance > 0 and self._names[0] == "conform":
            raise InputError("compliance needs contact 'elastic': a conforming sheet has no force")

    @property
    def _compliance(self) -> float:
        return self.movement.compliance if isinstance(self.movement, Vertical) else 0.0

    def _make_skin(self) -> Conform | Elastic:
        if self._names[0] == "conform":
            return Conform(self._thing, self._view)
        movement = self.movement
        poses = [movement.pose(place) for place in _spread(movement.reduced(movement.path))]
        poses.append(pose_at_press(movement.deepest))
        return Elastic(self._thing, poses, self._view, self._body, self._compliance, movement.deepest)

    def _make_history(self) -> SkinHistory | None:
        skin, movement = self._skin, self.movement
        if isinstance(skin, Elastic) and isinstance(movement, Horizontal | Twist):
            return SkinHistory(skin, movement, self._body.friction, self._sensor.device)
        return None

    def _make_optics(self, pattern: Pattern) -> Ideal | Wall | Coat:
        optics: Ideal | Wall
        if self._names[1] == "ideal":
            optics = Ideal(self._body, pattern)
        else:
            optics = Wall(self._body, pattern, self._view, self._sensor.device)
        return (
            optics if self._texture is None else Coat(self._texture, optics, self._view, self._sensor.device)
        )

    def _make_scene(self) -> Scene:
        fraction = self._camera.exposure * self._camera.frame_rate
        coat, history, optics = self._optics, self._history, self._optics
        shade: Shade | None = None
        if isinstance(coat, Coat) and history is not None:
            optics, shade = coat.optics, lambda light, z, _, frame: coat.shade(light, z, frame, history)
        each = (np.dtype(np.float64).itemsize if shade else 0) + np.dtype(np.float32).itemsize
        count = _MEMORY // (each * self._view.x.size)
        imprint = self._imprint if isinstance(self.movement, Vertical) else None
        return Scene(self._witness, optics, fraction, count, imprint, shade)

    def _zenith_scale(self) -> tuple[Floats, Floats] | None:
        """Return counts per radian of zenith and at zenith 0, where brightness is linear in it."""
        pattern = self._pattern
        if self._names[1] != "ideal" or not isinstance(pattern, Linear):
            return None
        dark, bright = np.asarray(self._camera.dark), np.asarray(self._camera.bright)
        if self._references == "exact":
            dark, bright = (levels.astype(np.float64) for levels in (self._sensor.offset, self._sensor.full))
        if isinstance(self._optics, Coat):
            dark, bright = self._optics.levels(dark, bright)
        return (bright - dark) * pattern.gain, dark + (bright - dark) * pattern.offset


def _spread(places: Floats) -> Floats:
    """Return some of the positions: the extremes along each coordinate, and others between them."""
    places = np.unique(places, axis=0)
    flat = places.reshape(len(places), -1)
    some = np.linspace(0, len(places) - 1, _REACH_POSES).round().astype(np.intp)
    chosen: Floats = places[np.unique([*some, *flat.argmin(axis=0), *flat.argmax(axis=0)])]
    return chosen


def _check_shape(shape: tuple[int, int]) -> tuple[int, int]:
    if len(shape) != 2 or min(shape) < 1:
        raise InputError(f"shape {tuple(shape)} is not possible: give rows and columns, 1 or more of each")
    if shape[0] * shape[1] > _PIXELS_MAX:
        raise InputError(f"shape {tuple(shape)} is too large: the maximum is {_PIXELS_MAX} pixels")
    return int(shape[0]), int(shape[1])


def _check_pixel_size(pixel_size: float | tuple[float, float]) -> tuple[float, float]:
    sizes = np.asarray(pixel_size, np.float64)
    if sizes.shape not in ((), (2,)) or not (np.isfinite(sizes) & (sizes > 0)).all():
        raise InputError(
            f"pixel size {pixel_size} is not possible: give one positive number of mm, or x and y"
        )
    along_x, along_y = np.broadcast_to(sizes, 2)
    return float(along_x), float(along_y)
