"""Recordings of a surface by a camera with a fault, and how each estimator answers to them."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mirrorskin import engine
from mirrorskin.evaluation.faults.camera import (
    DARK,
    POINTS,
    SPAN,
    Fault,
    Floats,
    Light,
    centres,
    points,
    record,
    references,
)
from mirrorskin.evaluation.faults.judge import Answer, Watched, watched
from mirrorskin.io import Result
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.io.model.frames import lossy

PIXEL = 0.05  # mm
STEEPEST, TILT = np.radians(55), np.radians(2.5)
ZENITH = np.radians(35)  # of the lamps of photometric stereo
SHIFT = 0.4 * PIXEL  # mm along x, from the reference to the frame
_recorded = functools.lru_cache(maxsize=128)


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights of a surface and how they change along x and y.

    Attributes
    ----------
    name : str
    fine : (3, rows, columns) array
        At the points at which light is computed.
    true : (3, H, W) array
        At the centres of pixels.
    travel : (float, float)
        Start and end of a press, mm.
    """

    name: str
    fine: Floats
    true: Floats
    travel: tuple[float, float]

    @classmethod
    def from_function(
        cls,
        name: str,
        function: Callable[[Floats, Floats], tuple[Floats, Floats, Floats]],
        shape: tuple[int, int],
        travel: tuple[float, float],
    ) -> Surface:
        """Return the surface whose heights and slopes a function of x and y computes."""
        fine, true = (np.stack(function(*places(shape, PIXEL))) for places in (points, centres))
        return cls(name, fine, true, travel)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its picture."""
        return self.true.shape[1], self.true.shape[2]

    @property
    def height(self) -> Floats:
        """Heights at the centres of pixels, (H, W), mm."""
        return np.asarray(self.true[0])


# --- Light ---------------------------------------------------------------------------------------------


def touched(surface: Surface) -> Light:
    """Return the light of a press: the share of the surroundings of a point that the sheet touches."""
    height, along_x, along_y = surface.fine
    width = (np.abs(along_x) + np.abs(along_y)) * PIXEL / POINTS + 1e-9
    return lambda travel: np.clip((travel + height) / width + 0.5, 0, 1)


def normals_of(heights: Floats) -> Floats:
    """Return the normals, (..., 3), of heights and slopes."""
    _, along_x, along_y = heights
    normal = np.stack([-along_x, -along_y, np.ones_like(along_x)], axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def leaning(surface: Surface, tilt: float = TILT) -> Light:
    """Return the light of a rotation: proportional to the angle between the normal and the body's axis."""
    normal = normals_of(surface.fine)

    def light(phase: Floats) -> Floats:
        lean = math.sin(tilt) * (normal[..., 0] * np.cos(phase) + normal[..., 1] * np.sin(phase))
        return np.asarray(np.arccos(np.clip(normal[..., 2] * math.cos(tilt) - lean, -1, 1)) / STEEPEST)

    return light


def _fringes(x: Floats, y: Floats) -> Floats:
    return 2 * np.pi * x / 0.8 + 1.2 * np.sin(2 * np.pi * y / 2.1)


def _lit(surface: Surface) -> Light:
    """Return the light of a matt surface under a lamp at an azimuth."""
    normal = normals_of(surface.fine)

    def light(phase: Floats) -> Floats:
        lamp = math.sin(ZENITH) * (normal[..., 0] * np.cos(phase) + normal[..., 1] * np.sin(phase))
        return 0.8 * np.maximum(lamp + math.cos(ZENITH) * normal[..., 2], 0)

    return light


@functools.cache
def _texture() -> Floats:
    """Return directions, phases and amplitudes of the waves of a speckled surface, (3 + 1, n)."""
    generator = np.random.default_rng(3)
    angle, length = generator.uniform(0, 2 * np.pi, 60), generator.uniform(4, 10, 60) * PIXEL
    phase = generator.uniform(0, 2 * np.pi, 60)
    return np.stack([2 * np.pi * np.cos(angle) / length, 2 * np.pi * np.sin(angle) / length, phase])


def _speckle(shape: tuple[int, int]) -> Light:
    """Return the light of a speckled surface that moves along x, by a shift a frame."""
    x, y = points(shape, PIXEL)

    def light(number: Floats) -> Floats:
        moved = x - number * SHIFT
        waves = sum(np.cos(along * moved + up * y + phase) for along, up, phase in _texture().T)
        return 0.5 + 0.35 * np.tanh(np.asarray(waves) / 8)

    return light


