"""Heights on any graph of pixels: conjugate gradients, preconditioned by a multigrid cycle."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.height_variance import JOINED, LEAST, find_graph_variance
from mirrorskin.engine.integration.hierarchy import (
    STRENGTH,
    TILE_ROWS,
    Hierarchy,
    Level,
    part_of,
    tile_columns,
)
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Kernel
from mirrorskin.kernels.links import KNOWN, SLOPE

_TWICE = 2  # the finest level that is gone through twice: all coarser ones are, or cycles may be indefinite
_TAIL = 20480  # nodes of a level from which on down one group does all
_USUAL = 40  # cycles, after which coarse levels are given up
_CYCLES = 2  # that are enough where no tolerance is given
_PATIENCE, _PROGRESS = 8, 0.7  # iterations in which the residual must fall by so much: float32 does no more
_WORSE = 10  # times the least residual so far, at which rounding has taken over
_FAILED = 0.3  # residual from which on up two cycles have failed
_ROUNDING = 1e-6  # of the right side: what is left over of an exact answer
_LEAST = 1e-12  # of a component's links: anchors that are weaker leave its offset free
_FIRM = 1e-3  # share of known heights in the energy that errors are measured against
_NEAR = 0.03  # residual from which on down the heights' energy is known well enough


Doubles = NDArray[np.float64]


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
        self._allocate(links)
        self._products: Array | None = None
        self.rebuild(links, plain=plain)

    def _allocate(self, links: Links) -> None:
        h = self._hierarchy = Hierarchy(links.shape, links.anchor is not None, links.device)
        finest = h.levels[0]
        names = "x", "source", "direction", "direction before", "image"
        arrays = [h.array(name) for name in names]
        self._x, self._source, self._p, self._before, self._image = arrays
        self._parts = h.array("parts", -(-finest.nodes // part_of(self._device)))
        self._cycle = VCycle(h)

    def rebuild(self, links: Links, *, plain: bool = False, strength: float = STRENGTH) -> None:
        """Take another graph of the same shape; what was allocated is used again.

        In a plain one blocks of pixels are aggregates: solutions take more cycles where there are cuts.
        """
        if (links.anchor is not None) != self._hierarchy.anchored:
            self._allocate(links)
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
        """Solve for the heights, from a start, (H, W), or from 0.

        It ends when the residual is within the tolerance (None: after two cycles), after ``limit`` cycles,
        or when the next one would end after ``deadline``, of ``time.perf_counter``.
        """
        h, cycle = self._hierarchy, self._cycle
        h.copy_picture("admit", self._source, self._links.source)
        h.copy_picture("admit", cycle.b, self._links.source)
        rest = given = self._dot(cycle.b, cycle.b)
        if start is not None:
            h.copy_picture("admit", self._x, start)
            self._find_residual()
            rest = self._dot(cycle.b, cycle.b)
        if start is None or not rest <= given:  # a start that is worse than none, or not finite, is none
            if start is not None:
                h.copy_picture("admit", cycle.b, self._links.source)
            self._x.claim()
            self._x.host[...] = 0
            self._x.upload()
            rest = given
        enough = _FAILED if tolerance is None else tolerance
        count, goal = (_CYCLES, 0.0) if tolerance is None else (limit, tolerance)
        done, residual = self._iterate(rest, given, goal, min(count, _USUAL), deadline)
        late = deadline is not None and time.perf_counter() > deadline
        left = _CYCLES if tolerance is None else count - done
        if residual > enough and left > 0 and not late and cycle.factorise():
            self._find_residual()
            rest = self._dot(cycle.b, cycle.b)
            more, residual = self._iterate(rest, given, goal, left, deadline)
            done += more
        h.copy_picture("release", self._x, self._height)
        return Solution(self._height, done, residual, residual <= enough)

    def precondition(self) -> Array:
        """Return one cycle's answer to the right side, (H, W): a symmetric positive operator on that."""
        self._hierarchy.copy_picture("admit", self._cycle.b, self._links.source)
        self._cycle.launch()
        self._hierarchy.copy_picture("release", self._cycle.x, self._height)
        return self._height

    def follow(self, links: Links, *, deep: bool) -> Array:
        """Go one step from the last heights towards those of a graph that is nearly the last one.

        The step is the best one in the plane of the preconditioned residual and the step before: conjugate
        gradients, as far as the graph is the same, and heights cannot become worse in any case. All of it is
        on the device's queue when this returns; heights are valid until the next solution or step. ``deep``:
        rebuild all levels of the graph, rather than the finest alone.
        """
        h, cycle = self._hierarchy, self._cycle
        h.follow(links, deep=deep)
        cycle.find_tiles()
        h.copy_picture("admit", self._source, links.source)
        self._find_residual()
        cycle.launch()
        count = len(self._parts.host)
        if self._products is None:
            self._products = h.array("parts", 4 * count)
        step = {"z": cycle.x, "p": self._p}
        h.over_parts("curve", self._products, **h.graph, b=cycle.b, **step, count=count)
        products = {"products": len(cycle.parts.host), "product": cycle.parts}
        h.over("follow", h.levels[0], **products, count=count, parts=self._products, **step, x=self._x)
        h.copy_picture("release", self._x, self._height)
        return self._height

    def deviation(self, answered: NDArray[np.bool_], flags: Array, uneven: bool) -> NDArray[np.float32]:
        """Return the heights' standard deviation, (H, W), where the weights are one over a variance.

        ``answered`` are the pixels with heights, as ``flags`` say on the device. Of links that are
        ``uneven``, the graph must be built anew before the next solution.
        """
        if uneven:
            self.rebuild(self._links, strength=JOINED)
        h, cycle = self._hierarchy, self._cycle
        rooms = cycle.x, cycle.b, cycle.spare, self._before, self._image
        find_graph_variance(h, answered, rooms)
        found = self._device.array("sigma", self._links.shape, np.float32)
        known: dict[str, Any] = {"least": LEAST, "wanted": SLOPE | KNOWN, "flags": flags}
        h.copy_picture("deviation", cycle.x, found, inverse=h.inverse, **known)
        deviation: NDArray[np.float32] = found.detach()
        return deviation

    def gap(self) -> float:
        """Return how far heights were from the solution before the last step; see ``Solution.residual``."""
        product = self._cycle.product()
        if product == 0:
            return 0.0
        energy = self._energy()
        return math.sqrt(product / energy) if product > 0 and energy > 0 else math.inf

    def _find_residual(self) -> None:
        h, cycle = self._hierarchy, self._cycle
        h.over("residual", h.levels[0], **h.graph, b=self._source, x=self._x, residual=cycle.b)

    def _iterate(
        self, rest: float, given: float, goal: float, limit: int, deadline: float | None
    ) -> tuple[int, float]:
        """Do conjugate gradients; return how many steps were done, and the residual."""
        before, done, energy, residual = 0.0, 0, 0.0, 0.0 if rest == 0 else math.inf
        best, progress = math.inf, 0
        while done < limit and residual > goal and done - progress < _PATIENCE:
            begun = time.perf_counter()
            product = self._cycle.run()
            if not product > 0:
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
            if residual > _WORSE * best:
                break
            now = time.perf_counter()
            if deadline is not None and now + (now - begun) > deadline:
                break
        return done, residual

    def _energy(self) -> float:
        """Return the heights' energy in the links; firm anchors, if they counted fully, would hide that."""
        energy = self._dot(self._source, self._x)
        if not self._hierarchy.anchored:
            return energy
        anchored = self._sum("weigh", anchor=self._hierarchy.graph["anchor"], x=self._x)
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
    """A cycle over a hierarchy, and memory for it: of all nodes ``b`` is the right side, ``x`` the answer.

    On each level three steps of Jacobi's method smooth on the way down, and on the way up in reverse. Half of
    that is one pass, whose groups keep a tile of the level in local memory; all small levels are one.
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        h = self._h = hierarchy
        names = "right side", "heights", "other heights", "residual"
        self.b, self.x, self.spare, self._rest = (h.array(name) for name in names)
        self._tail = next(
            k for k, one in enumerate(h.levels) if k == len(h.levels) - 1 or (k > 0 and one.nodes <= _TAIL)
        )
        tiles = [self._tiles(one) for one in h.levels[: self._tail]]
        self._first_tile = np.cumsum([0, *tiles])
        self.parts = h.array("parts", self._tiles(h.levels[0]))
        self._live = h.array("live", max(1, int(self._first_tile[-1])), np.uint8)

    def prepare(self) -> None:
        """Make ready for what the hierarchy holds now."""
        h = self._h
        table = [[*one.place.values(), moves] for one, moves in zip(h.levels, h.moves, strict=True)]
        self._table = h.device.given("levels", np.array(table), np.int32)
        self._factors: Callable[[Doubles], Doubles] | None = None
        self.find_tiles()

    def find_tiles(self) -> None:
        """Find the tiles that have nodes; no cycle goes over the others."""
        h = self._h
        for number, level in enumerate(h.levels[: self._tail]):
            kernel, items = self._kernel("find_live", level), self._tiles(level)
            known = {"inverse": h.inverse, **self._live_of(number)}
            kernel(items, **level.place, **known, moved=4 * level.nodes)

    def _live_of(self, number: int) -> dict[str, Any]:
        return {"live": self._live, "first_tile": int(self._first_tile[number])}

    def factorise(self) -> bool:
        """Solve the second level directly from now on, on the host; tell whether that is something new.

        Corridors that are narrower than a coarser level's aggregates are no longer apart there.
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
        held = np.bincount(label, pull, parts) <= _LEAST * np.bincount(label, typical, parts)
        hold = np.zeros(count)
        hold[np.unique(label, return_index=True)[1]] = np.where(held, 1.0, 0.0)  # one node of each free part
        matrix = sparse.diags(typical + pull + hold) - links
        options = {"SymmetricMode": True}
        factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        self._factors = factors.solve
        return True

    def _solve_directly(self) -> None:
        """Answer the right side of the second level."""
        assert self._factors is not None
        level = self._h.levels[1]
        inside = slice(level.first, level.end - level.stride)
        b, x = self.b.download(), self.x.download()
        with np.errstate(over="ignore"):  # of graphs that nearly come apart: cycles end there
            x[inside] = self._factors(b[inside].astype(np.float64))
        self.b.upload()
        self.x.upload()

    def run(self) -> float:
        """Do a cycle from heights of zero: x answers b; return the product of both."""
        self.launch()
        return self.product()

    def launch(self) -> None:
        """Put a cycle on the queue, and the parts of its product."""
        self._go(0, again=False)
        if self._tail == 0:
            self._h.over_parts("dot", self.parts, one=self.b, other=self.x)

    def _go(self, number: int, *, again: bool) -> None:
        """Do a cycle from a level on, from heights of zero or ``again`` from those that it has."""
        h = self._h
        if number == 1 and self._factors is not None:
            self._solve_directly()
            return
        if number == self._tail:
            self._run_tail(again)
            return
        keep = int(h.moves[number] > 0)
        self._half(
            "descend",
            number,
            again=again,
            x_before=self.x,
            keep=keep,
            t=self.spare,
            residual=self._rest,
            coarse_b=self.b,
        )
        h.gather(number, self._rest, self.b)
        for second in (False, True)[: 1 + (number + 1 >= _TWICE)]:
            self._go(number + 1, again=second)
        arrays = {"e": self.x, "to": h.to, "t": self.spare, "x_new": self.x, "parts": self.parts}
        self._half("ascend", number, moved_nodes=h.moves[number], **arrays)

    def _run_tail(self, again: bool) -> None:
        """Do all small levels."""
        h = self._h
        last = len(h.levels) - 1
        kernel, moved = self._kernel("tail", h.levels[last]), 200 * h.levels[self._tail].nodes
        known: dict[str, Any] = {"levels": self._table, **h.graph, "inverse": h.inverse}
        known |= {"to": h.to, "changed": h.changed, "b": self.b, "x": self.x, "t": self.spare}
        known |= {"from": self._tail, "last": last, "again": again}
        kernel(kernel.group, **known, moved=moved)

    def product(self) -> float:
        """Return the last cycle's product of right side and answer."""
        return float(self.parts.download().sum(dtype=np.float64))

    def _tiles(self, level: Level) -> int:
        return -(-level.rows // TILE_ROWS) * -(-level.stride // tile_columns(self._h.device))

    def _kernel(self, name: str, level: Level) -> Kernel:
        return self._h.kernel(name, self._h.links_of(level))

    def _half(self, name: str, number: int, **arguments: Any) -> None:
        """Go down or up by one level."""
        h = self._h
        fine = h.levels[number]
        kernel = self._kernel(name, fine)
        known = {**h.graph, "inverse": h.inverse, "b": self.b, **self._live_of(number)}
        items = self._tiles(fine) * kernel.group
        kernel(items, **h.places(number), **known, **arguments, moved=21 * fine.nodes)
