"""Heights on any graph of pixels: conjugate gradients, preconditioned by multigrid."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from mirrorskin.engine.integration.cycle import Cycle
from mirrorskin.engine.integration.hierarchy import Hierarchy, part_of, place
from mirrorskin.engine.integration.links import Links
from mirrorskin.kernels.array import Array

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
