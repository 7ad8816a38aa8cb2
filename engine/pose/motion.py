"""Rigid motions: application, composition, and propagation of errors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from mirrorskin.kernels.array_types import Doubles

_NEWTON = 1.5 * np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A rotation matrix, (3, 3), and a translation, (3,), mm: x' = R x + t."""

    turn: Doubles
    shift: Doubles

    @classmethod
    def of(cls, vector: Doubles, shift: Doubles) -> Motion:
        """Return the motion with a rotation vector, (3,), and a translation."""
        x, y, z = np.asarray(vector, np.float64).tolist()  # without a call that lets other threads run
        angle = math.sqrt(x * x + y * y + z * z)
        along = math.sin(angle) / angle if angle else 1.0
        across = 2 * (math.sin(angle / 2) / angle) ** 2 if angle else 0.5
        turn = [
            [1 - across * (y * y + z * z), across * x * y - along * z, across * x * z + along * y],
            [across * x * y + along * z, 1 - across * (x * x + z * z), across * y * z - along * x],
            [across * x * z - along * y, across * y * z + along * x, 1 - across * (x * x + y * y)],
        ]
        return cls(np.array(turn), shift)

    @property
    def vector(self) -> Doubles:
        """The rotation vector, (3,)."""
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self.turn.tolist()
        x, y, z, cosine = (zy - yz) / 2, (xz - zx) / 2, (yx - xy) / 2, (xx + yy + zz - 1) / 2
        sine = math.sqrt(x * x + y * y + z * z)
        if cosine < 0:  # near half a turn, the difference from the transpose does not determine the axis
            return np.asarray(cv2.Rodrigues(self.turn)[0].ravel())
        scale = math.atan2(sine, cosine) / sine if sine else 1.0
        return np.array([scale * x, scale * y, scale * z])

    def apply(self, points: Doubles) -> Doubles:
        """Move points, (..., 3)."""
        return points @ self.turn.T + self.shift

    def then(self, other: Motion) -> Motion:
        """Return this motion followed by another."""
        return Motion(other.turn @ self.turn, other.apply(self.shift))

    def inverse(self) -> Motion:
        """Return the inverse motion."""
        return Motion(self.turn.T, -self.shift @ self.turn)

    def small_step(self, step: Doubles, centre: Doubles) -> Motion:
        """Return this motion followed by a small rotation about a point and a translation, (6,)."""
        small = Motion.of(step[:3], step[3:])
        return self.then(Motion(small.turn, centre - small.turn @ centre + small.shift)).rigid()

    def rigid(self) -> Motion:
        """Return this motion without rounding errors of the rotation.

        They would accumulate, because the transpose is used as the inverse. A Newton step towards the nearest
        rotation squares them.
        """
        return Motion(self.turn @ (_NEWTON - 0.5 * (self.turn.T @ self.turn)), self.shift)

    def adjoint(self) -> Doubles:
        """Return the matrix, (6, 6), that converts small motions before this one to ones after it."""
        matrix = np.zeros((6, 6))
        matrix[:3, :3] = self.turn
        matrix[3:, 3:] = self.turn
        matrix[3:, :3] = cross_matrix(self.shift) @ self.turn
        return matrix


STILL = Motion(np.eye(3), np.zeros(3))


def cross_matrix(vector: Doubles) -> Doubles:
    """Return the matrix, (3, 3), of the cross product with a vector on the left."""
    x, y, z = vector.tolist()  # numbers of Python, of which NumPy makes an array faster
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