_BLURS = np.arange(0, 8.1, 0.5)  # standard deviations of a defocused point, points


@functools.cache
def _defocused(shape: tuple[int, int]) -> Floats:
    """Return the speckled surface out of focus, (blurs, points, points)."""
    sharp = _speckle(shape)(np.zeros((1, 1, 1)))[0]
    return np.stack([gaussian_filter(sharp, blur, mode="nearest") if blur else sharp for blur in _BLURS])


def _focused(surface: Surface) -> Light:
    """Return the light of a speckled surface through a lens in focus at the travel."""

    def light(travel: Floats) -> Floats:
        blur = np.clip(np.sqrt(1 + (15 * (travel + surface.fine[0])) ** 2), 0, _BLURS[-2])[0]
        number = blur / _BLURS[1]
        low = np.floor(number).astype(int)
        levels, fraction = _defocused(surface.shape), number - low
        at = np.arange(blur.shape[0])[:, np.newaxis], np.arange(blur.shape[1])
        return np.asarray((1 - fraction) * levels[low, *at] + fraction * levels[low + 1, *at])[np.newaxis]

    return light


# --- Recordings ----------------------------------------------------------------------------------------


def _opened(frames: Any, positions: dict[str, Any], header: dict[str, Any], fault: Fault) -> ArrayRecording:
    """Return frames as a source, which says that they were compressed, as that of a file does."""
    source = ArrayRecording(frames, positions, header)
    if fault.stated_codec:
        source.findings = (lossy(fault.stated_codec),)
    return source


@_recorded
def pressed(surface: Surface, step: float, fault: Fault, seed: int) -> ArrayRecording:
    """Return a press."""
    fault = fault.drawn(seed)
    travel = np.arange(*surface.travel, step)
    frames = record(touched(surface), travel, fault, seed)
    dark, bright = references(surface.shape, fault, seed + 1)
    header = {"pixel_size": (PIXEL, PIXEL), "dark": dark.astype("f4"), "bright": bright.astype("f4")}
    if not fault.stated:
        return _opened(frames, {"travel": travel}, header, fault)
    if fault.jitter:
        header["travel_sigma"] = fault.jitter * step
    if fault.shutter:  # the travel and the time of a frame are those of its middle row
        header["line_time"] = fault.shutter * POINTS / (POINTS * surface.shape[0] - 1)
        travel = travel + fault.shutter * step / 2
    source = _opened(frames, {"travel": travel}, header, fault)
    source.time = np.arange(len(travel), dtype=float)
    return source


@_recorded
def turned(surface: Surface, fault: Fault, seed: int, turns: int = 1, count: int = 16) -> ArrayRecording:
    """Return a rotation, with ``count`` frames a turn."""
    fault = fault.drawn(seed)
    phase = np.arange(turns * count) * 2 * np.pi / count
    light = leaning(surface, fault.tilt * TILT)
    frames = record(lambda at: light(at + fault.turned), phase, fault, seed, period=count)
    return _opened(frames, {"phase": phase}, {"pixel_size": (PIXEL, PIXEL), "tilt": TILT}, fault)


def zenith_scale(fault: Fault) -> dict[str, Any]:
    """Return the options of a rotation that state how brightness depends on the zenith."""
    return {
        "zenith_gain": fault.scale * fault.exposure * SPAN / STEEPEST,
        "zenith_offset": fault.scale * DARK,
    }


def noise_of(fault: Fault) -> float:
    """Return the standard deviation of a sample, as a user would state it, counts."""
    return math.hypot(fault.read_noise, math.sqrt(128 / fault.electrons)) * fault.scale


# --- Answers -------------------------------------------------------------------------------------------


Answers = Callable[[Surface, Fault, int], Answer]


def of_press(step: float, compute: Callable[[ArrayRecording], Result]) -> Answers:
    """Return the heights of a press with steps, by a function of its recording."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        result, *said = watched(lambda: compute(pressed(surface, step, fault, seed)))
        return Answer(result.height - surface.height, result.height_sigma, *said)

    return answer


def _angle(normals: NDArray[Any], true: Floats) -> Floats:
    across = np.linalg.norm(np.cross(normals.astype(np.float64), true), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(normals * true, axis=-1)))


Turn = Callable[[Surface, Fault, int], Result]
"""Return the result of a rotation."""


@functools.lru_cache(maxsize=32)
def _turn(compute: Turn, surface: Surface, fault: Fault, seed: int) -> Watched:
    return watched(lambda: compute(surface, fault, seed))


def of_normals(compute: Turn) -> Answers:
    """Return the normals of a rotation."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        result, *said = _turn(compute, surface, fault, seed)
        return Answer(_angle(result.normals, normals_of(surface.true)), result.normals_sigma, *said)

    return answer


