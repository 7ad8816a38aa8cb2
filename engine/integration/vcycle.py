"""Heights on any graph of pixels: conjugate gradients, preconditioned by a multigrid V-cycle."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.height_variance import JOINED, LEAST, find_graph_variance
from mirrorskin.engine.integration.hierarchy import STRENGTH, Hierarchy, part_of
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.links import KNOWN, SLOPE

_OMEGA, _THEN = 1.3896, 0.5617  # steps of Jacobi's method: Chebyshev's polynomial over the upper spectrum
_TWICE = range(2, 5)  # levels that are gone through a second time, for what the first left over
_TAIL, _SPLIT_TAIL = 20480, 81920  # nodes of a level from which on down one item does all; with split blocks
_BAND = 8  # coarse rows of an item, in passes that do half a cycle
_LINES, _MARGIN = 8, 8  # as in the kernel

_CYCLES = 2  # that are enough where no tolerance is given
_PATIENCE, _PROGRESS = 4, 0.7  # iterations in which the residual must fall by so much: float32 does no more
_FAILED = 0.3  # residual from which on up two cycles have failed
_ROUNDING = 1e-6  # of the right side: what is left over of an exact answer
_FIRM = 1e-3  # share of known heights in the energy that errors are measured against
_NEAR = 0.03  # residual from which on down the heights' energy is known well enough


@dataclass(frozen=True, slots=True)
class Solution:
    """What a solver found."""

    # (H, W), float32: on the device, until the next solution; a component without an anchor has an arbitrary
    # offset.
    height: Array
    iterations: int  # cycles that were done
    # Norm of the error over that of the heights, both as u A u has it, so of slopes and anchors by their
    # weights.
    residual: float
    converged: bool  # whether the residual is within the tolerance; without one, whether it is below 0.3


class Multigrid:
    """Conjugate gradients on graphs of pixels with any mask, weights, cuts and known heights."""

    def __init__(self, links: Links, *, plain: bool = False) -> None:
        self._device = links.device
        self._height = self._device.array("height", links.shape, np.float32)
        self._height.upload()
        h = self._hierarchy = Hierarchy(links.shape, links.anchor is not None, links.device)
        finest = h.levels[0]
        names = "x", "direction", "direction before", "image"
        self._x, self._p, self._before, self._image = (h.array(name, finest.end) for name in names)
        self._parts = h.array("parts", -(-finest.nodes // part_of(self._device)))
        self._products: Array | None = None
        self._cycle = VCycle(h)
        self.rebuild(links, plain=plain)

    def rebuild(self, links: Links, *, plain: bool = False, strength: float = STRENGTH) -> None:
        """Take another graph of the same shape; what was allocated is used again.

        A plain one splits no aggregates: solutions take more cycles where there are cuts.
        """
        if (links.anchor is not None) != self._hierarchy.anchored:
            self._hierarchy = Hierarchy(links.shape, links.anchor is not None, links.device)
            self._cycle = VCycle(self._hierarchy)
        self._links = links
        self._hierarchy.build(links, plain=plain, strength=strength)
        self._cycle.prepare()

    def solve(
        self,
        start: Array | None = None,
        *,
        tolerance: float | None = 1e-5,
        limit: int = 100,
        deadline: float | None = None,
    ) -> Solution:
        """Solve for the heights, from a start, (H, W), or from what full multigrid makes.

        It ends when the residual is within the tolerance (None: after two cycles), after ``limit`` cycles, or
        when the next one would end after ``deadline``, of ``time.perf_counter``.
        """
        h = self._hierarchy
        h.copy_picture("admit", self._cycle.full_b, self._links.source)
        count = _CYCLES if tolerance is None else limit
        goal = 0.0 if tolerance is None else tolerance
        enough = _FAILED if tolerance is None else tolerance
        done, residual = self._attempt(start, goal, count, deadline)
        late = deadline is not None and time.perf_counter() > deadline
        if residual > enough and done < count + (tolerance is None) and self._cycle.twice and not late:
            self._cycle.twice = False  # it was not positive definite; plain V-cycles always are
            more, residual = self._attempt(start, goal, count, deadline)
            done += more
        h.copy_picture("release", self._x, self._height)
        return Solution(self._height, done, residual, residual <= enough)

    def follow(self, links: Links, *, deep: bool) -> Array:
        """Go one step from the last heights towards those of a graph that is nearly the last one.

        The step is the best one in the plane of the preconditioned residual and the step before: conjugate
        gradients, as far as the graph is the same, and heights cannot become worse in any case. All of it is
        on the device's queue when this returns; heights are valid until the next solution or step. ``deep``:
        rebuild all levels of the graph but the coarsest, rather than the finest alone.
        """
        h, cycle = self._hierarchy, self._cycle
        h.follow(links, deep=deep)
        h.copy_picture("admit", cycle.full_b, links.source)
        self._find_residual()
        cycle.launch()
        count = len(self._parts.host)
        if self._products is None:
            self._products = h.array("parts", 4 * count)
        step = {"z": cycle.x, "p": self._p}
        h.over_parts("curve", self._products, **h.graph, b=cycle.b, **step, count=count)
        products = {"products": cycle.parts_filled, "product": cycle.parts}
        h.over_grid("follow", h.levels[0], **products, count=count, parts=self._products, **step, x=self._x)
        h.copy_picture("release", self._x, self._height)
        return self._height

    def deviation(self, answered: NDArray[np.bool_], flags: Array, uneven: bool) -> NDArray[np.float32]:
        """Return the heights' standard deviation, (H, W), where the weights are one over a variance.

        ``answered`` are the pixels with heights, as ``flags`` say on the device. Of links that are
        ``uneven``, the graph must be built anew before the next solution.
        """
        if uneven:
            self.rebuild(self._links, strength=JOINED)
        h = self._hierarchy
        find_graph_variance(h, answered, self._cycle.rooms)
        finest, found = h.levels[0], self._device.array("sigma", self._links.shape, np.float32)
        sizes = {"rows": finest.rows, "columns": finest.columns, "stride": finest.stride}
        numbers: dict[str, Any] = {"least": LEAST, "wanted": SLOPE | KNOWN}
        maps: dict[str, Any] = {"flags": flags, "inverse": h.inverse, "variance": self._cycle.x, "map": found}
        h.kernel("deviation")(finest.rows, **sizes, **numbers, **maps, moved=13 * finest.nodes)
        deviation: NDArray[np.float32] = found.detach()
        return deviation

    def gap(self) -> float:
        """Return how far heights were from the solution before the last step; see ``Solution.residual``."""
        product = self._cycle.product()
        if product == 0:
            return 0.0
        energy = self._energy()
        return math.sqrt(product / energy) if product > 0 and energy > 0 else math.inf

    def _attempt(self, start: Array | None, *until: Any) -> tuple[int, float]:
        """Solve from a start; return how many steps were done, and the residual."""
        if start is not None:
            self._hierarchy.copy_picture("admit", self._x, start)
            given = self._dot(self._cycle.full_b, self._cycle.full_b)
            rest = self._find_residual_square()
            if rest <= given:  # a start that is worse than none, or not finite, is none
                return self._iterate(rest, *until)
        self._cycle.start(self._x)
        return self._iterate(self._find_residual_square(), *until)

    def _find_residual(self) -> None:
        h, cycle = self._hierarchy, self._cycle
        h.over_grid("residual", h.levels[0], **h.graph, b=cycle.full_b, x=self._x, residual=cycle.b)

    def _find_residual_square(self) -> float:
        self._find_residual()
        return self._dot(self._cycle.b, self._cycle.b)

    def _iterate(self, rest: float, goal: float, limit: int, deadline: float | None) -> tuple[int, float]:
        """Do conjugate gradients; return how many steps were done, and the residual."""
        before, done, energy, residual = 0.0, 0, 0.0, 0.0 if rest == 0 else math.inf
        best, progress = math.inf, 0
        while done < limit and residual > goal and done - progress < _PATIENCE:
            begun = time.perf_counter()
            product = self._cycle.run()
            if not product > 0:
                given = self._dot(self._cycle.full_b, self._cycle.full_b)
                return done, 0.0 if rest <= _ROUNDING**2 * given else residual
            after = self._step(product / before if done else 0.0, product)
            if residual > _NEAR:
                energy = self._energy()
            # The product is the energy of the error before the step; squares say what the step did to it.
            residual = math.sqrt(product * after / rest / energy) if energy > 0 else math.inf
            before, rest = product, after
            done += 1
            if residual < _PROGRESS * best:
                best, progress = residual, done
            now = time.perf_counter()
            if deadline is not None and now + (now - begun) > deadline:
                break
        return done, residual

    def _energy(self) -> float:
        """Return the heights' energy in the links; firm anchors, if they counted fully, would hide that."""
        energy = self._dot(self._cycle.full_b, self._x)
        if not self._hierarchy.anchored:
            return energy
        anchored = self._sum("weigh", anchor=self._hierarchy.anchor, x=self._x)
        return max(energy - anchored, _FIRM * energy)

    def _step(self, beta: float, product: float) -> float:
        """Take a step; return the square of the residual."""
        h, cycle = self._hierarchy, self._cycle
        before = self._before if beta else cycle.x  # of the last solution there may be infinities
        arrays = {"z": cycle.x, "before": before, "direction": self._p, "image": self._image}
        curvature = self._sum("direct", beta=beta, **h.graph, **arrays)
        self._p, self._before = self._before, self._p
        alpha = product / curvature if curvature > 0 else 0.0
        arrays = {"direction": self._before, "image": self._image, "b": cycle.b, "x": self._x}
        return self._sum("advance", alpha=alpha, **arrays)

    def _dot(self, one: Array, other: Array) -> float:
        return self._sum("dot", one=one, other=other)

    def _sum(self, name: str, **arguments: Any) -> float:
        """Run a pass over the finest level that adds up; return the sum."""
        self._hierarchy.over_parts(name, self._parts, **arguments)
        return float(self._parts.download().sum(dtype=np.float64))


