"""The references of a twin: each pixel's own levels, or what a camera finds of them in a lab."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.camera import Sensor
from mirrorskin.hw.twin.movement import Pose, pose_at_press
from mirrorskin.hw.twin.objects import Sphere
from mirrorskin.hw.twin.optics import Ideal, Wall
from mirrorskin.hw.twin.skin import Conform
from mirrorskin.hw.twin.texture import Coat
from mirrorskin.hw.twin.view import View

ReferenceName = Literal["exact", "ball"]

_Counts = NDArray[np.float32]

_DARK_FRAMES = 16
_BRIGHTEST = 3  # which sample of a pixel, by brightness, is its reference: no single glint
_LEAST = 0.1  # of the others' light, for a pixel that has references
_STEP = 0.4  # from place to place of the ball, as a share of its radius
_STEEPEST = math.radians(46.0)  # zenith at the rim of the ball's contact: all that a wall can show


def exact_references(sensor: Sensor, optics: Ideal | Wall | Coat) -> tuple[_Counts, _Counts]:
    """Return what no lab knows: each pixel's own counts without light and in full light, (H, W), float32.

    They are free of noise, and within what a sample can hold.
    """
    low = -np.inf if sensor.camera.bits is None else 0.0
    dark, bright = sensor.offset, sensor.full
    if isinstance(optics, Coat):
        dark, bright = (levels.astype(np.float32) for levels in optics.levels(dark, bright))
    return np.clip(dark, low, sensor.camera.top), np.clip(bright, low, sensor.camera.top)


def ball_references(optics: Ideal | Wall | Coat, sensor: Sensor, view: View) -> tuple[_Counts, _Counts]:
    """Return each pixel's counts without light and in full light as a lab takes them; NaN where none are.

    A sheet at rest shows no light, so the dark reference is the mean of 16 frames before the touch. It shows
    no full light either. For the bright reference a lab rolls a ball over the field, here one twice as wide
    as the field, pressed until it stands at 46 degrees at the rim of its contact: every pixel meets every
    slope, and its third-brightest sample is the reference. That is some tenths of the noise above the mean of
    its bright samples, and includes what the pixel's own gain and place and the lamps do; of uneven lamps it
    it shows only roughly, as it stops at slopes some 15 degrees apart. Pixels that never get a tenth of the
    light of the others, as those beyond the body, have no references.

    The optics are those of the clear wall: a lab takes the printed sheet out.
    """
    reach = max(size * pixel for size, pixel in zip(view.shape, view.pixel_size[::-1], strict=True))
    ball = Conform(Sphere(2 * reach), view)
    depth = reach * (1 - math.cos(_STEEPEST))

    counts = np.empty(view.shape, sensor.dtype)
    dark = np.zeros(view.shape)
    untouched = optics.light(ball.drape(pose_at_press(-depth)))
    for number in range(_DARK_FRAMES):
        sensor.expose(untouched, -1 - number, counts)  # a frame's number below 0 is one of no recording
        dark += counts / _DARK_FRAMES

    brightest = np.zeros((_BRIGHTEST, *view.shape), np.float32)
    for number, (x, y) in enumerate(_places(view, reach), _DARK_FRAMES):
        light = optics.light(ball.drape(Pose(np.eye(3), np.array([x, y, depth]))))
        sensor.expose(light, -1 - number, counts)
        left = counts.astype(np.float32)
        for kept in brightest:
            left, kept[...] = np.minimum(kept, left), np.maximum(kept, left)
    bright = brightest[-1]
    span = bright - dark
    seen = span >= _LEAST * np.median(span[view.on_body])
    return np.where(seen, dark, np.nan).astype(np.float32), np.where(seen, bright, np.float32(np.nan))


def _places(view: View, radius: float) -> list[tuple[float, float]]:
    """Return where the ball stands: a square grid whose contacts cover the field evenly, mm."""
    contact = radius * math.sin(_STEEPEST)
    along = []
    for size, pixel in zip(view.shape[::-1], view.pixel_size, strict=True):
        reach = size * pixel / 2 + contact
        count = math.ceil(2 * reach / (_STEP * radius)) + 1
        along.append(np.linspace(-reach, reach, count))
    return [(float(x), float(y)) for y in along[1] for x in along[0]]
