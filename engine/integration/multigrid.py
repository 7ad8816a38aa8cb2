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
from mirrorskin.kernels.array import Array, fetch
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.integration.links import KNOWN, SLOPE

_USUAL_CYCLES = 40  # number of cycles after which coarse levels are replaced by a direct solver
_CYCLES = 2  # number of cycles without a tolerance
_DEEP = 3e-4  # tolerance below which two cycles are done before the first test: one from 0 does not reach it
_DEEPEST = 1e-5  # tolerance below which three cycles are done first if a wait takes long
_MAX_CYCLES = 100  # maximum number of cycles
_PATIENCE, _PROGRESS = 8, 0.7  # iterations in which the residual must decrease to this share of the minimum
_SOONER = 0.75  # share of the expected cycles after which to test, because later cycles reduce more
_UNTESTED = 6  # maximum number of cycles between tests of convergence
_WORSE = 10  # residual above which rounding errors dominate, in minima so far
_MAX_FAILED_RESIDUAL = 0.3  # residual above which two cycles count as failed
_FACTORS = 8e-6  # maximum duration of a factorisation, seconds per node of the second level
_ROUNDING = 1e-6  # residual of an exact solution, relative to the right side
_FIRM = 1e-3  # minimum share of the energy that remains after subtracting that of known heights
_NEAR = 0.03  # residual below which the energy of the heights is not computed again


@dataclass(frozen=True, slots=True)
class Solution:
    """The solution of one or several right sides."""

    # (H, W) or (K, H, W), float32: on the device, valid until the next solution. The offset of a component
    # without an anchor is arbitrary.
    height: Array
    iterations: int  # cycles
    residual: float  # energy norm, sqrt(u A u), of the error over that of the heights; largest of all sides
    converged: bool  # whether the residual is within the tolerance; without one, whether it is below 0.3


