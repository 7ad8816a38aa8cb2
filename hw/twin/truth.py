"""What the twin knows of its object and of the touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.body import Body
from mirrorskin.hw.twin.contact import Conform, Elastic, Friction
from mirrorskin.hw.twin.contact.obstacle import meet
from mirrorskin.hw.twin.movement import Horizontal, Movement, Twist, Vertical, pose_at_press
from mirrorskin.hw.twin.objects import Object, zenith_azimuth
from mirrorskin.hw.twin.view import View
from mirrorskin.io.types import Floats, Truth


def tell_truth(
    thing: Object,
    movement: Movement,
    skin: Conform | Elastic,
    view: View,
    body: Body,
    touched: NDArray[np.bool_] | None,
) -> Truth:
    """Tell what the upright body stands on, and what touches, sticks and slips.

    Parameters
    ----------
    thing : Object
    movement : Movement
    skin : Conform or Elastic
    view : View
        Under an oblique one, what a pixel sees depends on the depth. Then the maps of a vertical movement
        tell of the point at which its ray meets the rest plane, and those of another of the point that it
        sees of the object pressed, NaN where the object does not reach the rest plane.
    body : Body
    touched : ndarray, (H, W), bool, or None
        Where sheet and object touch in all frames; needed of all movements but the vertical.

    Returns
    -------
    Truth
        ``azimuth`` is NaN where the surface is level. ``contact`` is that at the greatest travel of a
        vertical movement, and what lasts through all frames of another. ``slip`` is known of horizontal
        movements and twists in elastic contact.
    """
    vertical = isinstance(movement, Vertical)
    pressed = pose_at_press(movement.deepest)
    if vertical or view.orthographic:
        height, slopes = thing.height(view.x, view.y), thing.slope(view.x, view.y)
    else:
        obstacle = meet(thing, pressed, view)
        height, slopes = obstacle.height - movement.deepest, (obstacle.dz_dx, obstacle.dz_dy)
    zenith, azimuth = zenith_azimuth(*slopes)
    contact = skin.lie(pressed).contact if vertical or touched is None else touched
    slip = None
    if isinstance(movement, Horizontal | Twist) and isinstance(skin, Elastic):
        slip = _slipped(movement, skin, body.friction).astype(np.uint8)
    return Truth(
        height=height.astype(np.float32),
        zenith=zenith.astype(np.float32),
        azimuth=azimuth.astype(np.float32),
        contact=contact.astype(np.uint8),
        slip=slip,
    )


def _slipped(movement: Horizontal | Twist, skin: Elastic, coefficient: float) -> NDArray[np.bool_]:
    """Tell where the sheet slips at some time, by the pressure of the press before the movement."""
    pressure: Floats = skin.solve(pose_at_press(movement.deepest)).pressure
    friction = Friction(skin.space, pressure, coefficient)
    slipped = np.zeros(pressure.shape, bool)
    for place in movement.path:
        slipped |= friction.move(skin.shift(movement.pose(place)))
    return skin.crop(slipped)
