"""Heights on any graph of pixels: conjugate gradients, preconditioned by a multigrid V-cycle."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from mirrorskin.engine.integration.graph import Links
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


_CYCLES = 2  # that are enough where no tolerance is given
_PATIENCE, _PROGRESS = (
    4,
    0.7,
)  # iterations in which the residual must fall to this share: float32 can do no more
_LOST = 0.3  # residual from which on up two cycles have failed
_ROUNDING = 1e-6  # of the right side: what is left over of an exact answer
_FIRM = 1e-3  # share of known heights in the energy that errors are measured against
_NEAR = 0.03  # residual from which on down the heights' energy is known well enough


@dataclass(frozen=True, slots=True)
class Solution:
    """What a solver found.

    Attributes
    ----------
    height : Array, (H, W), float32
        On the device, until the next solution; each component without an anchor has an offset of its own that
        means nothing.
    iterations : int
        Cycles that were done.
    residual : float
        How far the heights are from the solution: norm of the error over that of the heights, both as u A u
        has it, so of slopes and anchors by their weights.
    converged : bool
        Whether the residual is as small as was asked for; where nothing was, whether it is below 0.3.
    """

    height: Array
    iterations: int
    residual: float
    converged: bool


class Multigrid:
    """A solver for graphs of pixels: any mask, weights, cuts and known heights.

    Conjugate gradients, whose preconditioner is a V-cycle of `Cycle`.

    Parameters
    ----------
    links : Links
    plain : bool
        See `rebuild`.
    """

    def __init__(self, links: Links, *, plain: bool = False) -> None:
        self._device = links.device
        self._height = self._device.array("height", links.shape, np.float32)
        self._hierarchy = Hierarchy(links.shape, links.anchor is not None, links.device)
        finest = self._hierarchy.levels[0]
        self._x, self._p, self._before, self._image = (
            self._device.array(name, (finest.end,), np.float32)
            for name in ("x", "direction", "direction before", "image")
        )
        parts = -(-finest.nodes // part_of(self._device))
        self._parts = self._device.array("parts", (parts,), np.float32)
        for array in (self._height, self._x, self._p, self._before, self._image, self._parts):
            array.upload()
        self._cycle = Cycle(self._hierarchy)
        self._plane: Array | None = None
        self.rebuild(links, plain=plain)

    def rebuild(self, links: Links, *, plain: bool = False) -> None:
        """Take another graph of the same shape; what was allocated is used again.

        A plain one takes no care of what hangs together badly: solutions take more cycles.
        """
        if (links.anchor is not None) != self._hierarchy.anchored:
            self._hierarchy = Hierarchy(links.shape, links.anchor is not None, links.device)
            self._cycle = Cycle(self._hierarchy)
        self._links = links
        self._hierarchy.build(links, plain=plain)
        self._cycle.prepare()

    def solve(
        self,
        start: Array | None = None,
        *,
        tolerance: float | None = 1e-5,
        limit: int = 100,
        deadline: float | None = None,
    ) -> Solution:
        """Solve for the heights.

        Parameters
        ----------
        start : Array, (H, W), float32, optional
            Heights to begin with, on the device; it is not changed. By default full multigrid makes them.
        tolerance : float or None
            Of the residual; None: two cycles after the start are enough.
        limit : int
            Of the iterations.
        deadline : float, optional
            Of ``time.perf_counter``: no further cycle is begun that would end later.
        """
        h = self._hierarchy
        h.admit(self._links.source, self._cycle.full_b)
        count = _CYCLES if tolerance is None else limit
        goal = 0.0 if tolerance is None else tolerance
        enough = _LOST if tolerance is None else tolerance
        done, residual = self._try(start, goal, count, deadline)
        late = deadline is not None and time.perf_counter() > deadline
        if residual > enough and done < count + (tolerance is None) and self._cycle.twice and not late:
            self._cycle.twice = False  # it was not positive definite; plain V-cycles always are
            more, residual = self._try(start, goal, count, deadline)
            done += more
        h.kernel("release")(*h.picture, self._x, self._height, moved=8 * h.levels[0].nodes)
        return Solution(self._height, done, residual, residual <= enough)

    def follow(self, links: Links, *, deep: bool) -> Array:
        """Go one step from the last heights towards those of a graph that is nearly the last one.

        The step is the best one in the plane of what a cycle makes of what is left over, and of the step
        before: conjugate gradients, as far as the graph is the same, and heights cannot become worse in any
        case. All of it is on the device's queue when this returns.

        Parameters
        ----------
        links : Links
        deep : bool
            Whether to look at all levels of the graph anew, but the coarsest, or at the finest alone.

        Returns
        -------
        Array, (H, W), float32
            Heights, until the next solution or step.
        """
        h, cycle, level = self._hierarchy, self._cycle, self._hierarchy.levels[0]
        h.follow(links, deep=deep)
        h.admit(links.source, cycle.full_b)
        items = -(-level.nodes // self._device.layout.tile)
        rest = cycle.full_b, self._x, cycle.b
        h.kernel("residual")(items, *place(level), *h.graph, *rest, moved=20 * level.nodes)
        self._products = cycle.launch()
        count = len(self._parts.host)
        if self._plane is None:
            self._plane = self._device.array("parts", (4 * count,), np.float32)
            self._plane.upload()
        vectors = cycle.b, cycle.x, self._p
        arguments = *place(level), *h.graph, *vectors, np.int32(count), self._plane
        h.kernel("curve")(count, *arguments, moved=20 * level.nodes)
        sums = *self._products, np.int32(count), self._plane
        vectors = cycle.x, self._p, self._x
        h.kernel("follow")(items, *place(level), *sums, *vectors, moved=20 * level.nodes)
        h.kernel("release")(*h.picture, self._x, self._height, moved=8 * level.nodes)
        return self._height

    def tell_gap(self) -> float:
        """Return how far heights were from the solution before the last step; see ``Solution.residual``."""
        count, parts = self._products
        product = float(parts.download()[:count].sum(dtype=np.float64))
        if product == 0:
            return 0.0
        energy = self._energy()
        return math.sqrt(product / energy) if product > 0 and energy > 0 else math.inf

    def _try(self, start: Array | None, goal: float, limit: int, deadline: float | None) -> tuple[int, float]:
        """Solve from a start; return how many steps were done, and the residual."""
        if start is not None:
            self._hierarchy.admit(start, self._x)
            asked = self._dot(self._cycle.full_b, self._cycle.full_b)
            left = self._leave()
            if left <= asked:  # a start that is worse than none, or not finite, is none
                return self._iterate(left, goal, limit, deadline)
        self._cycle.start(self._x)
        return self._iterate(self._leave(), goal, limit, deadline)

    def _leave(self) -> float:
        """Find what the heights leave over; return its square."""
        h, cycle = self._hierarchy, self._cycle
        level = h.levels[0]
        items = -(-level.nodes // self._device.layout.tile)
        rest = cycle.full_b, self._x, cycle.b
        h.kernel("residual")(items, *place(level), *h.graph, *rest, moved=20 * level.nodes)
        return self._dot(cycle.b, cycle.b)

    def _iterate(self, left: float, goal: float, limit: int, deadline: float | None) -> tuple[int, float]:
        """Do conjugate gradients; return how many steps were done, and the residual."""
        before, done, energy, residual = 0.0, 0, 0.0, 0.0 if left == 0 else math.inf
        best, progress = math.inf, 0
        while done < limit and residual > goal and done - progress < _PATIENCE:
            begun = time.perf_counter()
            product = self._cycle.run()
            if not product > 0:
                whole = self._dot(self._cycle.full_b, self._cycle.full_b)
                return done, 0.0 if left <= _ROUNDING**2 * whole else residual
            after = self._step(product / before if done else 0.0, product)
            if residual > _NEAR:
                energy = self._energy()
            # The product tells the energy of the error before the step; squares tell what the step did to it.
            residual = math.sqrt(product * after / left / energy) if energy > 0 else math.inf
            before, left = product, after
            done += 1
            if residual < _PROGRESS * best:
                best, progress = residual, done
            now = time.perf_counter()
            if deadline is not None and now + (now - begun) > deadline:
                break
        return done, residual

    def _energy(self) -> float:
        """Return what the links weigh of heights; firm anchors, if they counted fully, would hide that."""
        whole = self._dot(self._cycle.full_b, self._x)
        if not self._hierarchy.anchored:
            return whole
        anchored = self._total("weigh", self._hierarchy.anchor, self._x)
        return max(whole - anchored, _FIRM * whole)

    def _step(self, beta: float, product: float) -> float:
        """Take a step; return the square of what is left over."""
        h, cycle, parts = self._hierarchy, self._cycle, self._parts
        level = h.levels[0]
        before = self._before if beta else cycle.x  # of the last solution there may be infinities
        vectors = cycle.x, before, self._p, self._image, parts
        arguments = *place(level), np.float32(beta), *h.graph, *vectors
        h.kernel("direct")(len(parts.host), *arguments, moved=24 * level.nodes)
        curvature = _sum(parts)
        self._p, self._before = self._before, self._p
        alpha = np.float32(product / curvature if curvature > 0 else 0.0)
        vectors = self._before, self._image, cycle.b, self._x, parts
        h.kernel("advance")(len(parts.host), *place(level), alpha, *vectors, moved=24 * level.nodes)
        return _sum(parts)

    def _dot(self, one: Array, other: Array) -> float:
        return self._total("dot", one, other)

    def _total(self, name: str, one: Array, other: Array) -> float:
        """Return a sum over the finest level."""
        level = self._hierarchy.levels[0]
        arguments = *place(level), one, other, self._parts
        self._hierarchy.kernel(name)(len(self._parts.host), *arguments, moved=8 * level.nodes)
        return _sum(self._parts)


def _sum(parts: Array) -> float:
    """Add up what items told, and give the array back to the device."""
    return float(parts.download().sum(dtype=np.float64))