class Multigrid:
    """Conjugate gradients on graphs of pixels with any mask, weights, cuts and known heights."""

    def __init__(self, links: Links, *, plain: bool = False) -> None:
        self._device = links.device
        self._height = self._device.array("height", links.shape, np.float32)
        self._allocate(links)
        self.rebuild(links, plain=plain)

    def _allocate(self, links: Links) -> None:
        self._hierarchy = Hierarchy(links.shape, links.anchor is not None, links.device)
        self._alone = ConjugateGradients(self._hierarchy, 1)
        self._together: ConjugateGradients | None = None
        self._products: Array | None = None
        self._lengths: Array

    def rebuild(self, links: Links, *, plain: bool = False, strength: float = STRENGTH) -> None:
        """Use another graph of the same shape, and the same memory.

        ``plain``: aggregates are blocks of pixels, and solutions take more cycles where there are cuts.
        """
        if (links.anchor is not None) != self._hierarchy.anchored:
            self._allocate(links)
        self._links = links
        self._hierarchy.build(links, plain=plain, strength=strength)
        for solver in (self._alone, self._together):
            if solver is not None:
                solver.cycle.prepare()

    def solve(
        self,
        start: Array | None = None,
        *,
        tolerance: float | None = 1e-5,
        limit: int = _MAX_CYCLES,
        deadline: float | None = None,
    ) -> Solution:
        """Solve for the heights, starting from ``start``, (H, W), or from 0.

        The solver stops when the residual is within the tolerance (None: after two cycles), after ``limit``
        cycles, or when the next cycle would end after ``deadline``, a ``time.perf_counter``.
        """
        solver = self._alone
        solver.begin(self._links.source, start)
        iterations, residual = solver.solve(tolerance, limit, deadline)
        solver.finish(self._height)
        return _solution(self._height, iterations, residual, tolerance)

    def solve_many(
        self, sources: Array, *, tolerance: float | None = 1e-5, deadline: float | None = None
    ) -> Solution:
        """Solve for the heights of several right sides, (K, H, W), in groups that run together."""
        sides = sources.shape[0]
        height = self._device.array("heights", sources.shape, np.float32, zeroed=False)
        iterations, residual = 0, np.zeros(sides)
        for batch, solver in self._batches(sides):
            solver.begin(sources, None, batch)
            count, residuals = solver.solve(tolerance, _MAX_CYCLES, deadline)
            solver.finish(height, batch)
            iterations, residual[batch] = max(iterations, count), residuals[: batch.stop - batch.start]
        return _solution(height, iterations, residual, tolerance)

    def _batches(self, sides: int) -> list[tuple[slice, ConjugateGradients]]:
        """Return which right sides are solved together, and their solver."""
        lanes = choose_lanes(self._device, sides)
        if lanes == 1:
            return [(slice(0, 1), self._alone)]
        if self._together is None or self._together.lanes != lanes:
            self._together = None  # frees its memory first
            self._together = ConjugateGradients(self._hierarchy, lanes)
            self._together.cycle.prepare()
        return [(slice(k, min(k + lanes, sides)), self._together) for k in range(0, sides, lanes)]

    def precondition(self, sources: Array) -> Array:
        """Return the results of one cycle for right sides, (K, H, W): symmetric positive definite."""
        height = self._device.array("heights", sources.shape, np.float32, zeroed=False)
        for batch, solver in self._batches(sources.shape[0]):
            solver.copy("admit", solver.cycle.b, sources, batch)
            solver.cycle.launch()
            solver.copy("release", solver.cycle.x, height, batch)
        return height

    def in_place(self) -> tuple[dict[str, Array], int, int]:
        """Return where weights and right side of the finest level are; see `PixelGraph.put_links`."""
        graph, finest = self._hierarchy.graph, self._hierarchy.levels[0]
        maps = {"right": graph["right"], "down": graph["down"], "source": self._alone.source}
        return maps, finest.first, finest.stride

    def follow(
        self, links: Links | None, *, deep: bool, start: Array | None = None, anew: bool = False
    ) -> Array:
        """Do one step from the last heights, or from ``start``, (H, W), towards those of a similar graph.

        The step minimises the energy in the plane of the preconditioned residual and the last step. It is a
        conjugate gradient step if the graph is unchanged, and never increases the error. The step is only
        enqueued; heights are valid until the next solution or step. ``links``: None if they are in place.
        ``deep``: rebuild all levels of the graph, not only the finest. ``anew``: without the last step.
        """
        h, solver = self._hierarchy, self._alone
        cycle = solver.cycle
        h.follow(links, deep=deep)
        if links is not None:
            self._links = links
            solver.copy("admit", solver.source, links.source)
        cycle.follow(deep=deep)
        if start is not None:
            solver.copy("admit", solver.x, start)
        if anew:
            solver.p.fill()
        solver.started = True
        solver.find_residual()
        cycle.launch()
        count = solver.parts.shape[0]
        if self._products is None:
            self._products, self._lengths = h.array("parts", 4 * count), h.array("lengths", 2)
        step: dict[str, Any] = {"z": cycle.x, "p": solver.p}
        h.over_parts("curve", self._products, **h.graph, inverse=h.inverse, b=cycle.b, **step, count=count)
        products: dict[str, Any] = {"products": cycle.parts.shape[0], "product": cycle.parts}
        lengths: dict[str, Any] = {"lengths": self._lengths}
        h.alone("best", h.levels[-1], **products, count=count, parts=self._products, **lengths)
        h.over("follow", h.levels[0], **lengths, **step, x=solver.x)
        solver.copy("release", solver.x, self._height)
        return self._height

    def enter(self, dz_dx: Array, dz_dy: Array, pixel_size: tuple[float, float]) -> None:
        """Give pixels without links the heights that those around imply, along slopes, (H, W).

        It is done before the graph is replaced by one in which they have links. Slopes are NaN where there
        are none.
        """
        h = self._hierarchy
        links = {name: h.graph[name] for name in ("right", "down")}
        steps: dict[str, Any] = {"step_x": pixel_size[0], "step_y": -pixel_size[1]}
        h.copy_picture("enter", self._alone.x, dz_dx, dz_dy=dz_dy, **links, **steps)

    def deviation(self, flags: Array, uneven: bool) -> NDArray[np.float32]:
        """Return the heights' standard deviation, (H, W), if the weights are inverse variances.

        ``flags`` are the flags of the pixels. If links are ``uneven``, the graph must be rebuilt before the
        next solution.
        """
        if uneven:
            self.rebuild(self._links, strength=JOINED)
        h, solver = self._hierarchy, self._alone
        cycle = solver.cycle
        find_graph_variance(h, flags, (cycle.x, cycle.b, cycle.other_x, solver.before, solver.p))
        sigma = self._device.array("sigma", self._links.shape, np.float32)
        limits: dict[str, Any] = {"min_variance": LEAST, "flag": SLOPE | KNOWN, "flags": flags}
        h.copy_picture("deviation", cycle.x, sigma, inverse=h.inverse, **limits)
        deviation: NDArray[np.float32] = sigma.release()
        return deviation

    def gap(self) -> float:
        """Return the residual before the last step; see ``Solution.residual``."""
        product = float(self._alone.cycle.product()[0])
        if product == 0:
            return 0.0
        energy = float(self._alone.energy()[0])
        return float(np.sqrt(product / energy)) if product > 0 and energy > 0 else np.inf


