"""Graphs of pixels for the solvers, and their sparse direct solution, independent of the engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

Array = NDArray[np.float64]


@dataclass
class PixelGraph:
    """Weights of links to the right and down, (H, W), of anchors, and the right side."""

    right: Array
    down: Array
    anchor: Array | None
    source: Array

    @property
    def ends(self) -> tuple[Array, Array, Array]:
        index = np.arange(self.right.size).reshape(self.right.shape)
        a = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
        b = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
        w = np.concatenate([self.right[:, :-1].ravel(), self.down[:-1].ravel()])
        return a[w > 0], b[w > 0], w[w > 0]

    @property
    def matrix(self) -> sp.csr_matrix:
        a, b, w = self.ends
        n = self.right.size
        links = sp.coo_matrix((w, (a, b)), (n, n)).tocsr()
        links = links + links.T
        diagonal = np.asarray(links.sum(axis=1)).ravel()
        if self.anchor is not None:
            diagonal = diagonal + self.anchor.ravel()
        return (sp.diags(diagonal) - links).tocsr()

    def labels(self) -> NDArray[np.int32]:
        return connected_components(self.matrix, directed=False)[1].reshape(self.right.shape)

    def solve(self) -> Array:
        """Solve it exactly; what is free has a mean of zero."""
        label = self.labels().ravel()
        n = label.size
        anchors = np.zeros(n) if self.anchor is None else self.anchor.ravel()
        free = np.bincount(label, anchors) == 0
        first = np.unique(label, return_index=True)[1][free]
        pin = np.zeros(n)
        pin[first] = 1
        heights = spsolve((self.matrix + sp.diags(pin)).tocsc(), self.source.ravel())
        return self.centred(heights.reshape(self.right.shape))

    def centred(self, heights: Array) -> Array:
        """Take away the means of what is free."""
        label = self.labels().ravel()
        anchors = np.zeros(label.size) if self.anchor is None else self.anchor.ravel()
        mean = np.bincount(label, heights.ravel()) / np.bincount(label)
        mean[np.bincount(label, anchors) > 0] = 0
        return heights - mean[label].reshape(heights.shape)


KINDS = ("rectangle", "disc", "annulus", "holes", "cuts", "soft", "uneven", "isolated", "comb")


def pixel_graph(kind: str, shape: tuple[int, int], anchored: bool = False, seed: int = 0) -> PixelGraph:
    """Make a graph of a kind, with noisy slopes of some hills."""
    rng = np.random.default_rng(seed)
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns].astype(float)
    valid = _mask(kind, y / max(rows - 1, 1) * 2 - 1, x / max(columns - 1, 1) * 2 - 1, rng)
    right, down = np.zeros(shape), np.zeros(shape)
    right[:, :-1] = valid[:, 1:] & valid[:, :-1]
    down[:-1] = valid[1:] & valid[:-1]
    if kind in ("cuts", "soft"):
        _cut(right, down, y, x, 0.0 if kind == "cuts" else 1e-3, rng)
    if kind == "uneven":
        right *= np.exp(rng.normal(size=shape))
        down *= np.exp(rng.normal(size=shape))
    hills = np.sin(3 * x / columns + 1) * np.cos(4 * y / rows) + 0.3 * np.sin(20 * x * y / right.size)
    hills *= max(shape) / 4
    along = right * (np.diff(hills, axis=1, append=0) + rng.normal(0, 0.03, shape))
    across = down * (np.diff(hills, axis=0, append=0) + rng.normal(0, 0.03, shape))
    source = -along - across
    source[:, 1:] += along[:, :-1]
    source[1:] += across[:-1]
    anchor = None
    if anchored:
        anchor = np.where(valid & (rng.random(shape) < 0.05), 0.02, 0.0)
        source = source + anchor * hills
    return PixelGraph(right, down, anchor, source)


def _mask(kind: str, y: Array, x: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    radius = np.hypot(y, x)
    if kind == "disc":
        return radius < 0.9
    if kind == "annulus":
        return (radius < 0.95) & (radius > 0.4)
    if kind == "holes":
        return rng.random(y.shape) > 0.2
    if kind == "isolated":
        return rng.random(y.shape) > 0.7
    if kind == "comb":
        comb = np.ones(y.shape, bool)
        comb[1:, 1::2] = False
        return comb
    return np.ones(y.shape, bool)


def _cut(right: Array, down: Array, y: Array, x: Array, fraction: float, rng: np.random.Generator) -> None:
    rows, columns = right.shape
    for _ in range(12):
        angle, length = rng.uniform(0, np.pi), rng.uniform(0.1, 0.5) * columns
        from_x, from_y = x - rng.uniform(0, columns), y - rng.uniform(0, rows)
        along = from_x * np.cos(angle) + from_y * np.sin(angle)
        side = from_y * np.cos(angle) - from_x * np.sin(angle) > 0
        near = np.abs(along) < length / 2
        right[:, :-1][(side[:, 1:] != side[:, :-1]) & near[:, 1:]] *= fraction
        down[:-1][(side[1:] != side[:-1]) & near[1:]] *= fraction
