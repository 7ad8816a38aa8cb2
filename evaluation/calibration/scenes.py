"""A laboratory for calibrations: the twin with a real wall and imperfect pixels, lamps and lens.

The light of a press is worked out once, and kept where a folder is given; any camera then looks at it, with
noise of its own in each take. Objects are those of the judge (`calibration_scorer`), in closed form.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin import io
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.calibration import scorer
from mirrorskin.evaluation.calibration.scorer import Map, Rig, Surface
from mirrorskin.twin import Axial, Body, Camera, Twin, Vertical
from mirrorskin.twin.camera import Sensor

EIGHTHS = tuple(float(phase) for phase in np.arange(8) * np.pi / 4)
BALL = 4.0  # mm, that the calibration is made with
DEPTH = 0.4  # mm, that it is pressed: its contact ends at 37 degrees, in sight

_ROWS = 1024  # of a printed pattern
_FIRST = 1000  # number of a take's first frame: the noise goes by frames' numbers
_LIGHT: dict[str, Any] = {"dtype": np.dtype(np.float32), "noise": 0.0}


class Thing(NamedTuple):
    """An object of the judge's as the twin takes it."""

    surface: Surface

    @property
    def name(self) -> str:
        """Its name, which tells it from others."""
        return self.surface.name

    @property
    def radius(self) -> float:
        """How far it reaches, mm."""
        return self.surface.reach

    def height(self, x: Map, y: Map, /) -> Map:
        """Return its heights, mm."""
        return self.surface.height(x, y)

    def slope(self, x: Map, y: Map, /) -> tuple[Map, Map]:
        """Return its slopes."""
        return self.surface.slope(x, y)


@dataclass(frozen=True, slots=True)
class Lab:
    """A sensor as it was built, and its camera.

    Recordings tell the movement as it was meant: the true tilt is greater by ``tilt_error``, the true phase
    by ``phase_error``, and the true pivot higher by ``pivot_error``, mm.
    """

    shape: tuple[int, int] = (320, 320)
    pixel_size: float = 0.0375
    tilt: float = math.radians(2.5)
    phase: tuple[float, ...] = EIGHTHS
    pivot: tuple[float, float, float] = (0.3, -0.2, 2.0)
    asymmetry: float = 0.05
    lamp_azimuth: float = 0.7
    distance: float = 200.0
    scatter: float = math.radians(3.0)
    gamma: float = 1.0
    uniform: bool = False
    noise: float = 1.5
    gain_deviation: float = 0.05
    seed: int = 11
    tilt_error: float = 0.0
    phase_error: float = 0.0
    pivot_error: float = 0.0
    cache: Path | None = None

    @property
    def body(self) -> Body:
        """The twin's body."""
        return Body(scatter=self.scatter, asymmetry=self.asymmetry, asymmetry_azimuth=self.lamp_azimuth)

    @property
    def camera(self) -> Camera:
        """The twin's camera, with noise."""
        return Camera(
            noise=self.noise, seed=self.seed, gain_deviation=self.gain_deviation, distance=self.distance
        )

    @property
    def half(self) -> tuple[float, float]:
        """Half the picture's width and height, mm."""
        return self.shape[1] * self.pixel_size / 2, self.shape[0] * self.pixel_size / 2

    @property
    def rig(self) -> Rig:
        """What the judge must know of it."""
        body, camera = self.body, self.camera
        return Rig(
            tilt=self.tilt,
            phase=self.phase,
            pivot=self.pivot,
            radius=body.radius,
            rim=body.height,
            index=body.index,
            distance=self.distance,
            scatter=self.scatter,
            asymmetry=self.asymmetry,
            lamp_azimuth=self.lamp_azimuth,
            dark_zenith=math.atan2(body.radius, body.height) / 2,
            gamma=self.gamma,
            span=camera.bright - camera.dark,
            spread=math.hypot(self.noise, 1 / math.sqrt(12)),
        )

    def flat(self, light: float, frames: int, take: int) -> Frames:
        """Return frames of a field that is all alike, as dark and bright references are taken."""
        field = np.full((1, *self.shape), light, np.float32)
        header = io.Header("axial", title=f"flat field of {light:g}", pixel_size=self._pixel)
        phase = np.linspace(0, 2 * np.pi, frames, endpoint=False)
        return Frames(
            self._exposed(np.repeat(field, frames, axis=0), take), header, header.title, phase=phase
        )

    def turned(self, surface: Surface, press: float, take: int) -> Frames:
        """Return an axial recording of an object."""
        movement = Axial(np.array(self.phase), self.tilt, press, self.pivot)
        light = self._light(surface, movement, ("axial", self.phase, self.tilt, press, self.pivot))
        x, y, z = self.pivot
        header = replace(
            movement.header(),
            title=surface.name,
            pixel_size=self._pixel,
            tilt=self.tilt - self.tilt_error,
            pivot=(x, y, z - self.pivot_error),
        )
        phase = np.array(self.phase) - self.phase_error
        return Frames(self._exposed(light, take), header, surface.name, phase=phase)

    def pressed(self, surface: Surface, travel: Map, take: int, compliance: float = 0.0) -> Frames:
        """Return a vertical recording of an object under an elastic body."""
        movement = Vertical(travel, compliance=compliance)
        key = ("elastic", travel.tolist(), compliance)
        light = self._light(surface, movement, key, contact="elastic")
        header = replace(movement.header(), title=surface.name, pixel_size=self._pixel)
        return Frames(self._exposed(light, take), header, surface.name, travel=travel)

    def lowered(self, surface: Surface, travel: Map, take: int) -> Frames:
        """Return a vertical recording of an object that the sheet follows."""
        movement = Vertical(travel)
        light = self._light(surface, movement, ("vertical", travel.tolist()))
        header = replace(movement.header(), title=surface.name, pixel_size=self._pixel)
        return Frames(self._exposed(light, take), header, surface.name, travel=travel)

    @property
    def _pixel(self) -> tuple[float, float]:
        return self.pixel_size, self.pixel_size

    def _exposed(self, light: NDArray[np.float32], take: int) -> NDArray[Any]:
        """Let the camera look; frames of another take have other noise."""
        sensor = Sensor(self.camera, self.shape)
        frames = np.empty(light.shape, sensor.dtype)
        for number, (frame, out) in enumerate(zip(light, frames, strict=True)):
            sensor.expose(np.ascontiguousarray(frame), _FIRST * take + number, out)
        return frames

    def _light(self, surface: Surface, movement: Any, key: Any, **options: Any) -> NDArray[np.float32]:
        """Return the light of all frames, (T, H, W): from the folder, or traced."""
        optics = self.shape, self.pixel_size, self.body, self.distance, self.gamma, self.uniform
        name = hashlib.sha256(repr((surface.name, key, optics, options)).encode()).hexdigest()[:24]
        kept = None if self.cache is None else self.cache / f"{name}.npy"
        if kept is not None and kept.exists():
            return np.asarray(np.load(kept))
        camera = Camera(distance=self.distance, **_LIGHT)
        twin = Twin(
            object=Thing(surface),
            shape=self.shape,
            pixel_size=self.pixel_size,
            movement=movement,
            optics="cylinder",
            pattern=self._pattern(),
            body=self.body,
            camera=camera,
            **options,
        )
        frames = np.empty(twin.shape, np.float32)
        twin.read(frames)
        light = (frames - np.float32(camera.dark)) / np.float32(camera.bright - camera.dark)
        if kept is not None:
            np.save(kept, light)
        return light

    def _pattern(self) -> str | Path:
        """Return the print: its name, or its picture, which needs a folder."""
        if self.uniform or self.gamma == 1:
            return "uniform" if self.uniform else "linear"
        if self.cache is None:
            raise ValueError("a printed picture needs a folder: give cache")
        path = self.cache / f"gamma-{self.gamma:g}.png"
        if not path.exists():
            cv2.imwrite(str(path), self._picture())
        return path

    def _picture(self) -> NDArray[np.uint16]:
        """Return the print's transmittance from the rim down, alike all round, of 16 bits."""
        body = self.body
        height = body.height * (1 - (np.arange(_ROWS) + 0.5) / _ROWS)
        first = math.atan2(body.radius, body.height) / 2
        fraction = (np.arctan2(body.radius, height) / 2 - first) / (math.pi / 4 - first)
        column = np.rint(np.iinfo(np.uint16).max * np.clip(fraction, 0, 1) ** self.gamma)
        return np.repeat(column.astype(np.uint16)[:, np.newaxis], 4, axis=1)


