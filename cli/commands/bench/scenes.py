"""Inputs of live runs, made before anything is timed: frames of a press and turns, and those of trackers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result, pixel_axes
from mirrorskin.kernels.device import Device
from mirrorskin.twin import Axial, Camera, Movement, Twin, Vertical

Shape = tuple[int, int]

STEPS = 8  # frames of a turn
NOISE = 2.0  # standard deviation of a sample of turns, counts
FIELD = 8.0  # width of a picture, mm
_PRESS, _TURNS, _POINTS = 256, 64, 24  # different frames: of a press, of turns, along a circle
_DEPTH, _BALL_FIELD = 3.0, 12.0  # travel of a press, and width of a picture, mm
_HEIGHT_SIGMA, _NORMAL_SIGMA = 1e-3, 0.01  # of a dome's noise, mm and rad
_STEP, _TURN = 0.01, math.radians(0.3)  # of a result to the next, mm and rad
_SLIDE = 0.2  # radius of the circle of a texture, pixels


def press_of_ball(shape: Shape, device: Device) -> Twin:
    """Return a press of a ball."""
    return _twin(shape, Vertical((np.arange(_PRESS) + 1) * (_DEPTH / _PRESS)), "uniform", device)


def turns_on_ball(shape: Shape, device: Device) -> Twin:
    """Return turns of an axial rotation on a ball."""
    phase = np.arange(_TURNS) * (math.tau / STEPS)
    return _twin(shape, Axial(phase, math.radians(2.5), 1.5), "linear", device)


def _twin(shape: Shape, movement: Movement, pattern: str, device: Device) -> Twin:
    return Twin(
        object="sphere",
        shape=shape,
        pixel_size=_BALL_FIELD / shape[1],
        movement=movement,
        pattern=pattern,
        camera=Camera(noise=1.5, electrons=40.0),
        device=device,
    )


def moving_domes(shape: Shape) -> Sequence[Result]:
    """Return results of an object that moves along a circle, in small steps."""
    radius, turn = _STEP * _POINTS / math.tau, _TURN * _POINTS / math.tau
    return [
        wavy_dome(shape, radius * math.sin(a), radius * (1 - math.cos(a)), turn * math.sin(a), seed)
        for seed, a in enumerate(_angles())
    ]


def wavy_dome(shape: tuple[int, int], right: float, up: float, turn: float, seed: int) -> Result:
    """Return waves on a dome, rotated about z and translated, with noise of the stated deviations."""
    rng = np.random.default_rng(seed)
    x, y = pixel_axes(shape, (FIELD / shape[1], FIELD / shape[1]))
    across, high = np.meshgrid(x - right, y - up)
    cosine, sine = math.cos(turn), math.sin(turn)
    u, v = cosine * across + sine * high, cosine * high - sine * across
    height = -0.03 * (u * u + 0.7 * v * v) + 0.05 * np.sin(1.5 * u + 0.3) * np.cos(1.2 * v)
    p = -0.06 * u + 0.075 * np.cos(1.5 * u + 0.3) * np.cos(1.2 * v)
    q = -0.042 * v - 0.06 * np.sin(1.5 * u + 0.3) * np.sin(1.2 * v)
    slopes = np.stack([cosine * p - sine * q, sine * p + cosine * q], axis=-1)
    slopes += rng.normal(0, _NORMAL_SIGMA / math.sqrt(2), slopes.shape)
    normals = np.dstack([-slopes, np.ones(shape)])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Result(
        height=(height + rng.normal(0, _HEIGHT_SIGMA, shape)).astype(np.float32),
        height_sigma=np.full(shape, _HEIGHT_SIGMA, np.float32),
        normals=normals.astype(np.float32),
        normals_sigma=np.full(shape, _NORMAL_SIGMA, np.float32),
        x=x,
        y=y,
    )


def sliding_texture(shape: Shape) -> Sequence[NDArray[np.uint8]]:
    """Return frames of a texture that moves along a circle."""
    rng, (rows, columns) = np.random.default_rng(1), shape
    texture = cv2.GaussianBlur(rng.normal(100, 90, shape).astype(np.float32), (0, 0), 1.5)
    frames = []
    for a in _angles():
        shift = np.array([[1, 0, _SLIDE * math.sin(a)], [0, 1, _SLIDE * (1 - math.cos(a))]])
        moved = cv2.warpAffine(
            texture, shift, (columns, rows), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
        )
        frames.append(np.clip(np.rint(moved + rng.normal(0, 1, shape)), 0, 255).astype(np.uint8))
    return frames


def round_contact(shape: Shape) -> NDArray[np.bool_]:
    """Return the contact of the texture's skin."""
    y, x = np.indices(shape)
    return np.asarray(np.hypot(x - shape[1] / 2, y - shape[0] / 2) < 0.4 * shape[0])


def loaded_domes(shape: Shape) -> Sequence[Result]:
    """Return results of a paraboloid that moves along a circle, with the displacement of the skin."""
    rng = np.random.default_rng(2)
    x, y = pixel_axes(shape, (FIELD / shape[1], FIELD / shape[1]))
    sigma = np.full(shape, 1e-3, np.float32)
    results = []
    for a in _angles():
        away = (x - 0.05 * math.sin(a)) ** 2 + (y[:, np.newaxis] - 0.05 * math.cos(a)) ** 2
        moved = np.full((*shape, 2), [0.05 * math.sin(a), 0.0], np.float32)
        results.append(
            Result(
                height=(-away / 10 + rng.normal(0, 1e-3, shape)).astype(np.float32),
                height_sigma=sigma,
                displacement=moved,
                displacement_sigma=np.full((*shape, 2), 1e-3, np.float32),
                x=x,
                y=y,
            )
        )
    return results


def _angles() -> list[float]:
    return [math.tau * number / _POINTS for number in range(_POINTS)]
