"""Normal equations of a rigid motion: the reference compared with differences, and the kernel with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mirrorskin.kernels.skin.pose import BLOCK, PARTS, pose_equations
from mirrorskin.kernels.skin.pose_maps import pose_gradient

PIXEL = 0.05, 0.06


def pose_of(
    vector: tuple[float, ...], shape: tuple[int, int], shift: tuple[float, ...], least_facing: float
) -> np.ndarray:
    rows, columns = shape
    grid = -(columns - 1) / 2 * PIXEL[0], (rows - 1) / 2 * PIXEL[1], *PIXEL
    turn = Rotation.from_rotvec(vector).as_matrix().ravel()
    return np.array(
        [*turn, *shift, 0.1, -0.2, 0.05, *grid, *grid, least_facing, least_facing, 1e30], np.float32
    )


def blocks_of(shape: tuple[int, int]) -> int:
    return int(np.prod([-(-size // BLOCK) for size in shape]))


def test_the_gradient_of_a_plane_is_its_slope_up_to_the_border() -> None:
    row, column = np.indices((9, 11))
    values = 3 + 0.2 * column * PIXEL[0] - 0.5 * -row * PIXEL[1]
    values[4, 5] = np.nan
    gradient = np.zeros((9, 11, 2))
    pose_gradient(*PIXEL, values, gradient)
    finite = np.isfinite(values)
    np.testing.assert_allclose(gradient[finite], np.broadcast_to([0.2, -0.5], (finite.sum(), 2)), atol=1e-9)
    assert np.isnan(gradient[4, 5]).all()


def sphere_map(rows: int, columns: int, radius: float, at: tuple[float, float, float]) -> np.ndarray:
    """Records of a ball about a point, with its own curvature."""
    row, column = np.indices((rows, columns))
    x, y = (column - (columns - 1) / 2) * PIXEL[0] - at[0], ((rows - 1) / 2 - row) * PIXEL[1] - at[1]
    z = np.sqrt(radius**2 - x * x - y * y)
    curvature = [-(1 / z + x * x / z**3), -x * y / z**3, -(1 / z + y * y / z**3)]
    sure = np.full(x.shape, 1e-4), np.full(x.shape, 1e-6)
    return np.stack([x / radius, y / radius, sure[0], z + at[2], sure[1], *curvature], axis=-1)


def test_a_moved_ball_fits_where_it_was_moved_to() -> None:
    """Chi square is least there, its slope nought, and any turn about the ball's centre changes nothing."""
    shape, move = (30, 40), np.array([0.11, -0.07, 0.02])
    first, second = sphere_map(*shape, 5, (0, 0, -5)), sphere_map(*shape, 5, (*move[:2], move[2] - 5))
    pose = pose_of((0, 0, 0), shape, tuple(move), 1.0).astype(float)
    pose[12:15] = [*move[:2], move[2] - 5]
    sums = np.zeros((1, blocks_of(shape), PARTS[-1]))
    pose_equations(first, second, pose[np.newaxis], sums)
    total = sums.sum(axis=(0, 1))
    normal_matrix = np.zeros((6, 6))
    normal_matrix[np.triu_indices(6)] = total[: PARTS[1]]
    assert total[PARTS[2]] / total[PARTS[3]] < 1e-4
    assert np.abs(np.diag(normal_matrix))[:3].max() < 1e-6 * np.diag(normal_matrix)[3:].min()
    both = np.triu(normal_matrix) + np.triu(normal_matrix, 1).T
    np.testing.assert_allclose(total[PARTS[6] :].reshape(6, 6), both, atol=1e-3 * both.max())


@pytest.mark.parametrize("number", range(6))
def test_the_jacobian_is_the_residuals_change(number: int) -> None:
    """Half of chi square changes along each parameter as the right side says."""
    shape = 60, 50
    first, second = sphere_map(*shape, 4, (0, 0, -4)), sphere_map(*shape, 4.01, (0, 0.02, -4.01))

    def sums_at(by: float) -> np.ndarray:
        shift = np.array([0.01, 0.02, 0.005])
        centre = np.array([0.1, -0.2, 0.05])
        step = np.zeros(6)
        step[number] = by
        turn = Rotation.from_rotvec(step[:3]) * Rotation.from_rotvec([0.004, 0.01, 0.05])
        moved = Rotation.from_rotvec(step[:3]).apply(shift - centre) + centre + step[3:]
        pose = pose_of((0, 0, 0), shape, tuple(moved), 1.0).astype(float)
        pose[:9] = turn.as_matrix().ravel()
        sums = np.zeros((1, blocks_of(shape), PARTS[-1]))
        pose_equations(first[10:-10, 10:-10], second, shifted(pose)[np.newaxis], sums)
        return sums.sum(axis=(0, 1))

    small = 1e-4
    change = (sums_at(small)[PARTS[2]] - sums_at(-small)[PARTS[2]]) / (4 * small)
    assert change == pytest.approx(sums_at(0.0)[PARTS[1] + number], rel=0.02, abs=1.0)


def shifted(pose: np.ndarray) -> np.ndarray:
    """Let the first map's first pixel be ten to the right and below."""
    pose = pose.copy()
    pose[15] += 10 * PIXEL[0]
    pose[16] -= 10 * PIXEL[1]
    return pose
