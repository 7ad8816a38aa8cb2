"""The sheet of the paper: so soft that it takes the object's shape, and flat elsewhere."""

from __future__ import annotations

import numpy as np

from mirrorskin.hw.twin.contact.obstacle import meet
from mirrorskin.hw.twin.movement import Pose
from mirrorskin.hw.twin.objects import Object
from mirrorskin.hw.twin.sheet import Sheet
from mirrorskin.hw.twin.view import View


class Conform:
    """Equation 1 of the paper, F = f H(-vt - f): the object's shape where it stands above the rest plane.

    Parameters
    ----------
    thing : Object
    view : View
        Of the camera.
    """

    def __init__(self, thing: Object, view: View) -> None:
        self._thing = thing
        self._view = view

    def lie(self, pose: Pose) -> Sheet:
        """Lay the sheet on the object in a pose."""
        obstacle = meet(self._thing, pose, self._view)
        contact = np.isfinite(obstacle.height) & self._view.on_body
        height, dz_dx, dz_dy = (np.where(contact, values, 0.0) for values in obstacle)
        return Sheet(height, dz_dx, dz_dy, contact)
