"""A V-cycle, and full multigrid: what conjugate gradients begin with and are preconditioned by."""

from __future__ import annotations

import numpy as np

from mirrorskin.engine.integration.hierarchy import Hierarchy, pair, part_of, place
from mirrorskin.kernels.array import Array

_STEPS = np.float32(1.3896), np.float32(0.5617)  # of Chebyshev's polynomial over the upper spectrum
_TWICE = range(2, 5)  # levels that are gone through a second time, for what the first left over
_TAIL, _ODD_TAIL = 20480, 81920  # nodes of a level from which on down one item does all; where some are odd
_BAND = 8  # coarse rows of an item, in passes that do half a cycle
_LINES, _MARGIN = 8, 8  # as in the kernel


class Cycle:
    """Room for the cycles over a hierarchy, and how they go.

    Two steps of Jacobi's method, chosen after Chebyshev, smooth on the way down and up; a third smooths what
    is handed on. Three of the coarser levels are gone through twice, which mends what coarsening does to
    cuts. Of levels without odd links half a cycle is one pass, and all small levels together are one.

    Parameters
    ----------
    hierarchy : Hierarchy

    Attributes
    ----------
    b, x : Array, (nodes,), float32
        Of all levels, what is asked for and the answer.
    full_b : Array, (nodes,), float32
        What full multigrid is asked for.
    twice : bool
        Whether coarser levels are gone through twice. Where their answers are more than twice too large, as
        in a comb, that is not positive definite any more.
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        self._h = hierarchy
        self._nodes = 0
        self._one_pass = hierarchy.device.layout.tile > 1
        bands = -(-hierarchy.levels[0].rows // 2 // _BAND) + 1
        width = hierarchy.levels[0].stride + 2 * _MARGIN
        size = bands * _LINES * width if self._one_pass else 1
        self._lines = hierarchy.device.array("lines", (size,), np.float32)
        parts = -(-hierarchy.levels[0].nodes // part_of(hierarchy.device))
        self._parts = hierarchy.device.array("parts", (max(parts, bands),), np.float32)
        self._lines.upload()
        self._parts.upload()

    def prepare(self) -> None:
        """Make ready for what the hierarchy holds now."""
        h = self._h
        self.twice = True
        if h.nodes > self._nodes:
            self._nodes = h.nodes
            names = (
                "right side",
                "heights",
                "other heights",
                "full right side",
                "full heights",
                "kept heights",
            )
            arrays = [h.device.array(name, (h.nodes,), np.float32) for name in names]
            for array in arrays:
                array.upload()
            self.b, self.x, self._t, self.full_b, self._full_x, self._kept = arrays
        self._each("clear", len(h.levels) - 1, self.x)  # of the coarsest, only nodes with links are solved
        table = []
        for level, odd in zip(h.levels, h.odd, strict=True):
            spans = odd.nodes, odd.graph, odd.restrict, odd.prolong
            numbers = [number for rows in spans for number in (rows.at, rows.count)]
            table.append([level.base, level.rows, level.stride, *numbers])
        self._table = h.device.given("levels", np.array(table), np.int32)
        self._tail = self._first_of_tail()
        self._odd_rows = [self._rows_of(number) for number in range(len(h.levels))]

    def _first_of_tail(self) -> int:
        """Return the level from which on down one item does all; the coarsest, where items are lanes."""
        last = len(self._h.levels) - 1
        for number, (level, odd) in enumerate(zip(self._h.levels, self._h.odd, strict=True)):
            limit = _ODD_TAIL if odd.graph.count else _TAIL
            if self._one_pass and number > 0 and level.nodes <= limit:
                return number
        return last

    def _rows_of(self, number: int) -> Array:
        """Return where the table's rows for odd prolongation begin of each row of a level's picture."""
        level, rows = self._h.levels[number], self._h.odd[number].prolong
        if not rows.count or self._h.odd[number].graph.count:
            return self._h.device.given("rows", np.zeros(1), np.int32)
        nodes = self._h.table[0].download()[rows.at : rows.at + rows.count]
        first = level.first + level.stride * np.arange(level.rows + 1)
        starts = np.searchsorted(nodes, first) + rows.at
        self._h.table[0].upload()
        return self._h.device.given("rows", starts, np.int32)

    def start(self, to: Array) -> None:
        """Make heights of the finest level by full multigrid, but for its own cycle.

        Parameters
        ----------
        to : Array, float32
            Where they go; ``full_b`` is what is asked for.
        """
        if self._tail == 0:
            to.claim()
            to.host[...] = 0
            to.upload()
            return
        for number in range(self._tail):
            self._ask(number)
        self._run_tail("tail_full", self.full_b, self._full_x)
        for number in range(self._tail - 1, -1, -1):
            self._prolong(number, 0.0, self.full_b, self._full_x if number else to)
            if number:
                self._leave(number, False, self.full_b, self._full_x, self.b)
                self.run(number)
                self._each("add", number, self._full_x, self.x)

    def _ask(self, number: int) -> None:
        """Ask the next level for what full multigrid is asked for at this one."""
        h = self._h
        if h.odd[number].restrict.count:
            self._each("scale", number, h.inverse, self.full_b, self._t)
            self._restrict(number, self._t, self.full_b)
        else:
            fine, coarse = h.levels[number : number + 2]
            vectors = self.full_b, self.full_b
            h.kernel("gather")(coarse.rows, *pair(fine, coarse), *vectors, moved=5 * fine.nodes)

    def run(self, number: int = 0) -> float:
        """Do a cycle from a level on, from heights of zero: what b asks for goes to x.

        Returns
        -------
        float
            Of the finest level the product of both; of others 0.
        """
        self._go(number)
        return self._sum() if number == 0 else 0.0

    def launch(self) -> tuple[np.int32, Array]:
        """Put a cycle from the finest level on the queue; return how many parts its product has, and them."""
        self._go(0)
        return np.int32(self._told), self._parts

    def _go(self, number: int) -> None:
        """Do a cycle from a level on; parts of the product are then told, of the finest level."""
        if number >= self._tail:
            self._run_tail("tail_cycle")
            if number == 0:
                self._multiply()
            return
        self._go_through(number)
        if self.twice and number in _TWICE:
            self._leave(number, False, self.b, self.x, self._t)
            self._each("keep", number, self._t, self.x, self.b, self._kept)
            self._go_through(number)
            self._each("add", number, self._kept, self.x)

    def _go_through(self, number: int) -> None:
        """Go from a level down and up again."""
        if self._one_pass and not self._h.odd[number].graph.count:
            self._descend(number)
            self._go(number + 1)
            self._ascend(number)
            return
        self._begin(number)
        self._leave(number, True, self.b, self._t, self.x)
        self._restrict(number, self.x, self.b)
        self._go(number + 1)
        self._prolong(number, 1.0, self._t, self.x)
        self._smooth(number, _STEPS[1], self.x, self._t)
        self._smooth(number, _STEPS[0], self._t, self.x)
        if number == 0:
            self._multiply()

    def _descend(self, number: int) -> None:
        """Go down by one level in one pass."""
        h, odd = self._h, self._h.odd[number].restrict
        fine, coarse = h.levels[number : number + 2]
        where = *place(fine), np.int32(coarse.base), np.int32(coarse.rows), np.int32(coarse.stride)
        vectors = h.inverse, self.b, self._t, self.x, self._lines, self.b
        arguments = *where, np.int32(_BAND), np.int32(odd.count > 0), *_STEPS, *h.graph, *vectors
        h.kernel("descend")(-(-coarse.rows // _BAND), *arguments, moved=21 * fine.nodes)
        h.run_odd("restrict", odd, self.x, self.b)

    def _ascend(self, number: int) -> None:
        """Go up by one level in one pass."""
        h, odd = self._h, self._h.odd[number].prolong
        fine, coarse = h.levels[number : number + 2]
        where = *place(fine), np.int32(coarse.base), np.int32(coarse.rows), np.int32(coarse.stride)
        vectors = h.inverse, self.b, self.x, self._t, self._lines, self.x, self._parts
        table = np.int32(odd.count), self._odd_rows[number], *h.table
        arguments = *where, np.int32(_BAND), *_STEPS, *h.graph, *vectors, *table
        items = -(-coarse.rows // _BAND)
        h.kernel("ascend")(items, *arguments, moved=25 * fine.nodes)
        self._told = items

    def _begin(self, number: int) -> None:
        h = self._h
        self._plain("begin", number, *_STEPS, *h.graph, h.inverse, self.b, self._t)
        h.run_odd("begin", h.odd[number].graph, *_STEPS, h.anchor, h.inverse, self.b, self._t)

    def _smooth(self, number: int, step: np.float32, one: Array, other: Array) -> None:
        h = self._h
        self._plain("smooth", number, step, *h.graph, self.b, one, other)
        h.run_odd("smooth", h.odd[number].graph, step, h.anchor, h.inverse, self.b, one, other)

    def _leave(self, number: int, divide: bool, b: Array, x: Array, left: Array) -> None:
        h = self._h
        self._plain("leave" if divide else "residual", number, *h.graph, b, x, left)
        h.run_odd("leave", h.odd[number].graph, np.int32(divide), h.anchor, h.inverse, b, x, left)

    def _restrict(self, number: int, left: Array, b: Array) -> None:
        h = self._h
        fine, coarse = h.levels[number : number + 2]
        h.kernel("restrict")(
            coarse.rows, *pair(fine, coarse), h.right, h.down, left, b, moved=13 * fine.nodes
        )
        h.run_odd("restrict", h.odd[number].restrict, left, b)

    def _prolong(self, number: int, keep: float, x: Array, to: Array) -> None:
        h = self._h
        fine, coarse = h.levels[number : number + 2]
        arguments = np.float32(keep), h.right, h.down, h.inverse, self.x, x, to
        h.kernel("prolong")(coarse.rows, *pair(fine, coarse), *arguments, moved=20 * fine.nodes)
        h.run_odd("prolong", h.odd[number].prolong, np.float32(keep), h.inverse, self.x, x, to)

    def _plain(self, name: str, number: int, *args: Array | np.generic) -> None:
        """Run a pass over a level's picture."""
        level = self._h.levels[number]
        items = -(-level.nodes // self._h.device.layout.tile)
        self._h.kernel(name)(items, *place(level), *args, moved=20 * level.nodes)

    def _each(self, name: str, number: int, *args: Array) -> None:
        """Run a pass over a level's picture and its odd nodes."""
        self._plain(name, number, *args)
        self._h.over_odd(name, self._h.odd[number].nodes, *args)

    def _run_tail(self, name: str, *vectors: Array) -> None:
        """Do all of the small levels, or the coarsest alone where items are lanes."""
        h = self._h
        nodes, matrix = h.bottom
        count = np.int32(len(nodes.host))
        if not self._one_pass:
            b = self.full_b if name == "tail_full" else self.b
            h.kernel("solve")(int(count), count, nodes, matrix, b, self.x, moved=4 * int(count) ** 2)
            return
        ends = np.int32(self._tail), np.int32(len(h.levels) - 1)
        graph = self._table, *h.graph, h.inverse, *h.table, count, nodes, matrix, *_STEPS
        twice = _TWICE if self.twice else range(0)
        cycle = np.int32(twice.start), np.int32(twice.stop), self.b, self.x, self._t, self._kept
        moved = 400 * h.levels[self._tail].nodes
        h.kernel(name)(1, *ends, *graph, *cycle, *vectors, moved=moved)

    def _multiply(self) -> None:
        """Tell parts of the product of what is asked for and the answer."""
        level = self._h.levels[0]
        self._told = -(-level.nodes // part_of(self._h.device))
        arguments = *place(level), self.b, self.x, self._parts
        self._h.kernel("dot")(self._told, *arguments, moved=8 * level.nodes)

    def _sum(self) -> float:
        return float(self._parts.download()[: self._told].sum(dtype=np.float64))