def of_integration(compute: Turn) -> Answers:
    """Return the heights of a rotation, about their mean in the largest component."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        result, *said = _turn(compute, surface, fault, seed)
        largest = np.bincount(result.component[result.component >= 0]).argmax()
        error = np.where(result.component == largest, result.height - surface.height, np.nan)
        return Answer(error - np.nanmean(error), result.height_sigma, *said)

    return answer


def of_fusion(compute: Turn) -> Answers:
    """Return the heights of a press and a rotation."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        result, *said = watched(lambda: compute(surface, fault, seed))
        return Answer(result.height - surface.height, result.height_sigma, *said)

    return answer


def of_fringes(compute: Callable[[ArrayRecording], Result]) -> Answers:
    """Return the phases of fringes on a flat surface of the same size."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        phase = _fringes(*points(surface.shape, PIXEL))
        shift = np.arange(8) * np.pi / 4
        frames = record(lambda at: 0.5 + 0.4 * np.cos(phase - at), shift, fault, seed)
        result, *said = watched(lambda: compute(_opened(frames, {"phase": shift}, {}, fault)))
        error = result.phase - _fringes(*centres(surface.shape, PIXEL))
        return Answer(np.arctan2(np.sin(error), np.cos(error)), result.phase_sigma, *said)

    return answer


def of_photometric(compute: Callable[..., Result]) -> Answers:
    """Return the normals of a matt surface under 12 lamps."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        azimuth = np.arange(12) * np.pi / 6
        frames = record(_lit(surface), azimuth, fault, seed)
        source = _opened(frames, {"phase": azimuth}, {"dark": np.float32(DARK * fault.scale)}, fault)
        result, *said = watched(lambda: compute(source, zenith=ZENITH, shadow=6 * fault.scale))
        return Answer(_angle(result.normals, normals_of(surface.true)), result.normals_sigma, *said)

    return answer


def of_displacement(surface: Surface, fault: Fault, seed: int) -> Answer:
    """Return the displacement of a flat speckled surface of the same size."""
    reference, frame = record(_speckle(surface.shape), np.arange(2.0), fault, seed)
    result, *said = watched(
        lambda: engine.slip.find_displacement(reference, frame[np.newaxis], PIXEL, window_size=12)
    )
    return Answer(result.displacement[0, ..., 0] - SHIFT, result.displacement_sigma[0, ..., 0], *said)


