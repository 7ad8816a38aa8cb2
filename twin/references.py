"""The references of a twin: each pixel's exact levels, or those that a camera measures in a laboratory."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin.twin.camera import Sensor
from mirrorskin.twin.movement import Pose, pose_at_press
from mirrorskin.twin.objects import Sphere
from mirrorskin.twin.optics import Ideal, Wall
from mirrorskin.twin.skin import Conform
from mirrorskin.twin.texture import Coat
from mirrorskin.twin.view import View

ReferenceName = Literal["exact", "ball"]

_Counts = NDArray[np.float32]

_DARK_FRAMES = 16
_BRIGHTEST = 3  # rank of a pixel's sample that is its reference, to exclude single glints
_LIGHT_MIN = 0.1  # minimum light of a pixel with references, relative to the others
_STEP = 0.4  # distance between positions of the ball, as a share of its radius
_STEEPEST = math.radians(46.0)  # zenith at the rim of the ball's contact, which is all that a wall can show


def exact_references(sensor: Sensor, optics: Ideal | Wall | Coat) -> tuple[_Counts, _Counts]:
    """Return each pixel's exact counts without light and in full light, (H, W), float32.

    They have no noise, and are within the range of a sample.
    """
    low = -np.inf if sensor.camera.bits is None else 0.0
    dark, bright = sensor.offset, sensor.full
    if isinstance(optics, Coat):
        dark, bright = (levels.astype(np.float32) for levels in optics.levels(dark, bright))
    return np.clip(dark, low, sensor.camera.top), np.clip(bright, low, sensor.camera.top)


def ball_references(optics: Ideal | Wall | Coat, sensor: Sensor, view: View) -> tuple[_Counts, _Counts]:
    """Return each pixel's counts without light and in full light as measured with a ball; NaN without any.

    A sheet at rest shows no light, so the dark reference is the mean of 16 frames before the touch. For the
    bright reference a ball is rolled over the field, here one twice as wide as the field, pressed until the
    zenith at the rim of its contact is 46 degrees. Every pixel meets every slope, and its third-brightest
    sample is the reference. It exceeds the mean of the bright samples by some tenths of the noise. It
    includes the pixel's own gain and position and the lamps; uneven lamps only approximately, because the
    slopes are some 15 degrees apart. Pixels that never get a tenth of the light of the others, such as those
    beyond the body, have no references.

    The optics are those of the clear wall: the printed sheet is removed in a laboratory.
    """
    reach = max(size * pixel for size, pixel in zip(view.shape, view.pixel_size[::-1], strict=True))
    ball = Conform(Sphere(2 * reach), view)
    depth = reach * (1 - math.cos(_STEEPEST))

    counts = np.empty(view.shape, sensor.dtype)
    dark = np.zeros(view.shape)
    untouched = optics.light(ball.drape(pose_at_press(-depth)))
    for number in range(_DARK_FRAMES):
        sensor.expose(untouched, -1 - number, counts)  # negative frame numbers are not used by recordings
        dark += counts / _DARK_FRAMES

    brightest = np.zeros((_BRIGHTEST, *view.shape), np.float32)
    for number, (x, y) in enumerate(_places(view, reach), _DARK_FRAMES):
        light = optics.light(ball.drape(Pose(np.eye(3), np.array([x, y, depth]))))
        sensor.expose(light, -1 - number, counts)
        remainder = counts.astype(np.float32)
        for kept in brightest:
            remainder, kept[...] = np.minimum(kept, remainder), np.maximum(kept, remainder)
    bright = brightest[-1]
    span = bright - dark
    lit = span >= _LIGHT_MIN * np.median(span[view.on_body])
    return np.where(lit, dark, np.nan).astype(np.float32), np.where(lit, bright, np.float32(np.nan))


def _places(view: View, radius: float) -> list[tuple[float, float]]:
    """Return the positions of the ball: a square grid whose contacts cover the field evenly, mm."""
    contact = radius * math.sin(_STEEPEST)
    along = []
    for size, pixel in zip(view.shape[::-1], view.pixel_size, strict=True):
        reach = size * pixel / 2 + contact
        count = math.ceil(2 * reach / (_STEP * radius)) + 1
        along.append(np.linspace(-reach, reach, count))
    return [(float(x), float(y)) for y in along[1] for x in along[0]]
