"""Cases of strokes, poses, forces, a moving texture, and moving objects."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from golden import HEIGHT, NORMAL, Answer, Tolerance, case
from moved_surfaces import bumpy, rod, sampled
from scenes import LEVELS, PIXEL, counted, dome, places
from speckle import Speckle

from mirrorskin import engine
from mirrorskin.engine import force, pose, press, rotation, slip, vibration

MOVED = Tolerance(1e-3, 1e-5)  # mm: a thousandth of a pixel, where Gauss-Newton steps end
POSE = Tolerance(1e-3, 2e-6)  # radians and mm
FORCE = Tolerance(1e-3, 1e-7)  # N and MPa: where conjugate gradients end

TEXTURE = Speckle(4)
SHAPE = (64, 72)


def strokes(dtype: str) -> tuple[Any, Any]:
    """Return frames of a press that oscillates and lags behind on its way up, and its travel."""
    random = np.random.default_rng(6)
    travel = 0.5 * (1 - np.cos(0.41 * np.arange(48)))
    lag = travel + 0.02 * (np.gradient(travel) < 0)
    starts = np.clip(-dome((37, 53))[0] + 0.05, 0.01, 1.2)
    fraction = np.clip((lag[:, None, None] - starts) / 0.05, 0, 1)
    return counted(fraction + random.normal(0, 0.01, fraction.shape), dtype), travel


@case(HEIGHT, sigma=HEIGHT)
def stroke_search() -> Answer:
    answers = {}
    for dtype in ("uint8", "float32"):
        frames, travel = strokes(dtype)
        dark, bright = LEVELS[dtype]
        results = {}
        for event in ("onset", "release"):
            run = engine.Run(press.Strokes(event=event, dark=dark, bright=bright))
            for part in np.split(np.arange(len(frames)), [1, 17, 30]):
                run.push(frames[part], travel=travel[part])
            results[event] = run.result()
        onset, release = results["onset"], results["release"]
        answers[dtype] = {
            "onset": onset.height,
            "onset_sigma": onset.height_sigma,
            "release": release.height,
            "release_sigma": release.height_sigma,
            "onsets": onset.strokes,
            "releases": release.strokes,
            "strokes": onset.process["strokes"],
        }
    return {f"{dtype}.{name}": value for dtype, each in answers.items() for name, value in each.items()}


@case(FORCE)
def find_force() -> Answer:
    height = np.where(np.hypot(*places((40, 52))) < 1.1, dome((40, 52), 0.4)[0], np.nan)
    result = force.find_force(height, 0.2, PIXEL, 0.1, sigma=0.002, travel_sigma=0.005, modulus_sigma=0.001)
    soft = force.find_force(height, 0.2, PIXEL, 0.1, compliance=0.02)
    return {
        "pressure": result.pressure,
        "contact": result.contact != 0,
        "numbers": np.array([result.force, result.force_sigma, soft.force]),
    }


@case(FORCE)
def force_tracker() -> Answer:
    x, y = places((64, 80))
    random, tracker = np.random.default_rng(4), force.ForceTracker(PIXEL, 0.1, binning=2, window_size=4)
    found = []
    for number in range(4):
        height = dome((64, 80), 0.4)[0] + random.normal(0, 0.001, (64, 80))
        shift = np.stack([0.01 * number - 0.003 * np.hypot(x, y) ** 2, 0.002 * x * y], axis=-1)
        maps = {"height": height, "height_sigma": np.full((64, 80), 0.001), "displacement": shift}
        found.append(tracker.push(maps, 0.2 + 0.02 * number))
    numbers = [value for name, value in sorted(found[-1].items()) if np.ndim(value) == 0]
    forces = [(one.force, one.force_x, one.pressure_centre_x) for one in found]
    return {"pressure": found[-1].pressure, "numbers": np.array(numbers), "forces": np.array(forces)}


@case(FORCE)
def find_tangential_force() -> Answer:
    x, y = places((40, 52))
    contact = np.hypot(x - 0.1, y) < 0.7
    shift = np.stack([0.05 - 0.02 * np.hypot(x, y) ** 2, 0.01 * x * y], axis=-1)
    shift += np.random.default_rng(3).normal(0, 5e-4, shift.shape)
    result = force.find_tangential_force(
        shift, PIXEL, 0.1, contact=contact, sigma=5e-4, window_size=4, modulus_sigma=0.001
    )
    return {
        "traction": result.traction,
        "force": np.array([result.force_x, result.force_y]),
        "sigma": np.array([result.force_x_sigma, result.force_y_sigma]),
    }


def leaning(direction: Any, tilt: Any, dtype: str = "uint16") -> tuple[Any, Any, float, float]:
    """Return frames over the dome at leans towards directions, the axes, counts a radian, and at zenith 0."""
    gain, offset = {"uint8": (220.0, 8.0), "uint16": (3400.0, 150.0)}[dtype]
    axis = np.stack(
        [np.sin(tilt) * np.cos(direction), np.sin(tilt) * np.sin(direction), np.cos(tilt)], axis=1
    )
    _, along_x, along_y = dome((37, 53))
    upright = np.stack([-along_x, -along_y, np.ones_like(along_x)])
    zenith = np.arccos(
        np.clip(np.einsum("ka,ahw->khw", axis, upright / np.linalg.norm(upright, axis=0)), -1, 1)
    )
    noise = gain / 200 * np.random.default_rng(7).normal(size=zenith.shape)
    return np.clip(np.rint(offset + gain * zenith + noise), 0, None).astype(dtype), axis, gain, offset


@case(NORMAL, slope_sigma=Tolerance(1e-3))
def normals_of_poses() -> Answer:
    answers: dict[str, Any] = {}
    turn = 0.7 * np.arange(20)
    ways = {
        "whole": (turn, 0.03 + 0.01 * np.cos(3 * turn)),
        "rocked": (np.full(20, 0.6), 0.04 * np.sin(turn)),
    }
    for dtype in ("uint8", "uint16"):
        for name, (direction, tilt) in ways.items():
            frames, axis, gain, offset = leaning(direction, tilt, dtype)
            options = {"zenith_gain": gain, "zenith_offset": offset, "noise": gain / 200}
            run = engine.Run(rotation.MovingNormals(**options))
            for part in np.split(np.arange(20), [3, 11]):
                run.push(frames[part], pose=axis[part])
            result = run.result()
            whole = {"vectors": result.normals, "sigma": result.normals_sigma} if name == "whole" else {}
            direction = result.process.get("slope_direction")
            rocked = {"slope": result.slope, "slope_sigma": result.slope_sigma, "direction": direction}
            values = {"status": result.status, **whole, **rocked}
            answers |= {f"{dtype}.{name}.{key}": value for key, value in values.items()}
    return answers


@case(MOVED)
def estimate_frequency() -> Answer:
    time = np.arange(120) / 30
    wave = 100 + 20 * np.cos(math.tau * 3.21 * time)[:, None, None] * np.linspace(0.5, 1, 12).reshape(3, 4)
    result = vibration.estimate_frequency(wave + np.random.default_rng(1).normal(0, 1, wave.shape), time)
    return {"numbers": np.array([result.hertz, result.sigma])}


def drift(k: int, noise: float = 1.0) -> Any:
    """Return a frame of a texture that has gone along, turned and stretched."""
    angle = 0.01 * k
    return TEXTURE.frame(
        SHAPE,
        lambda x, y: 0.3 * k + 0.004 * k * (x - 36) - angle * (y - 32),
        lambda x, y: -0.2 * k + angle * (x - 36),
        noise,
        k,
    )


@case(MOVED)
def find_displacement() -> Answer:
    answers: dict[str, Any] = {}
    for dtype in ("uint8", "float32"):
        frames = np.stack([drift(k) for k in range(4)])
        frames = frames if dtype == "float32" else np.clip(frames.round(), 0, 255).astype(dtype)
        result = slip.find_displacement(frames[0], frames[1:], PIXEL, window_size=12, window_step=4)
        answers |= {
            f"{dtype}.displacement": result.displacement[:, ::3, ::3],
            f"{dtype}.sigma": result.displacement_sigma[0, ::3, ::3],
            f"{dtype}.status": result.status,
            f"{dtype}.noise": result.process["noise"],
        }
    return answers


@case(
    MOVED,
    stick_ratio=Tolerance(0, 5e-3),
    slip_onset=Tolerance(1e-2, 1e-4),
    slip_onset_sigma=Tolerance(3e-2, 1e-4),
)
def slip_search() -> Answer:
    answers: dict[str, Any] = {}
    x, y = np.meshgrid(np.arange(72) - 36, np.arange(64) - 32)
    contact = np.hypot(x, y) < 26
    for motion, position in (("horizontal", "displacement"), ("twist", "twist")):
        run = engine.Run(slip.SlipOnset(pixel_size=PIXEL, motion=motion, contact=contact))
        for k in range(12):
            run.push(slipping(motion, k)[None], **{position: places_of(motion, k)})
        result = run.result()
        values = {
            "displacement": result.displacement[::3, ::3],
            "sigma": result.displacement_sigma[::3, ::3],
            "stick_ratio": result.stick_ratio,
            # Not each pixel: whether one that is about to slip has slipped, last bits decide.
            "slip_onset": np.nanpercentile(result.slip_onset, (10, 30, 50, 70)),
            "slip_onset_sigma": np.nanpercentile(result.slip_onset_sigma, (10, 30, 50, 70)),
        }
        answers |= {f"{motion}.{name}": value for name, value in values.items()}
    return answers


def places_of(motion: str, k: int) -> Any:
    return [[0.3 * PIXEL[0] * k, 0.0]] if motion == "horizontal" else [0.01 * k]


def slipping(motion: str, k: int) -> Any:
    """Return a frame of skin that sticks within a circle, which shrinks as the body goes on."""

    def share(x: Any, y: Any) -> Any:
        """How much of the body's way the skin stays behind the body."""
        square = ((x - 36) ** 2 + (y - 32) ** 2) / 26**2
        return 1 - 0.5 * np.clip(k / 16 - (1 - square), 0, 0.6) ** 1.5 * 16 / max(k, 1)

    if motion == "horizontal":
        return TEXTURE.frame(SHAPE, lambda x, y: -0.3 * k * share(x, y), lambda x, y: 0 * x, 1.0, k)
    angle = 0.01 * k
    return TEXTURE.frame(
        SHAPE,
        lambda x, y: angle * share(x, y) * -(y - 32),
        lambda x, y: angle * share(x, y) * (x - 36),
        1.0,
        k,
    )