def of_focus(compute: Callable[[ArrayRecording, float], Result]) -> Answers:
    """Return the heights of a speckled surface by focus."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        travel = np.arange(surface.travel[0], surface.travel[1] - 0.1, 0.05)
        frames = record(_focused(surface), travel, fault, seed)
        source = _opened(frames, {"travel": travel}, {}, fault)
        result, *said = watched(lambda: compute(source, noise_of(fault)))
        return Answer(result.height - surface.height, result.height_sigma, *said)

    return answer


# --- Estimators ----------------------------------------------------------------------------------------


def _press_recording(source: ArrayRecording) -> Result:
    return engine.reconstruct(source, fill=False)


def _change_point_recording(source: ArrayRecording) -> Result:
    return engine.reconstruct(source, fill=False, method="change-point")


def _reconstruct_turn(surface: Surface, fault: Fault, seed: int) -> Result:
    return engine.reconstruct(turned(surface, fault, seed), **zenith_scale(fault))


def _reconstruct_turns(surface: Surface, fault: Fault, seed: int) -> Result:
    return engine.reconstruct(turned(surface, fault, seed, 2), **zenith_scale(fault))


def _fuse_recordings(surface: Surface, fault: Fault, seed: int) -> Result:
    press, turn = pressed(surface, 0.05, fault, seed), turned(surface, fault, seed + 2)
    return engine.fuse(press, turn, rotation=zenith_scale(fault), register=False)


def _fit_recording(source: ArrayRecording) -> Result:
    return engine.run(source, engine.optical.Fringes)


def _light_recording(source: ArrayRecording, **options: Any) -> Result:
    return engine.run(source, engine.optical.PhotometricStereo(**options))


def _focus_recording(source: ArrayRecording, noise: float) -> Result:
    return engine.run(source, engine.optical.Focus(noise=noise))


RECORDINGS: Mapping[str, Answers] = {
    "threshold, steps of 20 µm": of_press(0.02, _press_recording),
    "threshold, steps of 50 µm": of_press(0.05, _press_recording),
    "threshold, steps of 100 µm": of_press(0.1, _press_recording),
    "change-point, steps of 20 µm": of_press(0.02, _change_point_recording),
    "change-point, steps of 50 µm": of_press(0.05, _change_point_recording),
    "normals of a rotation": of_normals(_reconstruct_turn),
    "heights of a rotation": of_integration(_reconstruct_turn),
    "normals of two turns": of_normals(_reconstruct_turns),
    "heights of two turns": of_integration(_reconstruct_turns),
    "press and rotation, fused": of_fusion(_fuse_recordings),
    "fringes": of_fringes(_fit_recording),
    "photometric stereo": of_photometric(_light_recording),
    "displacement": of_displacement,
    "focus": of_focus(_focus_recording),
}
"""The estimators of recordings."""


# --- The same by functions on arrays -------------------------------------------------------------------


def _frames(source: ArrayRecording) -> NDArray[Any]:
    source.rewind()
    block = source.read_in_place(source.shape[0])
    assert block is not None
    return block.frames


def _phase(source: ArrayRecording) -> NDArray[np.float64]:
    assert source.phase is not None
    return source.phase


def _levels(source: ArrayRecording) -> dict[str, Any]:
    return {"travel": source.travel, "dark": source.header.dark, "bright": source.header.bright}


def _find_onset(source: ArrayRecording) -> Result:
    return engine.find_onset(_frames(source), **_levels(source))


def _find_change_point(source: ArrayRecording) -> Result:
    return engine.find_change_point(_frames(source), **_levels(source))


def _estimate_normals(surface: Surface, fault: Fault, seed: int) -> Result:
    source = turned(surface, fault, seed)
    return engine.estimate_normals(_frames(source), _phase(source), tilt=TILT, **zenith_scale(fault))


def _integrate_normals(surface: Surface, fault: Fault, seed: int) -> Result:
    return engine.integrate(_estimate_normals(surface, fault, seed), pixel_size=PIXEL)


def _fuse_maps(surface: Surface, fault: Fault, seed: int) -> Result:
    heights = _find_onset(pressed(surface, 0.05, fault, seed))
    return engine.fuse(heights, _estimate_normals(surface, fault, seed + 2), PIXEL)


def _fit_array(source: ArrayRecording) -> Result:
    return engine.optical.fit_fringes(_frames(source), _phase(source))


def _light_array(source: ArrayRecording, **options: Any) -> Result:
    dark = source.header.dark
    return engine.optical.photometric_stereo(_frames(source), _phase(source), dark=dark, **options)


def _focus_array(source: ArrayRecording, noise: float) -> Result:
    return engine.optical.find_focus(_frames(source), _levels(source)["travel"], noise=noise)


ARRAYS: Mapping[str, Answers] = {
    "threshold, steps of 20 µm": of_press(0.02, _find_onset),
    "threshold, steps of 50 µm": of_press(0.05, _find_onset),
    "threshold, steps of 100 µm": of_press(0.1, _find_onset),
    "change-point, steps of 20 µm": of_press(0.02, _find_change_point),
    "change-point, steps of 50 µm": of_press(0.05, _find_change_point),
    "normals of a rotation": of_normals(_estimate_normals),
    "heights of a rotation": of_integration(_integrate_normals),
    "press and rotation, fused": of_fusion(_fuse_maps),
    "fringes": of_fringes(_fit_array),
    "photometric stereo": of_photometric(_light_array),
    "focus": of_focus(_focus_array),
}
"""The estimators that have a function on arrays, which is not what they call above."""


def applies(estimator: str, fault: Fault) -> bool:
    """Return whether a fault can occur; projectors and lamps do not move while a frame is exposed."""
    if fault.stated:
        return estimator.startswith(("threshold", "change-point"))
    if estimator == "touch":  # at rest a frame that is lost is replaced by the next one
        return not (fault.dropped or fault.shutter)
    if estimator == "displacement":  # it answers for each frame alone
        return not (fault.jitter or fault.dropped or fault.duplicated or fault.shutter)
    return not (fault.shutter and estimator in ("fringes", "photometric stereo"))