def in_other_light(source: Frames, light: float, dark: ArrayLike, noise: float, seed: int) -> Frames:
    """Return a recording in a share of the light above dark levels, with the same noise, counts."""
    random = np.random.default_rng(seed).standard_normal(source.frames.shape)
    counts = dark + light * (source.frames - np.asarray(dark)) + math.sqrt(1 - light**2) * noise * random
    frames = np.clip(np.rint(counts), 0, 255).astype(source.dtype)
    return Frames(frames, source.header, source.name, **source.series)


def nine_balls(lab: Lab, apart: float, first_take: int) -> list[Frames]:
    """Return the axial recordings of the calibration's ball at nine places."""
    places = [(x * apart, y * apart) for y in (1, 0, -1) for x in (-1, 0, 1)]
    return [
        lab.turned(scorer.ball(BALL, place), DEPTH, first_take + number)
        for number, place in enumerate(places)
    ]


def held_out(reach: float) -> list[tuple[Surface, float]]:
    """Return objects that no calibration is made with, and how far to press: they cover a field so wide, mm.

    Faces of every zenith that a wall shows look every way, at every place of the field.
    """
    things = [scorer.waves(0.22, 2.4, 0.35, reach), scorer.waves(0.12, 1.9, 1.2, reach)]
    for zenith, turned, aside in ((17, 0.2, 0.7), (23, 1.0, 0.4), (29, 2.1, 0.8), (35, 0.6, 1.1)):
        things.append(scorer.facets(math.radians(zenith), 1.3, turned, aside, reach))
    return [(thing, press_for(thing)) for thing in things]


def press_for(surface: Surface) -> float:
    """Return by how much to press so that a body that leans by 2.5 degrees still touches all of an object."""
    axis = np.linspace(-2.5, 2.5, 401)
    lowest = np.nanmin(surface.height(*np.meshgrid(axis, axis)))
    return float(np.round(0.45 - lowest, 2))


def balls() -> list[tuple[Surface, float]]:
    """Return balls and a cone that no calibration is made with, and how far to press."""
    places = ((3.0, (2.2, 1.4)), (6.0, (-1.0, -1.5)))
    objects = [(scorer.ball(size, place), 0.13 * size) for size, place in places]
    return [*objects, (scorer.cone(math.radians(30), 4.0, (0.8, -0.6)), 1.6)]
