"""The visible texture of the sheet: the flakes of its mirror coat, or printed dots."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.twin.skin import FLAKES
from mirrorskin.twin.body import check_values
from mirrorskin.twin.movement import Pose
from mirrorskin.twin.optics import Ideal, Wall
from mirrorskin.twin.scene import Light
from mirrorskin.twin.skin import Elastic, Sheet
from mirrorskin.twin.slip import Drag, Grip, SkinHistory, SkinState
from mirrorskin.twin.view import View

TextureName = Literal["flakes", "dots", "random-dots"]
TEXTURES: tuple[TextureName, ...] = get_args(TextureName)

_PIXELS_MIN = 2.0  # minimum size of a flake or a dot
_PITCH = 2.0  # distance between dots, in diameters
_RIM = 0.3  # width of a dot's soft rim, in diameters
_STILL = 1e-7  # mm and radians; smaller motions are ignored
_JITTER = (_PITCH - 1 - _RIM) / 2  # maximum displacement of a random dot along x and y, in diameters


@dataclass(frozen=True, slots=True)
class SheetTexture:
    """The reflectance of the sheet by position, fixed in the sheet, without limits.

    A point of the sheet reflects the share r = 1 - contrast t of the light, with t from 0 to 1. The share
    ``diffuse`` of the reflected light comes from the whole wall, because flakes have all orientations, and
    the rest from the direction of the mirror. A pixel that gets the light m from the mirror shows r ((1 -
    diffuse) m + diffuse), so the texture is also visible in the dark.

    Attributes
    ----------
    kind : {"flakes", "dots", "random-dots"}
        Of "flakes", t is a cubic B-spline whose coefficients are 0 or 1 at random, spaced by half the size.
        Of "dots", t is 1 inside of dots in a square grid of twice their diameter, and falls to 0 over a soft
        rim; "random-dots" lie up to a third of their diameter off their places.
    size : float
        Diameter of a dot, or width of the speckle's autocorrelation at half of its height, mm.
    contrast : float
        Above 0 and at most 1.
    diffuse : float
        0 to 1.
    seed : int
        Seed of the texture.

    Raises
    ------
    InputError
        A value is invalid.

    Examples
    --------
    >>> dots = SheetTexture("dots", size=0.5, contrast=0.4)
    >>> dots.reflectance(np.array([[0.5, 1.0], [0.5, 1.0]])).round(3).tolist()
    [0.6, 1.0]
    """

    kind: TextureName = "flakes"
    size: float = 0.1
    contrast: float = 0.5
    diffuse: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in TEXTURES:
            raise InputError(f"texture {self.kind!r} is unknown: take {', '.join(TEXTURES)}")
        rules = {
            "size": (0 < self.size < math.inf, "mm, more than 0"),
            "contrast": (0 < self.contrast <= 1, "a share, more than 0 and at most 1"),
            "diffuse": (0 <= self.diffuse <= 1, "a share, 0 to 1"),
            "seed": (isinstance(self.seed, int | np.integer) and self.seed >= 0, "a whole number, 0 or more"),
        }
        check_values(self, "texture", rules)

    def reflectance(self, places: Floats, pixel_size: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """Return the share of the light that the sheet reflects around points, by x and y, (2, ...), mm.

        Dots have rims, and are averaged over four points of a pixel of `pixel_size`, mm; flakes are smooth.
        """
        if self.kind == "flakes":
            return 1 - self.contrast * self._flakes(places)
        across, up = (size / 4 for size in pixel_size)
        x, y = places
        quarters = [np.stack([x + i * across, y + j * up]) for j in (-1, 1) for i in (-1, 1)]
        fraction: Floats = np.mean([self._dots(part) for part in quarters], axis=0)
        return 1 - self.contrast * fraction

    def shown(self, reflectance: NDArray[Any], light: Light) -> Light:
        """Return the share of full light of pixels that get a light from the mirror."""
        return np.asarray(reflectance * ((1 - self.diffuse) * light + self.diffuse), np.float32)

    def _flakes(self, places: Floats) -> Floats:
        from scipy.ndimage import map_coordinates

        index = places / self.spacing
        flakes = self.coefficients.astype(np.float64)
        spline: Floats = map_coordinates(flakes, index, order=3, mode="grid-wrap", prefilter=False)
        return spline

    @property
    def coefficients(self) -> NDArray[np.uint8]:
        """Coefficients of the flakes' spline by x and y, 0 or 1, periodic."""
        return np.asarray(_random(self.seed, 1)[0] < 0.5, np.uint8)

    @property
    def spacing(self) -> float:
        """Distance between coefficients, mm."""
        return self.size / 2

    def _dots(self, places: Floats) -> Floats:
        index = places / (_PITCH * self.size)
        cell = np.floor(index)
        off = (index - cell - 0.5) * _PITCH
        if self.kind == "random-dots":
            row, column = cell.astype(np.intp) % FLAKES
            off -= (2 * _JITTER) * (_random(self.seed, 2)[:, row, column] - 0.5)
        inwards = np.clip((0.5 - np.hypot(*off)) / _RIM + 0.5, 0, 1)
        return np.asarray(inwards**2 * (3 - 2 * inwards))


@functools.lru_cache(maxsize=2)
def _random(seed: int, count: int) -> Floats:
    return np.random.default_rng(seed).random((count, FLAKES, FLAKES))