@case(POSE)
def estimate_pose() -> Answer:
    answers: dict[str, Any] = {}
    for form in (bumpy, rod):
        random = np.random.default_rng(1)
        pair = [
            sampled(form, *pose, rng=random)
            for pose in (((0, 0, 0), (0, 0, 0)), ((0.02, -0.03, 0.1), (0.1, -0.05, 0.02)))
        ]
        moved = pose.estimate_pose(*pair)
        answers |= {
            f"{form.__name__}.rotation": moved.rotation,
            f"{form.__name__}.translation": moved.translation,
            f"{form.__name__}.sigma": moved.sigma,
            f"{form.__name__}.chi_square": moved.chi_square,
            f"{form.__name__}.free": len(moved.undetermined),
        }
    return answers


@case(POSE)
def pose_tracker() -> Answer:
    random, tracker = np.random.default_rng(2), pose.PoseTracker()
    poses = [
        tracker.push(sampled(bumpy, (0, 0, 0.03 * k), (0.15 * k, 0.03 * k, 0), rng=random)) for k in range(12)
    ]
    return {
        "rotation": np.stack([pose.rotation for pose in poses]),
        "translation": np.stack([pose.translation for pose in poses]),
        "sigma": np.stack([pose.sigma for pose in poses]),
        "keys": tracker.keys,
    }
