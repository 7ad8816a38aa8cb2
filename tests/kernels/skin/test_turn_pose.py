"""Normal equations of the motion from a turn to a frame: the reference, compared with differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mirrorskin.kernels.skin.pose import BLOCK, PARTS
from mirrorskin.kernels.skin.turn_pose import LIGHT, turn_pose_equations

PIXEL, RADIUS, SHAPE, CENTRE = 0.05, 4.0, (40, 48), np.array([0.1, -0.2, 0.05])
AXIS, BASE = np.array([0.024, -0.032, np.sqrt(0.9984)]), 0.1


def places(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    row, column = np.indices(shape)
    return (column - (shape[1] - 1) / 2) * PIXEL + 1.5, ((shape[0] - 1) / 2 - row) * PIXEL


def turn_of_a_ball() -> np.ndarray:
    """Return records of a ball beside the picture's centre, 4 pixels within a frame's border."""
    x, y = (values[4:-4, 4:-4] for values in places(SHAPE))
    z = np.sqrt(RADIUS**2 - x * x - y * y)
    curvature = -(1 / z + x * x / z**3), -x * y / z**3, -(1 / z + y * y / z**3)
    return np.stack(
        [x / RADIUS, y / RADIUS, np.full(x.shape, 1e-6), z - RADIUS, 0 * x + 1e-6, *curvature], -1
    )


def frame(turn: Rotation, shift: np.ndarray, light: float = 0.0) -> np.ndarray:
    """Return zeniths of the ball after a motion."""
    x, y = places(SHAPE)
    middle = turn.apply([0, 0, -RADIUS]) + shift
    x, y = x - middle[0], y - middle[1]
    normal = np.stack([x, y, np.sqrt(RADIUS**2 - x * x - y * y)], axis=-1) / RADIUS
    zenith = np.arccos(normal @ AXIS)
    return np.asarray(zenith + light * (BASE + zenith))


def sums_at(zeniths: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the sums over the picture after a small step from a motion, with constant weights."""
    small = Rotation.from_rotvec(step[:3])
    turn = small * Rotation.from_rotvec([0.01, -0.02, 0.03])
    shift = small.apply(np.array([0.01, 0.02, 0.0]) - CENTRE) + CENTRE + step[3:]
    x, y = places(SHAPE)
    grids = x[4, 4], y[4, 4], PIXEL, PIXEL, x[0, 0], y[0, 0], PIXEL, PIXEL
    pose = [*turn.as_matrix().ravel(), *shift, *CENTRE, *grids, 1.0, *AXIS, 1e-6, 1e30, 0]
    records = turn_of_a_ball()
    blocks = np.prod([-(-size // BLOCK) for size in records.shape[:2]])
    sums = np.zeros((int(blocks), LIGHT[-1]))
    turn_pose_equations(1, BASE, records, zeniths, np.array(pose), sums)
    return np.asarray(sums.sum(axis=0))


def test_a_moved_ball_fits_where_it_was_moved_to() -> None:
    """Chi square is nearly nought there; the variance of a zenith is about a millionth."""
    zeniths = frame(Rotation.from_rotvec([0.01, -0.02, 0.03]), np.array([0.01, 0.02, 0.0]))
    sums = sums_at(zeniths, np.zeros(6))
    assert sums[PARTS[2]] / sums[PARTS[3]] < 0.01


@pytest.mark.parametrize("number", range(5))
def test_the_jacobian_is_the_residuals_change(number: int) -> None:
    """Half of chi square changes along each parameter as the right side says."""
    zeniths = frame(Rotation.from_rotvec([0.013, -0.019, 0.03]), np.array([0.03, 0.01, 0.0]))
    small = 1e-4
    step = small * np.eye(6)[number]
    change = (sums_at(zeniths, step)[PARTS[2]] - sums_at(zeniths, -step)[PARTS[2]]) / (4 * small)
    scale = np.sqrt(sums_at(zeniths, np.zeros(6))[PARTS[2]] * 2e5)
    assert change == pytest.approx(
        sums_at(zeniths, np.zeros(6))[PARTS[1] + number], rel=0.03, abs=0.01 * scale
    )


def test_a_stronger_light_is_the_change_along_its_number() -> None:
    zeniths = frame(Rotation.from_rotvec([0.01, -0.02, 0.03]), np.array([0.01, 0.02, 0.0]), light=0.02)
    sums = sums_at(zeniths, np.zeros(6))
    assert sums[LIGHT[2]] / sums[LIGHT[1]] == pytest.approx(0.02, rel=0.01)
