"""Conjugate gradients, compared with dense solvers."""

import numpy as np
import pytest
from scipy import optimize

from mirrorskin.kernels.numerics.conjugate_gradients import Face, conjugate_gradients

COUNT = 12
EVERYWHERE = np.ones(COUNT, bool)


def positive_definite(seed):
    factor = np.random.default_rng(seed).normal(size=(COUNT, 2 * COUNT))
    return factor @ factor.T


def small(residual):
    return bool(np.abs(residual).max() <= 1e-10)


def same(residual):
    return residual


def test_a_system_is_solved_where_unknowns_are_free():
    matrix, target = positive_definite(1), np.random.default_rng(2).normal(size=COUNT)
    free = np.arange(COUNT) % 3 > 0
    weights = 1 / np.diag(matrix)
    face = Face.of(free, lambda residual: weights * residual)
    result = conjugate_gradients(lambda x: matrix @ x, target, face, converged=small, steps=5 * COUNT)
    assert result.converged
    assert not result.x[~free].any()
    np.testing.assert_allclose(
        result.x[free], np.linalg.solve(matrix[free][:, free], target[free]), atol=1e-9
    )
    np.testing.assert_allclose(result.product, matrix @ result.x, atol=1e-9)
    again = conjugate_gradients(lambda x: matrix @ x, target, face, converged=small, steps=0, start=result.x)
    assert (again.steps, again.converged) == (0, True)


@pytest.mark.parametrize("seed", range(4))
def test_unknowns_of_0_or_more_are_those_of_scipy(seed):
    matrix, target = positive_definite(seed), np.random.default_rng(seed + 10).normal(size=COUNT)
    solution = conjugate_gradients(
        lambda x: matrix @ x,
        target,
        lambda x, residual: Face.of((x > 0) | (residual > 0), same),
        converged=small,
        steps=1000,
        limit=lambda x: x if x.min() >= 0 else np.maximum(x, 0),
    )
    root = np.linalg.cholesky(matrix).T
    exact = optimize.nnls(root, np.linalg.solve(root.T, target))[0]
    assert 0 < np.count_nonzero(exact) < COUNT
    np.testing.assert_allclose(solution.x, exact, atol=1e-8)


def test_several_systems_are_solved_at_once_each_with_its_own_steps():
    matrix, targets = positive_definite(3), np.random.default_rng(4).normal(size=(3, COUNT))
    targets[1] = 0
    solution = conjugate_gradients(
        lambda x: np.asarray(x @ matrix.astype(np.float32)),
        targets.astype(np.float32),
        Face.of(EVERYWHERE, same),
        converged=lambda residual: bool(np.abs(residual).max() <= 1e-4),
        steps=5 * COUNT,
        axes=(1,),
    )
    assert solution.converged
    assert solution.x.dtype == np.float32
    np.testing.assert_allclose(solution.x, np.linalg.solve(matrix, targets.T).T, atol=1e-3)


def test_too_few_steps_are_reported_with_the_residual():
    matrix, target = positive_definite(5), np.ones(COUNT)
    solution = conjugate_gradients(
        lambda x: matrix @ x, target, Face.of(EVERYWHERE, same), converged=small, steps=2
    )
    assert (solution.steps, solution.converged) == (2, False)
    np.testing.assert_allclose(solution.residual, target - matrix @ solution.x, atol=1e-12)