class VCycle:
    """The cycles over a hierarchy, and memory for them.

    Two steps of Jacobi's method, with Chebyshev's weights, smooth on the way down and up; a third smooths the
    transfers. Three of the coarser levels are gone through twice, which mends what coarsening does to cuts.
    Of levels without extra links half a cycle is one pass, and all small levels together are one.

    Of all nodes ``b`` and ``x`` are the right side and the answer, ``full_b`` the right side of full
    multigrid. ``twice`` says whether coarser levels are gone through twice: where their answers are more than
    twice too large, as in a comb, that is not positive definite any more.
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        h = self._h = hierarchy
        self._nodes = 0
        self._fused = h.device.layout.tile > 1
        finest = h.levels[0]
        bands = -(-finest.rows // 2 // _BAND) + 1
        self._lines = h.array("lines", bands * _LINES * (finest.stride + 2 * _MARGIN) if self._fused else 1)
        self.parts = h.array("parts", max(-(-finest.nodes // part_of(h.device)), bands))
        self.parts_filled = 0

    def prepare(self) -> None:
        """Make ready for what the hierarchy holds now."""
        h = self._h
        self.twice = True
        if h.nodes > self._nodes:
            self._nodes = h.nodes
            names = "right side", "heights", "other heights", "kept heights", "full right", "full heights"
            arrays = [h.array(name, h.nodes) for name in names]
            self.b, self.x, self._t, self._kept, self.full_b, self._full_x = arrays
        self._over_nodes("clear", len(h.levels) - 1, x=self.x)  # the coarsest: only linked nodes are solved
        table = []
        for level, extra in zip(h.levels, h.extra, strict=True):
            spans = extra.nodes, extra.graph, extra.restrict, extra.prolong
            table.append([*level.place.values(), *(n for rows in spans for n in (rows.at, rows.count))])
        self._table = h.device.given("levels", np.array(table), np.int32)
        self._tail = self._first_of_tail()
        self._prolong_rows = [self._rows_of(number) for number in range(len(h.levels))]

    def _first_of_tail(self) -> int:
        """Return the level from which on down one item does all; the coarsest, where items are lanes."""
        last = len(self._h.levels) - 1
        for number, (level, extra) in enumerate(zip(self._h.levels, self._h.extra, strict=True)):
            limit = _SPLIT_TAIL if extra.graph.count else _TAIL
            if self._fused and number > 0 and level.nodes <= limit:
                return number
        return last

    def _rows_of(self, number: int) -> Array:
        """Return where the table's rows for prolongation begin of each row of a level's grid."""
        h = self._h
        level, rows = h.levels[number], h.extra[number].prolong
        if not rows.count or h.extra[number].graph.count:
            return h.device.given("rows", np.zeros(1), np.int32)
        nodes = h.table["node"].download()[rows.at : rows.at + rows.count]
        first = level.first + level.stride * np.arange(level.rows + 1)
        starts = np.searchsorted(nodes, first) + rows.at
        h.table["node"].upload()
        return h.device.given("rows", starts, np.int32)

    @property
    def rooms(self) -> tuple[Array, Array, Array, Array]:
        """Arrays of all nodes, that no cycle needs between two solutions."""
        return self.x, self.b, self._t, self._kept

    def start(self, to: Array) -> None:
        """Make heights of the finest level by full multigrid, but for its own cycle, of ``full_b``."""
        if self._tail == 0:
            to.claim()
            to.host[...] = 0
            to.upload()
            return
        for number in range(self._tail):
            self._restrict_source(number)
        self._run_tail("tail_full", full_b=self.full_b, full_x=self._full_x)
        for number in range(self._tail - 1, -1, -1):
            self._prolong(number, 0.0, self.full_b, self._full_x if number else to)
            if number:
                self._find_residual(number, self.full_b, self._full_x, self.b)
                self._go(number)
                self._over_nodes("add", number, other=self._full_x, x=self.x)

    def run(self) -> float:
        """Do a cycle from heights of zero: x answers b; return the product of both."""
        self.launch()
        return self.product()

    def launch(self) -> None:
        """Put a cycle on the queue, and the parts of its product."""
        self._go(0)

    def product(self) -> float:
        """Return the last cycle's product of right side and answer."""
        return float(self.parts.download()[: self.parts_filled].sum(dtype=np.float64))

    def _go(self, number: int) -> None:
        """Do a cycle from a level on."""
        if number >= self._tail:
            self._run_tail("tail_cycle")
            if number == 0:
                self._multiply()
            return
        self._down_and_up(number)
        if self.twice and number in _TWICE:
            self._find_residual(number, self.b, self.x, self._t)
            self._over_nodes("keep", number, residual=self._t, x=self.x, b=self.b, kept=self._kept)
            self._down_and_up(number)
            self._over_nodes("add", number, other=self._kept, x=self.x)

    def _down_and_up(self, number: int) -> None:
        h = self._h
        if self._fused and not h.extra[number].graph.count:
            self._descend(number)
            self._go(number + 1)
            self._ascend(number)
            return
        steps: dict[str, Any] = {"omega": _OMEGA, "then": _THEN, "inverse": h.inverse}
        self._over_links("begin", number, **steps, b=self.b, x=self._t)
        self._find_residual(number, self.b, self._t, self.x, divide=True)
        self._restrict(number, self.x, self.b)
        self._go(number + 1)
        self._prolong(number, 1.0, self._t, self.x)
        self._smooth(number, _THEN, self.x, self._t)
        self._smooth(number, _OMEGA, self._t, self.x)
        if number == 0:
            self._multiply()

    def _descend(self, number: int) -> None:
        """Go down by one level in one pass."""
        h, rows = self._h, self._h.extra[number].restrict
        arrays = {"b": self.b, "x": self._t, "residual": self.x, "coarse_b": self.b}
        self._half_cycle("descend", number, 21, keep=rows.count > 0, **arrays)
        h.over_rows("restrict", rows, residual=self.x, b=self.b)

    def _ascend(self, number: int) -> None:
        """Go up by one level in one pass."""
        h, rows = self._h, self._h.extra[number].prolong
        arrays = {"b": self.b, "e": self.x, "x": self._t, "smoother": self.x, "parts": self.parts}
        extra = {"extras": rows.count, "first_extra": self._prolong_rows[number], **h.table}
        self._half_cycle("ascend", number, 25, **arrays, **extra)
        self.parts_filled = -(-h.levels[number + 1].rows // _BAND)

    def _half_cycle(self, name: str, number: int, moved: int, **arguments: Any) -> None:
        h = self._h
        fine, coarse = h.levels[number : number + 2]
        places = {**fine.place, **fine.with_coarser(coarse)}
        h.kernel(name)(
            -(-coarse.rows // _BAND),
            **places,
            **h.graph,
            band=_BAND,
            inverse=h.inverse,
            lines=self._lines,
            omega=_OMEGA,
            then=_THEN,
            **arguments,
            moved=moved * fine.nodes,
        )

    def _restrict_source(self, number: int) -> None:
        """Bring the right side of full multigrid to the next level."""
        h = self._h
        if h.extra[number].restrict.count:
            self._over_nodes("scale", number, inverse=h.inverse, b=self.full_b, residual=self._t)
            self._restrict(number, self._t, self.full_b)
        else:
            h.over_blocks("gather", number, fine=self.full_b, b=self.full_b)

    def _smooth(self, number: int, omega: float, x: Array, smoother: Array) -> None:
        extra = {"inverse": self._h.inverse}
        self._over_links("smooth", number, extra, omega=omega, b=self.b, x=x, smoother=smoother)

    def _find_residual(
        self, number: int, b: Array, x: Array, residual: Array, *, divide: bool = False
    ) -> None:
        """Find the residual, or that over the diagonal."""
        extra = {"divide": divide, "inverse": self._h.inverse}
        name = ("scaled_residual" if divide else "residual"), "residual"
        self._over_links(name, number, extra, b=b, x=x, residual=residual)

    def _restrict(self, number: int, residual: Array, b: Array) -> None:
        h = self._h
        h.over_blocks(
            "restrict", number, right=h.graph["right"], down=h.graph["down"], residual=residual, b=b
        )
        h.over_rows("restrict", h.extra[number].restrict, residual=residual, b=b)

    def _prolong(self, number: int, keep: float, x: Array, corrected: Array) -> None:
        h = self._h
        arguments = {"keep": keep, "inverse": h.inverse, "e": self.x, "x": x, "corrected": corrected}
        h.over_blocks("prolong", number, right=h.graph["right"], down=h.graph["down"], **arguments)
        h.over_rows("prolong", h.extra[number].prolong, **arguments)

    def _over_links(
        self, name: str | tuple[str, str], number: int, extra: dict[str, Any] | None = None, **arguments: Any
    ) -> None:
        """Run a pass over a level's grid, and over the links of its extra nodes with ``extra`` arguments."""
        h = self._h
        in_grid, at_extra = (name, name) if isinstance(name, str) else name
        h.over_grid(in_grid, h.levels[number], **h.graph, **arguments)
        h.over_rows(at_extra, h.extra[number].graph, anchor=h.anchor, **(extra or {}), **arguments)

    def _over_nodes(self, name: str, number: int, **arguments: Any) -> None:
        """Run a pass over a level's grid and its extra nodes."""
        h = self._h
        h.over_grid(name, h.levels[number], **arguments)
        h.over_extra(name, h.extra[number].nodes, **arguments)

    def _run_tail(self, name: str, **full: Any) -> None:
        """Do all of the small levels, or the coarsest alone where items are lanes."""
        h = self._h
        nodes, matrix = h.bottom
        bottom: dict[str, Any] = {"count": len(nodes.host), "bottom": nodes, "matrix": matrix}
        if not self._fused:
            b = self.full_b if name == "tail_full" else self.b
            count = bottom["count"]
            h.kernel("solve")(count, **bottom, b=b, x=self.x, moved=4 * count**2)
            return
        twice = _TWICE if self.twice else range(0)
        h.kernel(name)(
            1,
            first=self._tail,
            last=len(h.levels) - 1,
            levels=self._table,
            **h.graph,
            inverse=h.inverse,
            **h.table,
            **bottom,
            omega=_OMEGA,
            then=_THEN,
            twice=twice.start,
            once=twice.stop,
            b=self.b,
            x=self.x,
            t=self._t,
            kept=self._kept,
            **full,
            moved=400 * h.levels[self._tail].nodes,
        )

    def _multiply(self) -> None:
        """Fill the parts of the product of right side and answer."""
        h = self._h
        self.parts_filled = -(-h.levels[0].nodes // part_of(h.device))
        h.over_parts("dot", self.parts, one=self.b, other=self.x)
