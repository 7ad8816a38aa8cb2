"""Heights on any graph of pixels: conjugate gradients, preconditioned by a multigrid cycle."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.cycle import Cycle, add_parts
from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.height_variance import JOINED, LEAST, find_graph_variance
from mirrorskin.engine.integration.hierarchy import STRENGTH, Hierarchy, choose_lanes, part_of
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.links import KNOWN, SLOPE

_USUAL = 40  # cycles, after which coarse levels are given up
_CYCLES = 2  # that are enough where no tolerance is given
_PATIENCE, _PROGRESS = 8, 0.7  # iterations in which the residual must fall by so much: float32 does no more
_WORSE = 10  # times the least residual so far, at which rounding has taken over
_FAILED = 0.3  # residual from which on up two cycles have failed
_FACTORS = 8e-6  # seconds that elimination takes of a node of the second level, at most
_ROUNDING = 1e-6  # of the right side: what is left over of an exact answer
_FIRM = 1e-3  # share of known heights in the energy that errors are measured against
_NEAR = 0.03  # residual from which on down the heights' energy is known well enough

Doubles = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Solution:
    """What a solver found."""

    # (H, W) or (K, H, W), float32: on the device, until the next solution; a component without an anchor has
    # an arbitrary offset.
    height: Array
    iterations: int  # cycles that were done
    # Norm of the error over that of the heights, both as u A u has it, so of slopes and anchors by their
    # weights; the greatest of all right sides.
    residual: float
    converged: bool  # whether the residual is within the tolerance; without one, whether it is below 0.3


class Multigrid:
    """Conjugate gradients on graphs of pixels with any mask, weights, cuts and known heights."""

    def __init__(self, links: Links, *, plain: bool = False) -> None:
        self._device = links.device
        self._height = self._device.array("height", links.shape, np.float32)
        self._height.upload()
        self._allocate(links)
        self.rebuild(links, plain=plain)

    def _allocate(self, links: Links) -> None:
        self._hierarchy = Hierarchy(links.shape, links.anchor is not None, links.device)
        self._alone = _Gradients(self._hierarchy, 1)
        self._together: _Gradients | None = None
        self._products: Array | None = None

    def rebuild(self, links: Links, *, plain: bool = False, strength: float = STRENGTH) -> None:
        """Take another graph of the same shape; what was allocated is used again.

        In a plain one blocks of pixels are aggregates: solutions take more cycles where there are cuts.
        """
        if (links.anchor is not None) != self._hierarchy.anchored:
            self._allocate(links)
        self._links = links
        self._hierarchy.build(links, plain=plain, strength=strength)
        for one in (self._alone, self._together):
            if one is not None:
                one.cycle.prepare()

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
        one = self._alone
        one.begin(self._links.source, start)
        done, residual = one.solve(tolerance, limit, deadline)
        one.copy("release", one.x, self._height)
        return _solution(self._height, done, residual, tolerance)

    def solve_many(
        self, sources: Array, *, tolerance: float | None = 1e-5, deadline: float | None = None
    ) -> Solution:
        """Solve for the heights of several right sides, (K, H, W), in groups that run together."""
        sides, height = (
            sources.shape[0],
            self._device.array("heights", sources.shape, np.float32, zeroed=False),
        )
        height.upload()
        done, residual = 0, np.zeros(sides)
        for some, group in self._groups(sides):
            group.begin(sources, None, some)
            count, found = group.solve(tolerance, 100, deadline)
            group.copy("release", group.x, height, some)
            done, residual[some] = max(done, count), found[: some.stop - some.start]
        return _solution(height, done, residual, tolerance)

    def _groups(self, sides: int) -> list[tuple[slice, _Gradients]]:
        """Return which of some right sides are solved for together, and what does it."""
        lanes = choose_lanes(self._device, sides)
        if lanes == 1:
            return [(slice(0, 1), self._alone)]
        if self._together is None or self._together.lanes != lanes:
            self._together = None  # its memory is given back first
            self._together = _Gradients(self._hierarchy, lanes)
            self._together.cycle.prepare()
        return [(slice(k, min(k + lanes, sides)), self._together) for k in range(0, sides, lanes)]

    def precondition(self, sources: Array) -> Array:
        """Return one cycle's answers to right sides, (K, H, W): a symmetric positive operator on each."""
        height = self._device.array("heights", sources.shape, np.float32, zeroed=False)
        height.upload()
        for some, group in self._groups(sources.shape[0]):
            group.copy("admit", group.cycle.b, sources, some)
            group.cycle.launch()
            group.copy("release", group.cycle.x, height, some)
        return height

    def follow(self, links: Links, *, deep: bool) -> Array:
        """Go one step from the last heights towards those of a graph that is nearly the last one.

        The step is the best one in the plane of the preconditioned residual and the step before: conjugate
        gradients, as far as the graph is the same, and heights cannot become worse in any case. All of it is
        on the device's queue when this returns; heights are valid until the next solution or step. ``deep``:
        rebuild all levels of the graph, rather than the finest alone.
        """
        h, one = self._hierarchy, self._alone
        cycle = one.cycle
        h.follow(links, deep=deep)
        cycle.find_tiles()
        one.started = True
        one.copy("admit", one.source, links.source)
        one.find_residual()
        cycle.launch()
        count = len(one.parts.host)
        if self._products is None:
            self._products = h.array("parts", 4 * count)
        step: dict[str, Any] = {"z": cycle.x, "p": one.p}
        h.over_parts("curve", self._products, **h.graph, b=cycle.b, **step, count=count)
        products: dict[str, Any] = {"products": len(cycle.parts.host), "product": cycle.parts}
        h.over("follow", h.levels[0], **products, count=count, parts=self._products, **step, x=one.x)
        one.copy("release", one.x, self._height)
        return self._height

    def deviation(self, answered: NDArray[np.bool_], flags: Array, uneven: bool) -> NDArray[np.float32]:
        """Return the heights' standard deviation, (H, W), where the weights are one over a variance.

        ``answered`` are the pixels with heights, as ``flags`` say on the device. Of links that are
        ``uneven``, the graph must be built anew before the next solution.
        """
        if uneven:
            self.rebuild(self._links, strength=JOINED)
        h, one = self._hierarchy, self._alone
        rooms = one.cycle.x, one.cycle.b, one.cycle.spare, one.before, one.p
        find_graph_variance(h, answered, rooms)
        found = self._device.array("sigma", self._links.shape, np.float32)
        known: dict[str, Any] = {"least": LEAST, "wanted": SLOPE | KNOWN, "flags": flags}
        h.copy_picture("deviation", one.cycle.x, found, inverse=h.inverse, **known)
        deviation: NDArray[np.float32] = found.detach()
        return deviation

    def gap(self) -> float:
        """Return how far heights were from the solution before the last step; see ``Solution.residual``."""
        product = float(self._alone.cycle.product()[0])
        if product == 0:
            return 0.0
        energy = float(self._alone.energy()[0])
        return float(np.sqrt(product / energy)) if product > 0 and energy > 0 else np.inf


