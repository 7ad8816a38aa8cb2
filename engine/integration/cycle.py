"""A multigrid cycle over all levels of a hierarchy, for one or several right sides at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mirrorskin.engine.integration.hierarchy import (
    Hierarchy,
    Level,
    near_nodes,
    tile_columns,
    tile_rows,
)
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Kernel

_FIRST_W_LEVEL = 2  # finest level that is visited twice where launches are cheap
_WEAKEST_ANCHORS = 1e-12  # weight relative to a component's links up to which its offset is free


def add_parts(parts: Array) -> Doubles:
    """Return the sums of partial sums, (lanes,)."""
    values = parts.read()
    sums: Doubles = np.ascontiguousarray(values.reshape(len(values), -1).T).sum(axis=1, dtype=np.float64)
    return sums


class Cycle:
    """A cycle over a hierarchy, and its memory: ``b`` is the right side at all nodes, ``x`` the solution.

    With several right sides (``lanes``), the values of a node are adjacent in memory.

    The smoother does three or four Jacobi steps while descending, and as many while ascending. Each half is
    one kernel, whose work-groups keep a tile of the level in local memory. One kernel processes all small
    levels. On a GPU, where launches dominate, the larger levels are visited once (V-cycle), with one
    additional step.
    """

    b: Array
    x: Array
    other_x: Array

    def __init__(self, hierarchy: Hierarchy, lanes: int = 1) -> None:
        h, self._lanes = hierarchy, lanes
        self._h = h
        names = "right side", "heights", "other heights", "residual"
        self.b, self.x, self.other_x, self._rest = (h.array(name, lanes=lanes) for name in names)
        self._tail = h.first_of_tail(lanes)
        # Levels from this one on are visited twice (W-cycle), with any number of right sides.
        self._first_w_level: int = h.first_of_tail(1) if near_nodes(h.device, 1) else _FIRST_W_LEVEL
        tiles = [self._tiles(level) for level in h.levels[: self._tail]]
        self._first_tile = np.cumsum([0, *tiles])
        self.parts: Array = h.array("parts", self._tiles(h.levels[0]), lanes=lanes)
        self._live = h.array("live", max(1, int(self._first_tile[-1])), dtype=np.uint8)

    def prepare(self) -> None:
        """Prepare for the current graph of the hierarchy."""
        self._factors: Callable[[Doubles], Doubles] | None = None
        self.follow(deep=True)

    def follow(self, *, deep: bool) -> None:
        """Invert the diagonals, and find the tiles that have nodes; cycles skip the others.

        Unless ``deep``, this is done for the finest level only.
        """
        h = self._h
        for number, level in enumerate(h.levels[: self._tail if deep else min(self._tail, 1)]):
            kernel = self._kernel("invert", level)
            items, place = self._tiles(level) * kernel.group, level.place | self._live_of(number)
            kernel(items, **place, **h.graph, inverse=h.inverse, moved=16 * level.nodes)

    def _live_of(self, number: int) -> dict[str, Any]:
        return {"live": self._live, "first_tile": int(self._first_tile[number])}

    def factorise(self) -> bool:
        """Use a direct solver on the host for the second level; return whether this is a change.

        Coarser levels join corridors that are narrower than their aggregates, which slows convergence.
        """
        from scipy import sparse
        from scipy.sparse.linalg import splu

        if self._tail == 0 or self._factors is not None:
            return False
        node, a, b, weight, pull = self._h.equations(1)
        count, first = len(node), node[0]
        links = sparse.coo_matrix((weight, (a - first, b - first)), (count, count))
        links = (links + links.T).tocsr()
        parts, label = sparse.csgraph.connected_components(links, directed=False)
        typical = np.asarray(links.sum(axis=1)).ravel()
        free = np.bincount(label, pull, parts) <= _WEAKEST_ANCHORS * np.bincount(label, typical, parts)
        fixed = np.zeros(count)  # one node of each free component
        fixed[np.unique(label, return_index=True)[1]] = np.where(free, 1.0, 0.0)
        matrix = sparse.diags(typical + pull + fixed) - links
        options = {"SymmetricMode": True}
        factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        self._factors = factors.solve
        return True

    def _solve_directly(self) -> None:
        """Solve the second level for its right side."""
        assert self._factors is not None
        level = self._h.levels[1]
        inside = slice(level.first, level.end - level.stride)
        x = self._factors(self.b.read(inside).astype(np.float64))
        with np.errstate(over="ignore"):  # nearly disconnected graphs: the iteration ends then
            self.x.write(x.astype(np.float32), inside.start)

    def run(self) -> Doubles:
        """Do a cycle from x = 0; return the product of b and x, (lanes,)."""
        self.launch()
        return self.product()

    def launch(self) -> None:
        """Enqueue a cycle, and the partial sums of the product."""
        self._go(0, again=False)
        if self._tail == 0:
            self._h.over_parts("dot", self.parts, one=self.b, other=self.x, lanes=self._lanes)

    def _go(self, number: int, *, again: bool) -> None:
        """Do a cycle over a level and all coarser ones, from x = 0 or, if ``again``, from the current x."""
        h = self._h
        if number == 1 and self._factors is not None:
            self._solve_directly()
            return
        if number == self._tail:
            self._run_tail()
            return
        keep = int(h.moves[number] > 0)
        self._half(
            "descend",
            number,
            again=again,
            x_before=self.x,
            keep=keep,
            t=self.other_x,
            residual=self._rest,
            coarse_b=self.b,
        )
        if number + 1 != self._tail or self._factors is not None:  # the tail's kernel includes this
            h.gather(number, self._rest, self.b, self._lanes)
        twice = self._first_w_level <= number + 1 < self._tail
        for second in (False, True)[: 1 + twice]:
            self._go(number + 1, again=second)
        arrays = {"e": self.x, "to": h.to, "t": self.other_x, "x_new": self.x, "parts": self.parts}
        self._half("ascend", number, moved_nodes=h.moves[number], **arrays)

    def _run_tail(self) -> None:
        """Process all small levels."""
        h = self._h
        last = len(h.levels) - 1
        kernel, moved = self._kernel("tail", h.levels[last]), 200 * h.levels[self._tail].nodes
        arguments: dict[str, Any] = {"levels": h.table, **h.graph, "inverse": h.inverse}
        arguments |= {
            "matrix": h.matrix,
            "to": h.to,
            "changed": h.changed,
            "changes": h.changes,
            "b": self.b,
            "x": self.x,
            "t": self.other_x,
        }
        arguments |= {"from": self._tail, "last": last, "twice": self._tail >= self._first_w_level}
        arguments["residual"] = self._rest
        kernel(kernel.group, **arguments, moved=moved)

    def product(self) -> Doubles:
        """Return the last cycle's product of right side and solution, (lanes,)."""
        return add_parts(self.parts)

    def _tiles(self, level: Level) -> int:
        return -(-level.rows // tile_rows(self._h.device, self._lanes)) * -(
            -level.stride // tile_columns(self._h.device, self._lanes)
        )

    def _kernel(self, name: str, level: Level, *, once: bool = True) -> Kernel:
        return self._h.kernel(name, self._h.links_of(level), self._lanes, once=once)

    def _half(self, name: str, number: int, **arguments: Any) -> None:
        """Descend or ascend by one level."""
        h = self._h
        fine = h.levels[number]
        kernel = self._kernel(name, fine, once=number < self._first_w_level)
        arguments |= {**h.graph, "inverse": h.inverse, "b": self.b, **self._live_of(number)}
        items = self._tiles(fine) * kernel.group
        kernel(items, **h.places(number), **arguments, moved=21 * fine.nodes)