class Coat:
    """Optics of a sheet with a texture, which moves with the skin.

    Without a history the skin moves only along its normal, like a conforming skin, or the surface of an
    incompressible body under pressure.

    Attributes
    ----------
    rest : ndarray, (H, W), float64
        The reflectance that pixels see of the sheet at rest.
    """

    texture: SheetTexture
    optics: Ideal | Wall

    def __init__(self, texture: SheetTexture, optics: Ideal | Wall, view: View, device: Device) -> None:
        if texture.size < _PIXELS_MIN * max(view.pixel_size):
            raise InputError(
                f"a texture of {texture.size:g} mm is too fine for pixels of "
                f"{max(view.pixel_size):g} mm: use {_PIXELS_MIN:g} pixels or more"
            )
        self.texture, self.optics, self._view, self._device = texture, optics, view, device
        self.rest: Floats = texture.reflectance(np.stack([view.x, view.y]), view.pixel_size)

    def levels(self, dark: ArrayLike, bright: ArrayLike) -> tuple[Floats, Floats]:
        """Return the counts of pixels without and with full light, from the camera's levels."""
        dark, bright = np.asarray(dark, np.float64), np.asarray(bright, np.float64)
        span = (bright - dark) * self.rest
        return dark + span * self.texture.diffuse, dark + span

    def light(self, sheet: Sheet) -> Light:
        """Return the share of full light at each pixel, (H, W), float32, without tangential motion."""
        return self.shade(self.optics.light(sheet), sheet.height)

    def shade(
        self, light: Light, height: Floats, frame: float = 0.0, history: SkinHistory | SkinState | None = None
    ) -> Light:
        """Return the light of pixels for the light from the mirror and the sheet's height at a frame."""
        view = self._view
        if view.orthographic and history is None:
            return self.texture.shown(self.rest, light)
        off = np.stack([height * view.slope_x, height * view.slope_y])
        if history is not None and self.texture.kind == "flakes":
            fraction = self._flakes.share(history.drag(frame), off)
            return self.texture.shown(1 - self.texture.contrast * fraction, light)
        points = np.stack([view.x, view.y]) + off
        if history is not None:
            points = history.drag(frame).material(points)
        return self.texture.shown(self.texture.reflectance(points, view.pixel_size), light)

    @functools.cached_property
    def _flakes(self) -> _DraggedFlakes:
        return _DraggedFlakes(self.texture, self._view, self._device)


class _DraggedFlakes:
    """The share of flakes that each pixel sees on dragged skin, on a device."""

    def __init__(self, texture: SheetTexture, view: View, device: Device) -> None:
        self._device, self._shape = device, view.shape
        self._seen = device.array("seen", (2, *view.shape), np.float32)
        self._share = device.array("share", view.shape, np.float32)
        self._given: dict[str, Any] = {
            "flakes": device.from_host("flakes", texture.coefficients, np.uint8),
            "spacing": texture.spacing,
        }
        for axis, places in (("x", view.x[0]), ("y", view.y[:, 0])):
            index = places / texture.spacing
            self._given[f"cell_{axis}"] = device.from_host("cell", np.floor(index), np.int32)
            self._given[f"part_{axis}"] = device.from_host("part", index - np.floor(index))

    def share(self, drag: Drag, off: Floats) -> Light:
        """Return the share, (H, W), at points displaced from the pixels' positions at rest, (2, H, W), mm."""
        self._seen.write(off)
        drag.launch(
            "skin_flakes", self._device, self._shape, visible=self._seen, fraction=self._share, **self._given
        )
        return self._share.read()


class DraggedCoat:
    """The same for a body that moves from pose to pose and whose skin is dragged by friction.

    It slides or twists from where it was pressed, not both; in between it may be pressed more or less. A lean
    releases the skin.
    """

    def __init__(self, coat: Coat, skin: Elastic, coefficient: float) -> None:
        self._coat, self._skin, self._coefficient = coat, skin, coefficient
        self._travel: float | None = None
        self._place = self._pressed_at = np.zeros(3)
        self._state: SkinState | None = None
        self._twists = False

    @property
    def grip(self) -> Grip:
        """The present force along the sheet, and how far the object has slid."""
        return Grip(np.zeros(2), np.zeros(2)) if self._state is None else self._state.grip

    def shade(self, light: Light, height: Floats, pose: Pose, _: float) -> Light:
        """Return the light of pixels for the light from the mirror, in the pose after the previous ones."""
        rotation, travel = pose.rotation, float(pose.shift[2])
        x, y, _ = -rotation.T @ pose.shift
        place = np.array([x, y, math.atan2(rotation[0, 1], rotation[0, 0])])
        if rotation[2, 2] < 1 - _STILL:
            self._travel, self._pressed_at, self._state = travel, place, None
        elif self._travel is None:
            self._travel = travel
        elif abs(travel - self._travel) > _STILL:
            self._press(travel, place)
        delta = place - self._pressed_at
        twists = bool(abs(delta[2]) > _STILL)
        if twists != self._twists:
            self._twists, self._state = twists, None
        if self._state is None and abs(delta).max() > _STILL:
            self._state = SkinState(self._skin, travel, self._coefficient)
        if self._state is not None:
            self._state.go(delta[2:] if twists else delta[:2])
        self._place = place
        return self._coat.shade(light, height, history=self._state)

    def _press(self, travel: float, place: Floats) -> None:
        """Press to another travel on the way to a place; what touches is held by friction."""
        assert self._travel is not None
        if self._state is None and abs(place - self._place).max() > _STILL:
            self._state = SkinState(self._skin, self._travel, self._coefficient)
        if self._state is not None and self._state.touches:
            self._state.press(travel)
        if self._state is None or not self._state.touches:
            self._pressed_at, self._state = place, None
        self._travel = travel