def _solution(height: Array, iterations: int, residual: Doubles, tolerance: float | None) -> Solution:
    worst = float(residual.max())
    return Solution(height, iterations, worst, worst <= (_FAILED if tolerance is None else tolerance))


class _Gradients:
    """Conjugate gradients for one right side, or for several of one graph, and memory for it.

    All numbers are kept by right side, (lanes,); those whose residual is small enough are left as they are.
    """

    def __init__(self, hierarchy: Hierarchy, lanes: int) -> None:
        h, self.lanes = hierarchy, lanes
        self._h, finest = h, h.levels[0]
        size = None if lanes == 1 else finest.end + finest.stride
        names = "x", "direction", "direction before"
        self.x, self.p, self.before = (h.array(name, size, lanes=lanes) for name in names)
        # Of several the right side is seldom needed twice.
        self.source = h.array("source") if lanes == 1 else self.p
        self.parts = h.array("parts", -(-finest.nodes // part_of(h.device)), lanes=lanes)
        factors = "factor", "taken"
        self._factors = {name: h.device.array(name, (lanes,), np.float32) for name in factors}
        self._alpha: Doubles | None = None  # how far the last step goes, until the heights have it
        self.cycle = Cycle(h, lanes)

    def copy(self, name: str, level: Array, map_: Array, some: slice = slice(0, 1)) -> None:
        """Copy some of the maps, (H, W) each, to the finest level ("admit"), or back ("release")."""
        places = {} if self.lanes == 1 else {"first": some.start, "count": some.stop - some.start}
        self._h.copy_picture(name, level, map_, lanes=self.lanes, **places)

    def begin(self, sources: Array, start: Array | None, some: slice = slice(0, 1)) -> None:
        """Take some right sides, and heights to begin with."""
        self._sources, self._some, b = sources, some, self.cycle.b
        self._gained, self._alpha = np.zeros(self.lanes), None
        self.started = start is not None
        self.copy("admit", b, sources, some)
        if self.lanes == 1:
            self.copy("admit", self.source, sources)
        self._rest = self._given = self._dot(b, b)
        if start is not None:
            self.copy("admit", self.x, start)
            self.find_residual()
            self._rest = self._dot(b, b)
        self._fresh = start is None or not self._rest <= self._given  # one that is worse than none is none
        if self._fresh:
            if start is not None:
                self.copy("admit", b, sources)
            self._rest = self._given

    def solve(self, tolerance: float | None, limit: int, deadline: float | None) -> tuple[int, Doubles]:
        """Solve; return how many cycles were done, and the residuals."""
        enough = _FAILED if tolerance is None else tolerance
        count, goal = (_CYCLES, 0.0) if tolerance is None else (limit, tolerance)
        done, residual = self._iterate(goal, min(count, _USUAL), deadline)
        ready = time.perf_counter() + _FACTORS * sum(level.nodes for level in self._h.levels[1:2])
        late = deadline is not None and ready > deadline
        left = 0 if np.isnan(self._rest).any() else _CYCLES if tolerance is None else count - done
        if (residual > enough).any() and left > 0 and not late and self.cycle.factorise():
            if self.lanes > 1:
                self.copy("admit", self.source, self._sources, self._some)
            self.find_residual()
            self._rest = self._dot(self.cycle.b, self.cycle.b)
            more, residual = self._iterate(goal, left, deadline)
            done += more
        return done, residual

    def find_residual(self) -> None:
        """Find the right side of a cycle."""
        known = {"b": self.source, "x": self.x, "residual": self.cycle.b}
        self._h.over("residual", self._h.levels[0], **self._h.graph, **known, lanes=self.lanes)

    def energy(self) -> Doubles:
        """Return the heights' energy in the links; firm anchors, if they counted fully, would hide that."""
        energy = self._gained
        if self.started or self._h.anchored:
            self._take()
        if self.started:
            energy = self._dot(self.source, self.x)
        if not self._h.anchored:
            return energy
        anchored = self._sum("weigh", anchor=self._h.graph["anchor"], x=self.x)
        return np.maximum(energy - anchored, _FIRM * energy)

    @np.errstate(all="ignore")  # what overflows in one right side ends there
    def _iterate(self, goal: float, limit: int, deadline: float | None) -> tuple[int, Doubles]:
        """Do conjugate gradients; return how many steps were done, and the residuals."""
        rest, done = self._rest, 0
        residual, energy = np.where(rest == 0, 0.0, np.inf), np.zeros(self.lanes)
        best, progress, before = np.full(self.lanes, np.inf), np.zeros(self.lanes, int), rest
        moving = (residual > goal) & ~np.isnan(rest).any()
        while done < limit and moving.any():
            begun = time.perf_counter()
            product = self.cycle.run()
            residual[moving & ~(product > 0) & (rest <= _ROUNDING**2 * self._given)] = 0
            moving &= product > 0
            if not moving.any():
                break
            after = self._step(_ratio(product, before, moving) if done else None, product, moving)
            if (residual[moving] > _NEAR).any():
                energy = np.where(residual > _NEAR, self.energy(), energy)
            # The product is the energy of the error before the step; squares say what the step did to it.
            known = moving & (energy > 0)
            found = np.sqrt(_ratio(_ratio(product * after, rest, known), energy, known))
            residual[moving] = np.where(known, found, np.inf)[moving]
            before, rest = product, after
            done += 1
            better = residual < _PROGRESS * best
            best, progress = np.where(better, residual, best), np.where(better, done, progress)
            moving &= (residual > goal) & (residual <= _WORSE * best) & (done - progress < _PATIENCE)
            now = time.perf_counter()
            if deadline is not None and now + (now - begun) > deadline:
                break
        self._take()
        return done, residual

    def _step(self, beta: Doubles | None, product: Doubles, moving: NDArray[np.bool_]) -> Doubles:
        """Go on in another direction, by beta that of the last; return the squares of the residuals."""
        h, cycle = self._h, self.cycle
        before = cycle.x if beta is None else self.before  # of the last solution there may be infinities
        known: dict[str, Any] = {**h.graph, "inverse": h.inverse}
        known |= {"factor": self._by("factor", beta), **self._last_step()}
        arrays = {"z": cycle.x, "before": before, "direction": self.p, "x": self.x}
        curvature = self._sum("direct", **known, **arrays)
        self.p, self.before = self.before, self.p
        alpha = self._alpha = _ratio(product, curvature, moving & (curvature > 0))
        self._gained = self._gained + alpha * product
        known = {**h.graph, "inverse": h.inverse, "factor": self._by("factor", alpha)}
        return self._sum("advance", **known, direction=self.before, b=cycle.b)

    def _last_step(self) -> dict[str, Any]:
        """Return how far the heights are still to go along the last direction, which is then done."""
        alpha, self._alpha = self._alpha, None
        step = 0 if alpha is None else 2 - self._fresh
        self._fresh = self._fresh and alpha is None
        return {"taken": self._by("taken", alpha), "step": step}

    def _take(self) -> None:
        """Have the heights after the last step, or of zero if there was none."""
        if self._alpha is not None:
            arrays = {"direction": self.before, "x": self.x}
            self._h.over("take", self._h.levels[0], lanes=self.lanes, **self._last_step(), **arrays)
        elif self._fresh:
            self.x.claim()
            self.x.host[...], self._fresh = 0, False
            self.x.upload()

    def _by(self, name: str, factors: Doubles | None) -> float | Array:
        """Return factors of the right sides as passes take them, 0 where there are none."""
        if self.lanes == 1:
            return 0.0 if factors is None else float(factors[0])
        array = self._factors[name]
        array.claim()
        array.host[...] = 0 if factors is None else factors
        array.upload()
        return array

    def _dot(self, one: Array, other: Array) -> Doubles:
        return self._sum("dot", one=one, other=other)

    def _sum(self, name: str, **arguments: Any) -> Doubles:
        """Run a pass over the finest level that adds up; return the sums."""
        self._h.over_parts(name, self.parts, **arguments, lanes=self.lanes)
        return add_parts(self.parts)


def _ratio(one: Doubles, other: Doubles, where: NDArray[np.bool_]) -> Doubles:
    """Return quotients, 0 where they are not wanted."""
    return np.divide(one, other, out=np.zeros(len(one)), where=where)
