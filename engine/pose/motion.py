"""Rigid motions: application, composition, and propagation of errors."""

from __future__ import annotations

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
        return cls(np.asarray(cv2.Rodrigues(np.asarray(vector, np.float64))[0]), shift)

    @property
    def vector(self) -> Doubles:
        """The rotation vector, (3,)."""
        return np.asarray(cv2.Rodrigues(self.turn)[0].ravel())

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
