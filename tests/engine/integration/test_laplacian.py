"""The inverse of a graph Laplacian, compared with SciPy's sparse solvers in float64."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
import scipy.sparse.linalg as algebra

from mirrorskin import engine, io

SHAPE = 37, 52
RANDOM = np.random.default_rng(2)
RIGHT, DOWN = (np.exp(RANDOM.normal(3, 1, shape)) for shape in ((37, 51), (36, 52)))
HELD = np.where(RANDOM.random(SHAPE) < 0.02, 9.0, 0.0)
RIGHT[5:9, 10:30] = DOWN[4:9, 10:30] = 0  # and pixels of no link
RIGHT[:, 40] = 0  # two components
SOURCE = RANDOM.normal(0, 1e6, SHAPE)


def matrix(right, down, diagonal):
    """Return the matrix, of pixels in C order."""
    pixel = np.arange(diagonal.size).reshape(diagonal.shape)
    ends = [(pixel[:, :-1], pixel[:, 1:]), (pixel[:-1], pixel[1:])]
    start, other = (np.concatenate([pair[k].ravel() for pair in ends]) for k in (0, 1))
    weight = np.concatenate([right.ravel(), down.ravel()])
    links = sparse.coo_array((weight, (start, other)), (diagonal.size,) * 2)
    links = links + links.T
    return sparse.csr_array(sparse.diags_array(links.sum(axis=1) + diagonal.ravel()) - links)


def test_it_solves_what_sparse_elimination_does(device):
    held = HELD + 1e-3 * (RIGHT.mean())
    inverse = engine.integration.invert_laplacian(RIGHT, DOWN, held, device=device)
    exact = algebra.spsolve(matrix(RIGHT, DOWN, held), SOURCE.ravel())
    solution = inverse @ SOURCE.ravel()
    assert inverse.shape == (exact.size, exact.size)
    np.testing.assert_allclose(solution, exact, atol=1e-4 * np.abs(exact).max())


def test_a_singular_one_is_inverted_where_it_can_be():
    held = np.where(np.indices(SHAPE)[1] > 40, HELD, 0.0)  # the left component and lone pixels have none
    inverse = engine.integration.invert_laplacian(RIGHT, DOWN, held)
    solution, a = inverse @ SOURCE.ravel(), matrix(RIGHT, DOWN, held)
    count, label = sparse.csgraph.connected_components(a)
    source = SOURCE.ravel().copy()
    for column in range(count):
        inside = label == column
        if not held.ravel()[inside].any():
            source[inside] -= source[inside].mean()
            assert solution[inside].mean() == pytest.approx(0, abs=1e-9 * np.abs(solution).max())
    assert count > 2
    assert np.linalg.norm(a @ solution - source) < 1e-3 * np.linalg.norm(source)


def test_one_cycle_is_a_preconditioner():
    held = HELD + 1e-2
    a, cycle, steps = (
        matrix(RIGHT, DOWN, held),
        engine.integration.invert_laplacian(RIGHT, DOWN, held, tolerance=None),
        [],
    )
    u, v = np.random.default_rng(5).normal(size=(2, held.size))
    assert u @ (cycle @ v) == pytest.approx(v @ (cycle @ u), rel=1e-4)
    assert u @ (cycle @ u) > 0
    solution, status = algebra.cg(a, SOURCE.ravel(), M=cycle, rtol=1e-10, callback=steps.append)
    assert status == 0
    assert len(steps) <= 30  # 19; Jacobi's method takes 347
    assert np.linalg.norm(a @ solution - SOURCE.ravel()) < 1e-9 * np.linalg.norm(SOURCE)


def test_a_solver_in_float64_needs_few_steps_with_it():
    a, steps = matrix(RIGHT, DOWN, HELD + 1e-2), []
    inverse = engine.integration.invert_laplacian(RIGHT, DOWN, HELD + 1e-2)
    solution, status = algebra.cg(a, SOURCE.ravel(), M=inverse, rtol=1e-12, callback=steps.append)
    assert status == 0
    assert len(steps) <= 4
    assert np.linalg.norm(a @ solution - SOURCE.ravel()) < 1e-11 * np.linalg.norm(SOURCE)
    pair = np.stack([SOURCE.ravel(), np.zeros(SOURCE.size)], axis=1)
    np.testing.assert_array_equal((inverse.T @ pair)[:, 1], 0)


ONES = np.ones((3, 3)), np.ones((2, 4))
BAD = {
    "links have shapes (3, 3) and (3, 4)": (np.ones((3, 3)), np.ones((3, 4))),
    "links have shapes (3,) and": (np.ones(3), ONES[1]),
    "diagonal: shape (3, 3)": (*ONES, ONES[0]),
    "some are negative": (-ONES[0], ONES[1]),
    "some are negative or not finite": (*ONES, np.full((3, 4), np.nan)),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_refused_in_one_line(message):
    with pytest.raises(io.InputError) as error:
        engine.integration.invert_laplacian(*BAD[message])
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    with pytest.raises(io.InputError, match="not finite"):
        engine.integration.invert_laplacian(*ONES) @ np.full(12, np.nan)
