"""Bilateral normal integration as published, in double precision: a peer of robust integration.

Cao, Santo, Shi, Okura, Matsushita: Bilateral normal integration, ECCV 2022 (arXiv 2207.08551).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.evaluation.scenes.depth import Scene

Map = NDArray[np.float64]

_MOST, _CLOSE = 5000, 1e-3  # iterations of conjugate gradients, and the relative residual that ends them


def integrate_bilaterally(
    scene: Scene, k: float = 2.0, iterations: int = 150, rest: float = 1e-4
) -> tuple[Map, int]:
    """Return heights, (H, W), and the number of iterations.

    With z the depth in pixels, a pixel has four equations, to the right, left, up and down: n_z times the
    one-sided difference of z is n_x or n_y. If a pixel has neighbours on both sides, the squares are weighted
    by w = 1 / (1 + exp(-k (b^2 - a^2))), where a and b are n_z times the differences on this and on the other
    side; initially w = 1/2. Weights and z are updated alternately until the relative change of the energy is
    below `rest`; z is updated by conjugate gradients with a Jacobi preconditioner, from the last z.
    """
    from scipy import sparse
    from scipy.special import expit

    matrix, targets, valid = _equations(scene)
    both = valid.reshape(2, 2, -1).all(axis=1, keepdims=True)  # axis, side, pixel
    weights = np.where(both, 0.5, valid.reshape(2, 2, -1))
    depth, energy, steps = np.zeros(matrix.shape[1]), np.inf, 0
    while steps < iterations:
        steps += 1
        weighted = matrix.T @ sparse.diags_array(weights.ravel())
        depth = _solve(sparse.csr_array(weighted @ matrix), weighted @ targets, depth)
        differences = matrix @ depth
        last, energy = energy, float(weights.ravel() @ (differences - targets) ** 2)
        if abs(last - energy) < rest * last:
            break
        square = (differences**2).reshape(2, 2, -1)
        weights = np.where(both, expit(k * (square[:, ::-1] - square)), valid.reshape(2, 2, -1))
    height = np.full(scene.mask.shape, np.nan)
    height[scene.mask] = -scene.pixel_size * depth
    return height, steps


def _solve(matrix: Any, source: Map, start: Map) -> Map:
    """Solve by conjugate gradients; SciPy's solver spends most of its time on threads for sums."""

    def dot(left: Map, other: Map) -> float:
        return float(np.einsum("i,i", left, other))

    x, residual = start.copy(), source - matrix @ start
    inverse = 1 / np.maximum(matrix.diagonal(), 1e-30)
    direction, old = np.zeros_like(residual), np.inf
    for _ in range(_MOST):
        if dot(residual, residual) <= _CLOSE**2 * dot(source, source):
            break
        scaled = inverse * residual
        new = dot(residual, scaled)
        direction = scaled + new / old * direction
        image = matrix @ direction
        step, old = new / dot(direction, image), new
        x += step * direction
        residual -= step * image
    return x


def _equations(scene: Scene) -> tuple[Any, Map, NDArray[np.bool_]]:
    """Return matrix (4 N, N), right side (4 N,) and which neighbours exist: right, left, up, down."""
    from scipy import sparse

    mask, (across, up, towards) = scene.mask, np.moveaxis(scene.normals[scene.mask], -1, 0)
    row, column = np.nonzero(mask)
    ringed = np.pad(np.where(mask, np.cumsum(mask).reshape(mask.shape) - 1, -1), 1, constant_values=-1)
    here = np.arange(len(row))
    parts, targets, valid = [], [], []
    for below, right, slope in ((0, 1, across), (0, -1, across), (-1, 0, up), (1, 0, up)):
        other = ringed[row + 1 + below, column + 1 + right]
        exists = other >= 0
        factor = np.where(exists, (right - below) * towards, 0.0)
        places = np.tile(here, 2), np.concatenate([np.where(exists, other, here), here])
        parts.append(sparse.coo_array((np.concatenate([factor, -factor]), places), (len(here),) * 2))
        targets.append(np.where(exists, slope, 0.0))
        valid.append(exists)
    return sparse.csr_array(sparse.vstack(parts)), np.concatenate(targets), np.concatenate(valid)