def _solution(height: Array, iterations: int, residual: Doubles, tolerance: float | None) -> Solution:
    worst = float(residual.max())
    return Solution(
        height, iterations, worst, worst <= (_MAX_FAILED_RESIDUAL if tolerance is None else tolerance)
    )


class ConjugateGradients:
    """Conjugate gradients for one or several right sides of one graph, and their memory.

    Numbers are kept for each right side, (lanes,). Right sides whose residual is small enough do not change.
    """

    def __init__(self, hierarchy: Hierarchy, lanes: int) -> None:
        h, self.lanes = hierarchy, lanes
        self._h, finest = h, h.levels[0]
        size = None if lanes == 1 else finest.end + finest.stride
        names = "x", "direction", "direction before"
        self.x, self.p, self.before = (h.array(name, size, lanes=lanes) for name in names)
        self.source = h.array("source") if lanes == 1 else self.p  # several are rarely needed again
        count = -(-finest.nodes // part_of(h.device))
        # Partial sums: of products, and of the residual's squares. Rows of the history have three numbers of
        # a cycle: product, length of the step, and the squared residual before it.
        names = "parts", "squares", "squares of right sides"
        self.parts, self._squares, self._sides = (h.array(name, count, lanes=lanes) for name in names)
        self._history = h.device.array("history", (_MAX_CYCLES, 3, lanes), np.float32)
        self._moving, self._active = h.device.array("moving", (lanes,), np.float32), np.zeros(lanes, bool)
        self._taken: int | None = None  # the cycle whose step is not yet added to the heights
        self._given: Doubles | None = None  # squared right sides
        self.cycle = Cycle(h, lanes)
        # Whether a wait takes longer than an unnecessary cycle.
        self._waits_long = h.device.layout.tile == 1

    def copy(self, name: str, level: Array, map_: Array, batch: slice = slice(0, 1)) -> None:
        """Copy a batch of maps, (H, W) each, to the finest level ("admit"), or back ("release")."""
        numbers = {} if self.lanes == 1 else {"first": batch.start, "count": batch.stop - batch.start}
        self._h.copy_picture(name, level, map_, lanes=self.lanes, **numbers)

    def begin(self, sources: Array, start: Array | None, batch: slice = slice(0, 1)) -> None:
        """Set the right sides of a batch, and the first heights."""
        self._sources, self._batch, b = sources, batch, self.cycle.b
        self._gained, self._taken, self._given = np.zeros(self.lanes), None, None
        self.started = start is not None
        self.copy("admit", b, sources, batch)
        self._fresh = start is None
        if start is not None:
            self.copy("admit", self.source, sources)
            self._dot(b, b, self._sides)
            self.copy("admit", self.x, start)
            self.find_residual()
        self._dot(b, b, self._squares)

    def solve(self, tolerance: float | None, limit: int, deadline: float | None) -> tuple[int, Doubles]:
        """Solve; return the number of cycles, and the residuals."""
        enough = _MAX_FAILED_RESIDUAL if tolerance is None else tolerance
        count, goal = (_CYCLES, 0.0) if tolerance is None else (limit, tolerance)
        cycles, residual = self._iterate(goal, min(count, _USUAL_CYCLES), deadline)
        ready = time.perf_counter() + _FACTORS * sum(level.nodes for level in self._h.levels[1:2])
        late = deadline is not None and ready > deadline
        assert self._given is not None
        remaining = 0 if np.isnan(self._given).any() else _CYCLES if tolerance is None else count - cycles
        if (residual > enough).any() and remaining > 0 and not late and self.cycle.factorise():
            self._take()
            self.copy("admit", self.source, self._sources, self._batch)
            self.find_residual()
            self._dot(self.cycle.b, self.cycle.b, self._squares)
            more, residual = self._iterate(goal, remaining, deadline)
            cycles += more
        return cycles, residual

    def finish(self, map_: Array, batch: slice = slice(0, 1)) -> None:
        """Add the last step to the heights, and copy them to a batch of maps."""
        if self.lanes > 1 or self._taken is None:
            self._take()
            self.copy("release", self.x, map_, batch)
            return
        numbers = {"cycle": self._taken, "step": self._use_step()}
        arrays: dict[str, Any] = {"history": self._history, "direction": self.before}
        self._h.copy_picture("finish", self.x, map_, **numbers, **arrays)

    def find_residual(self) -> None:
        """Compute the residual, which is the right side of a cycle."""
        arrays = {"inverse": self._h.inverse, "b": self.source, "x": self.x, "residual": self.cycle.b}
        self._h.over("residual", self._h.levels[0], **self._h.graph, **arrays, lanes=self.lanes)

    def energy(self) -> Doubles:
        """Return the heights' energy in the links, without that in anchors, which may be much larger."""
        energy = self._gained
        if self.started or self._h.anchored:
            self._take()
        if self.started:
            self._dot(self.source, self.x, self.parts)
            energy = add_parts(self.parts)
        if not self._h.anchored:
            return energy
        weigh: dict[str, Any] = {"anchor": self._h.graph["anchor"], "x": self.x}
        self._h.over_parts("weigh", self.parts, **weigh, lanes=self.lanes)
        return np.maximum(energy - add_parts(self.parts), _FIRM * energy)

    @np.errstate(all="ignore")  # the iteration stops on overflow
    def _iterate(self, goal: float, limit: int, deadline: float | None) -> tuple[int, Doubles]:
        """Do conjugate gradient steps; return their number, and the residuals."""
        cycles, residual, energy = 0, np.full(self.lanes, np.inf), np.zeros(self.lanes)
        best, progress = residual.copy(), np.zeros(self.lanes, int)
        last, untested = np.ones(self.lanes), 1
        moving = np.ones(self.lanes, bool)
        while cycles < limit and moving.any():
            begun, first = time.perf_counter(), cycles
            if (moving != self._active).any():
                self._moving.write(moving.astype(np.float32))
                self._active = moving.copy()
            unseen = not (cycles or self.started) and deadline is None and goal < _DEEP
            min_cycles = _CYCLES + (self._waits_long and goal <= _DEEPEST)
            count = min(min_cycles if unseen else untested if deadline is None else 1, limit - cycles)
            for number in range(count):
                self._step(first + number)
            arrays = (self._sides,) if self._given is None and self.started else ()
            history, parts, *sides = self._read(
                self._history, self._squares, *arrays, rows=slice(first, first + count)
            )
            if self._given is None:
                self._given = _sum(sides[0]) if sides else history[0, 2]
                if sides and not (history[0, 2] <= self._given).all():  # ignore a start that is worse than 0
                    self.begin(self._sources, None, self._batch)
                    return self._iterate(goal, limit, deadline)
            # A step of length 0, where a product is not positive, leaves heights and residual unchanged.
            steps = int((history[:, 0] > 0).any(axis=1).sum())
            cycles = first + steps
            product, _, rest = history[max(steps, 1) - 1]
            after = history[steps, 2] if 0 < steps < count else _sum(parts)
            residual[moving & ~(product > 0) & (rest <= _ROUNDING**2 * self._given)] = 0
            moving &= product > 0
            self._gained = self._gained + (history[:, 0] * history[:, 1]).sum(axis=0)
            if not moving.any():
                break
            if (residual[moving] > _NEAR).any():
                energy = np.where(residual > _NEAR, self.energy(), energy)
            # The product is the energy of the error before the step. It decreases like the squared residual.
            valid = moving & (energy > 0)
            error = np.sqrt(_ratio(_ratio(product * after, rest, valid), energy, valid))
            residual[moving] = np.where(valid, error, np.inf)[moving]
            untested = (
                _cycles_to(goal, residual[moving], last[moving], cycles - first) if self._waits_long else 1
            )
            last = residual.copy()
            better = residual < _PROGRESS * best
            best, progress = np.where(better, residual, best), np.where(better, cycles, progress)
            moving &= (residual > goal) & (residual <= _WORSE * best) & (cycles - progress < _PATIENCE)
            now = time.perf_counter()
            if deadline is not None and now + (now - begun) > deadline:
                break
        return cycles, residual

    def _step(self, number: int) -> None:
        """Enqueue a cycle and a step; the history gets a row of this number."""
        h, cycle = self._h, self.cycle
        cycle.launch()
        before = self.before if number else cycle.x  # which may contain infinities of the last solution
        graph: dict[str, Any] = {**h.graph, "inverse": h.inverse, "cycle": number, "history": self._history}
        arrays = {"z": cycle.x, "before": before, "direction": self.p, "x": self.x}
        sums = {"products": cycle.parts.shape[0], "product": cycle.parts, "squares": self._squares}
        count = {"count": self.parts.shape[0]}
        self._sum("direct", self.parts, **graph, **sums, **count, **arrays, step=self._use_step())
        self.p, self.before = self.before, self.p
        arrays = {"direction": self.before, "b": cycle.b, "products": self.parts, "moving": self._moving}
        self._sum("advance", self._squares, **graph, **count, **arrays)
        self._taken = number

    def _use_step(self) -> int:
        """Return whether a kernel adds the last step to the heights: 0 no, 1 to zero, 2 to x."""
        step = 0 if self._taken is None else 2 - self._fresh
        self._fresh = self._fresh and self._taken is None
        self._taken = None
        return step

    def _take(self) -> None:
        """Add the last step to the heights, or set them to 0 if there was no step."""
        if self._taken is not None:
            arrays = {"history": self._history, "direction": self.before, "x": self.x}
            numbers = {"cycle": self._taken, "step": self._use_step()}
            self._h.over("take", self._h.levels[0], lanes=self.lanes, **numbers, **arrays)
        elif self._fresh:
            self.x.fill()
            self._fresh = False

    def _dot(self, a: Array, b: Array, parts: Array) -> None:
        self._sum("dot", parts, one=a, other=b)

    def _sum(self, name: str, parts: Array, **arguments: Any) -> None:
        """Run a reduction over the finest level."""
        self._h.over_parts(name, parts, **arguments, lanes=self.lanes)

    def _read(self, *arrays: Array, rows: slice = slice(None)) -> list[Doubles]:
        """Wait once for the device, and return arrays, of the first one some rows, as float64."""
        requests = [(array, slice(None) if number else rows) for number, array in enumerate(arrays)]
        return [part.astype(np.float64) for part in fetch(requests, [True] * len(arrays))]


def _cycles_to(goal: float, residual: Doubles, last: Doubles, cycles: int) -> int:
    """Return the number of further cycles to reach the goal, from the reduction by some cycles."""
    rate = np.log(residual / last) / max(cycles, 1)
    further = np.log(goal / residual) / rate
    if not (np.isfinite(further).all() and (rate < 0).all()):
        return 1
    return int(np.clip(_SOONER * further.max(initial=1.0), 1, _UNTESTED))


def _sum(parts: Doubles) -> Doubles:
    """Return the sums of partial sums, (lanes,)."""
    sums: Doubles = parts.reshape(len(parts), -1).sum(axis=0)
    return sums


def _ratio(a: Doubles, b: Doubles, where: NDArray[np.bool_]) -> Doubles:
    """Return quotients a / b, and 0 elsewhere."""
    return np.divide(a, b, out=np.zeros(len(a)), where=where)
