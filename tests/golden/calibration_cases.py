"""Calibration, lenses and live estimators, called from Python."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from engine_cases import (
    PIXEL,
    RECONSTRUCTED,
    Source,
    blocks,
    named,
    press_source,
    result_maps,
    turn_source,
)
from golden import FITTED, Answer, Tolerance, case
from scenes import EIGHTHS, TILT, dome, places, turn

from mirrorskin import engine, io
from mirrorskin.engine.base.undistort import undistort
from mirrorskin.engine.calibration import (
    BallTrack,
    Dots,
    PlateTrack,
    calibrate_lens,
    fit_precession,
    fit_zenith,
    measure_references,
)
from mirrorskin.engine.live import LiveRun
from mirrorskin.twin import Axial, Body, Camera, Twin


def still(level: Any, count: int, seed: int, name: str) -> Source:
    """Return frames of pixels at these levels, with noise."""
    noise = np.random.default_rng(seed).normal(0, 1.3, (count, *np.shape(level)[-2:]))
    frames = np.clip(np.rint(level + noise), 0, 255).astype(np.uint8)
    source = Source(frames, io.Header("vertical", camera="lab"), travel=0.01 * np.arange(count))
    source.name = name
    return source


@case(FITTED)
def measure_references_of_flat_fields() -> Answer:
    random = np.random.default_rng(3)
    dark, light = random.normal(15, 1, (21, 33)), random.normal(180, 6, (21, 33))
    dark[3, 4], light[8, 9], light[12, 2] = 90, 0, 280
    flat = measure_references([still(dark, 24, 1, "dark")], [still(dark + light, 24, 2, "bright")])
    ball = np.where(random.random((60, 21, 33)) < 0.4, dark + light, dark + 0.3 * light)
    rolled = measure_references([still(dark, 24, 1, "dark")], [still(ball, 60, 4, "ball")], rolled=True)
    answers = {}
    for name, measured in ("flat", flat), ("rolled", rolled):
        maps = measured.references
        answers[name] = {
            "dark": maps.dark,
            "bright": maps.bright,
            "dark_sigma": maps.dark_sigma,
            "bright_sigma": maps.bright_sigma,
            "defects": maps.defects,
            "noise": np.array([measured.dark.noise, measured.bright.noise]),
        }
    return named(**answers)


@case(FITTED, numbers=Tolerance(1e-4, 1e-6))
def calibrate_a_lens() -> Answer:
    column, row = np.meshgrid(np.arange(160.0), np.arange(130.0))
    u, v = (column - 79.5) / 150, (row - 64.5) / 150
    bend = 1 + 0.05 * (u * u + v * v)
    x, y = 10.5 * u * bend + 0.2, 10.5 * v * bend - 0.1
    away = np.hypot((x + 0.5) % 1 - 0.5, y % 1 - 0.5)
    light = np.clip((away - 0.25) / 0.06 + 0.5, 0, 1)
    beyond = (np.abs(x) > 3.4) | (np.abs(y) > 3.0)
    picture = np.rint(40 + 160 * np.where(beyond, 1.0, light)).astype(np.uint8)
    result = calibrate_lens([("board", picture)], Dots(7, 6, 1.0))
    lens = result.lens
    numbers = [*lens.pixel_size, lens.error, lens.scale_sigma, result.worst]
    return {
        "camera": lens.camera,
        "distortion": lens.distortion,
        "numbers": np.array(numbers),
        "marks": result.marks,
    }


@case(FITTED, numbers=Tolerance(1e-5, 1e-6), sigma=Tolerance(1e-3, 1e-9))
def fit_a_precession() -> Answer:
    tilt, turned, pivot = 0.0441, 0.05, np.array([0.3, -0.2, 12.0])
    alpha = EIGHTHS + turned
    tracks = [
        BallTrack(EIGHTHS, *followed(place, tilt, alpha, pivot)) for place in ((-2, 1, -1.5), (3, 2, -1.5))
    ]
    zenith = tilt + np.random.default_rng(9).normal(0, 5e-5, 8)
    fitted = fit_precession(tracks, [PlateTrack(EIGHTHS, zenith, np.full(8, 5e-5), True)])
    precession = fitted.precession
    numbers = [
        precession.tilt,
        precession.phase_offset,
        precession.ellipticity,
        *precession.centre,
        *precession.pivot,
    ]
    return {
        "numbers": np.array(numbers),
        "direction": precession.direction,
        "sigma": np.array([precession.sigma[name] for name in sorted(precession.sigma)]),
        "notes": list(fitted.notes),
    }


def followed(place: Any, tilt: float, alpha: Any, pivot: Any) -> tuple[Any, Any]:
    """Return where a ball is seen while the body leans about its pivot: rotated by the opposite turn."""
    axis = np.stack([-np.sin(alpha), np.cos(alpha), 0 * alpha], axis=1)
    arm = np.asarray(place, float) - pivot
    along = axis * (axis @ arm)[:, None]
    position = along + (arm - along) * np.cos(tilt) + np.cross(axis, arm) * np.sin(tilt) + pivot
    sigma = np.broadcast_to([1e-3, 1e-3, 3e-3], position.shape).copy()
    return position + sigma * np.random.default_rng(int(10 * place[0]) + 50).normal(
        size=position.shape
    ), sigma


@dataclass(frozen=True)
class Ball:
    """A ball of 4 mm at a place, for the twin."""

    x: float
    y: float
    name: str = "ball"
    radius: float = 9.0

    def height(self, x: Any, y: Any, /) -> Any:
        """Return its heights, mm."""
        square = 4.0 - (x - self.x) ** 2 - (y - self.y) ** 2
        return np.sqrt(np.where(square > 0, square, np.nan)) - 2

    def slope(self, x: Any, y: Any, /) -> Any:
        """Return its slopes."""
        rise = self.height(x, y) + 2
        return -(x - self.x) / rise, -(y - self.y) / rise


@case(FITTED, numbers=Tolerance(1e-4, 1e-6), curve=Tolerance(1e-3, 1e-4), map=Tolerance(1e-2, 1e-6))
def fit_a_wall() -> Answer:
    presses = []
    for number, place in enumerate(((0.2, 0.1), (-3.6, -3.4), (3.5, -3.6), (-3.4, 3.6), (3.6, 3.3)), 1):
        twin = Twin(
            object=Ball(*place),
            shape=(48, 48),
            pixel_size=0.25,
            movement=Axial(EIGHTHS, TILT, 0.9),
            optics="cylinder",
            pattern="linear",
            body=Body(asymmetry=0.05, asymmetry_azimuth=1.0),
            camera=Camera(noise=1.0, seed=number, distance=150.0),
            references="exact",
        )
        frames = np.empty(twin.shape, twin.dtype)
        twin.read(frames)
        presses.append(Source(frames, twin.header, phase=EIGHTHS))
    fitted = fit_zenith(presses, 2.0, body=(16.6, 42.0))
    numbers = [
        fitted.radius,
        fitted.rim,
        *fitted.axis,
        *fitted.sight,
        *fitted.lamps,
        *fitted.reach,
        fitted.error,
    ]
    return {
        "frames": np.stack([press.frames for press in presses]),
        "numbers": np.array(numbers),
        "curve": fitted.curve,
        "zenith.map": fitted.zenith_sigma,
        "azimuth.map": fitted.azimuth_sigma,
    }


@case(FITTED)
def undistort_maps() -> Answer:
    shape = (40, 52)
    matrix = np.array([[60.0, 0.0, 25.5], [0.0, 60.0, 19.5], [0.0, 0.0, 1.0]])
    plane = np.array([[0.05, 0.002, -1.3], [0.001, -0.06, 1.2], [1e-4, -2e-4, 1.0]])
    lens = io.Lens(PIXEL, plane, np.array([-0.1, 0.02, 1e-3, -2e-3, 0.0]), matrix, shape, 0.05)
    height, along_x, along_y = dome(shape)
    normals = np.stack([-along_x, -along_y, np.ones(shape)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    x, y = places(shape)
    height[np.hypot(x, y) < 0.2] = np.nan
    axis_x, axis_y = io.pixel_axes(shape, PIXEL)
    result = io.Result(
        height=height.astype(np.float32),
        normals=normals.astype(np.float32),
        azimuth=np.arctan2(-along_y, -along_x).astype(np.float32),
        contact=(np.hypot(x, y) < 1.0).astype(np.uint8),
        x=axis_x,
        y=axis_y,
    )
    return result_maps(undistort(result, lens))


@case(FITTED, **RECONSTRUCTED)
def live_press() -> Answer:
    source = press_source()
    live = LiveRun(source, engine.Press())
    for block in blocks(
        source.frames, [1, 1, 3, 2, 7], time=0.01 * np.arange(24), travel=source.series["travel"]
    ):
        live.push_block(block)
        update = live.maps()
    answers = {"contact": update.get("contact"), "height": update.get("height")}
    return named(update=answers, result=result_maps(live.result()))


@case(FITTED, **RECONSTRUCTED)
def live_rotation() -> Answer:
    source = turn_source(3)
    live = LiveRun(source, engine.Rotation(window_frames=8, noise=20.0, blur=0.0))
    updates = {}
    series = {"time": 0.01 * np.arange(24), "phase": source.series["phase"]}
    for number, block in enumerate(blocks(source.frames, [1, 7, 1, 4, 8], **series)):
        live.push_block(block)
        update = live.maps()
        updates[f"update_{number}"] = {
            "normals": update.get("normals"),
            "height": update.get("height"),
            "contact": update.get("contact"),
        }
        live.idle_work(0.0)
    final = {"result": result_maps(live.result())}
    return named(**{name: updates[name] for name in ("update_1", "update_5")}, **final)


@case(FITTED, **RECONSTRUCTED)
def reconstruct_with_a_calibration() -> Answer:
    shape = (40, 52)
    source = turn_source(pivot=(0.4, -0.3, 5.0))
    alpha = 0.4 - EIGHTHS  # as a stage says that goes round the other way
    frames = turn("uint16", shape)[0]
    precession = io.Precession(TILT, 0.4, -1, 0.0, 0.0, (0.0, 0.0), (0.4, -0.3, 5.0))
    camera = io.CameraId("lab", shape, np.dtype("uint16"))
    calibration = io.Calibration(camera, precession=precession)
    return result_maps(engine.reconstruct(Source(frames, source.header, phase=alpha), calibration))
