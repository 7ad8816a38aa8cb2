"""The choice of the solver of an integration, and its result."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.operation import OnDevice
from mirrorskin.engine.base.options import option
from mirrorskin.engine.integration.graph import (
    Components,
    Levelling,
    Links,
    PixelGraph,
    Plane,
    find_components,
)
from mirrorskin.engine.integration.height_variance import JOINED, expected_misfit
from mirrorskin.engine.integration.multigrid import Multigrid, Solution
from mirrorskin.engine.integration.parts import has_breaks
from mirrorskin.engine.integration.rectangle import Rectangle, seems_full
from mirrorskin.engine.integration.robust import solve_robust
from mirrorskin.engine.integration.slope_errors import correlation_of, draw_errors
from mirrorskin.engine.integration.validation import Flags, Floats, Inputs
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.findings import Finding, in_process
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.integration.links import DOWN, KNOWN, LOST, RIGHT, SLOPE

Method = Literal["direct", "multigrid", "robust"]

_NO_NOTE: dict[str, ProcessValue] = {}
_UNEVEN = 2.0  # ratio of the weights of horizontal and vertical links above which they count as uneven
_PLAIN = 3e-3  # residual of the surface without breaks, with which one with breaks is compared
_BREAKS = Finding(
    "breaks of the surface",
    "the surface has breaks, and slopes do not show a step whose sides have equal slopes: heights across"
    " breaks may be wrong by more than height_sigma; compare heights within parts, or give known heights",
)
_DRAWS, _DRAWN = 4, 1e-2  # number of drawn surfaces, and residual of their solution
_GOAL = 1e-4  # residual to stop at if there is a deadline, but no tolerance


class IntegrationOptions(OnDevice):
    """Options of `integrate`, the same in all cases. The budget starts when the object is created."""

    robust: bool = option(
        default=False,
        help="whether to look for discontinuities in addition to ``edges``; one surface only",
    )
    bilateral_sharpness: float = option(
        default=2.0,
        above=0,
        help="sharpness k of discontinuities, 1/pixel^2: links that miss their slopes by more than "
        "2.4 / sqrt(2 k) are cut",
    )
    sigma: bool = option(
        default=True,
        help="whether to estimate the heights' standard deviation, which takes about as long as the heights",
    )
    slope_correlation: float | None = option(
        default=None,
        within=(0, None),
        help="distance in pixels at which the correlation of the slopes' errors is 1/e; 0 if they are "
        "independent. It increases ``height_sigma``",
        shown_default="estimated from their curl, with which stated weights are compared as well",
    )
    slope_gain_sigma: float = option(
        default=0.0,
        unit="share",
        within=(0, 1),
        help="standard deviation of an error that all slopes have in common, as a share of them: it adds "
        "this share of the height above the mean of the component to ``height_sigma``",
    )
    tolerance: float | None = option(
        default=1e-5,
        above=0,
        help="residual to stop at: norm of the error over that of the heights above the mean plane, both "
        "with the weights of the sum that is minimised. None: do two cycles",
    )
    budget: float | None = option(
        default=None,
        above=0,
        unit="s",
        help="time limit, in place of the tolerance: after the first cycle, no cycle is started that would "
        "end later. Preparation and ``sigma`` are not limited",
    )

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.deadline = None if self.budget is None else time.perf_counter() + self.budget


@dataclass(frozen=True, slots=True)
class _Relief:
    """Heights above planes on the device, as computed by a solver."""

    height: Array  # (H, W) or (K, H, W)
    planes: list[Plane]
    method: Method
    iterations: int
    residual: float
    converged: bool
    links: Links | None = None
    flags: Flags | None = None
    edges: Flags | None = None
    doubt: Floats | None = None  # variance because of breaks, mm^2


@dataclass(slots=True)
class _GraphCache:
    """Properties of the last picture's graph, reused if the next picture has the same graph."""

    numbers: tuple[object, ...] | None  # determine the links' weights together with the flags; None: maps do
    flags: Flags
    built: bool = False  # whether the multigrid has the levels of this graph
    components: Components | None = None
    sigma: Floats | None = None  # standard deviation of heights for slopes of variance 1


class SurfaceSolver:
    """Solvers for pictures of one shape and pixel size; memory and properties of equal graphs are reused."""

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device = device
        self._graph = PixelGraph(device, shape)
        self._levelling = Levelling(self._graph)
        self._rectangle: Rectangle | None = None
        self._multigrid: Multigrid | None = None
        self._cache = _GraphCache(None, np.zeros(shape, np.uint8))
        self._plane: Plane | None = None
        self._last: Array | None = None
        self._finishing = 0.0  # seconds from the last solution to the result

    def reset(self) -> None:
        """Forget the heights of the last picture; its levels are still used for the same graph."""
        self._last = self._plane = None

    def solve(
        self, inputs: Inputs, options: IntegrationOptions, start: NDArray[np.floating] | None = None
    ) -> Result:
        """Return the surface of a picture, starting from ``start``, (H, W) mm, or the last heights."""
        if (
            not options.robust
            and seems_full(inputs)
            and (result := self._solve_full(inputs, options)) is not None
        ):
            return result
        flags = self._graph.upload(inputs.each()[0])
        if not np.bitwise_or.reduce(flags, axis=None) & (SLOPE | KNOWN):
            raise InputError("nothing to integrate: no wanted pixel has slopes or a known height")
        numbers = None
        if inputs.weight_x is None and inputs.known_height_weights is None:
            numbers = inputs.weight, inputs.known_height_weight, inputs.known_heights is None
        if numbers is None or numbers != self._cache.numbers or not np.array_equal(flags, self._cache.flags):
            self._cache = _GraphCache(numbers, flags)
        relief = (
            self._find(inputs, options, start)
            if inputs.dz_dx.ndim == 2
            else self._find_several(inputs, options)
        )
        if not math.isfinite(relief.residual) and (agreed := inputs.agreed()) is not None:
            return self.solve(agreed, options)
        if not relief.converged and options.deadline is None:
            raise NotConverged(explain(relief.iterations, relief.residual, options.tolerance))
        begun = time.perf_counter()
        result = self._finish(inputs, options, relief)
        self._finishing = time.perf_counter() - begun
        return result

    def _solve_full(self, inputs: Inputs, options: IntegrationOptions) -> Result | None:
        """Return the surface of a full rectangle with uniform weights; None if a slope is missing."""
        if self._rectangle is None or self._rectangle.shape != inputs.dz_dx.shape:
            size, area = inputs.pixel_size, math.prod(inputs.pixel_size)
            self._rectangle = Rectangle(inputs.dz_dx.shape, size, self._device, area)
        maps = self._rectangle.integrate(inputs, options.sigma)
        if maps is None:
            return None
        (height, sigma), note = maps, _NO_NOTE
        if sigma is not None:
            factor, note = correlation_of(inputs, options.slope_correlation)
            sigma = sigma * np.float32(factor**0.5)
        return _as_result(
            height,
            sigma,
            np.zeros(self._graph.shape, np.int32),
            np.array([inputs.known_heights is None]),
            method="direct",
            iterations=1,
            residual=0.0,
            converged=True,
            invalid=0,
            note=note,
        )

    def _find(
        self, inputs: Inputs, options: IntegrationOptions, start: NDArray[np.floating] | None
    ) -> _Relief:
        """Choose a solver and run it."""
        if self._plane is None:
            self._plane = self._graph.mean_plane(inputs)
        plane, links = self._plane, self._graph.links(self._plane)
        first = None if start is None else self._above_plane(start, inputs, plane)
        if options.robust:
            return self._find_robust(inputs, options, links, first)
        first_heights = self._last if first is None else self._graph.put("start", first)
        solution = self._build(links).solve(first_heights, **self._goal(options))
        self._last = solution.height
        return _relief(solution, [plane])

    def _find_robust(
        self, inputs: Inputs, options: IntegrationOptions, links: Links, start: Floats | None
    ) -> _Relief:
        """Find a surface and its breaks, after the surface without breaks."""
        assert self._plane is not None
        weighted = inputs.weighted()
        if weighted is not inputs:
            self._graph.upload(weighted)
            links = self._graph.links(self._plane)
        first = None if start is None else self._graph.put("start", start)
        solver = self._build(links)
        plain = solver.solve(first, tolerance=_PLAIN, deadline=options.deadline).height.read()
        if weighted is not inputs:
            self._graph.upload(inputs)
            links = self._graph.links(self._plane)
        self._cache.built = False
        robust = solve_robust(
            *(inputs, links, self._cache.flags, self._plane, options.bilateral_sharpness),
            plain=plain,
            components=self._whole_components(inputs),
            solver=solver,
            start=start,
            tolerance=options.tolerance or _GOAL,
            deadline=options.deadline,
        )
        return _Relief(
            robust.relief,
            [self._plane],
            "robust",
            robust.iterations,
            robust.residual,
            robust.converged or options.tolerance is None,
            robust.links,
            robust.flags,
            robust.edges,
            robust.doubt,
        )

    def _find_several(self, inputs: Inputs, options: IntegrationOptions) -> _Relief:
        """Solve for several surfaces with one graph."""
        each = inputs.each()
        planes = [self._graph.mean_plane(surface) for surface in each]
        solver = self._build(self._graph.links(planes[0]))
        sources = self._device.array("sources", inputs.dz_dx.shape, np.float32, zeroed=False)
        for number, (surface, plane) in enumerate(zip(each, planes, strict=True)):
            self._graph.set_slopes(surface)
            self._graph.put_source(plane, sources, number)
        return _relief(solver.solve_many(sources, **self._goal(options)), planes)

    def _build(self, links: Links) -> Multigrid:
        """Return the solver, with the levels of the graph."""
        if self._multigrid is None:
            self._multigrid = Multigrid(links)
        elif not self._cache.built:
            self._multigrid.rebuild(links)
        self._cache.built = True
        return self._multigrid

    def _goal(self, options: IntegrationOptions) -> dict[str, Any]:
        """Return when the solver stops."""
        if options.deadline is None:
            return {"tolerance": options.tolerance}
        return {"tolerance": options.tolerance or _GOAL, "deadline": options.deadline - self._finishing}

    def _above_plane(self, start: NDArray[np.floating], inputs: Inputs, plane: Plane) -> Floats:
        """Return first heights above the plane, 0 where they are unknown."""
        finite = np.isfinite(start)
        along_x, along_y, begin = self._graph.steps(plane)
        row, column = np.ogrid[: start.shape[0], : start.shape[1]]
        above = start - (begin + along_x * column + along_y * row)
        datum = inputs.datum
        if inputs.known_heights is None:
            datum = float(np.mean(above, where=finite)) if finite.any() else 0.0
        return np.where(finite, above - datum, 0.0).astype(np.float32)

    def _finish(self, inputs: Inputs, options: IntegrationOptions, relief: _Relief) -> Result:
        """Add plane and offsets to the relief, and estimate the standard deviation."""
        whole = components = self._whole_components(inputs)
        if relief.flags is not None:
            components = find_components(relief.flags, True)
        on_device = isinstance(inputs.dz_dx, Array)
        height = self._levelling.level(whole, relief.height, relief.planes, inputs.datum, on_device)
        sigma, note = None, dict(_NO_NOTE)
        if options.sigma:
            respond = partial(self._respond, inputs, components) if relief.flags is None else None
            factor, note = correlation_of(inputs, options.slope_correlation, respond)
            sigma = self._find_sigma(inputs, relief, components, factor)
        if relief.edges is not None and (components.count > whole.count or has_breaks(relief.edges)):
            note |= in_process([_BREAKS], note)
        return _as_result(
            height,
            sigma,
            components.labels,
            components.offset_unknown,
            relief.edges,
            method=relief.method,
            iterations=relief.iterations,
            residual=relief.residual,
            converged=relief.converged,
            invalid=int(np.count_nonzero(self._cache.flags & LOST)),
            note=note,
        )

    def _whole_components(self, inputs: Inputs) -> Components:
        """Return the components of the graph, without breaks that a search finds."""
        if self._cache.components is None:
            flags = self._cache.flags
            alone = (flags & (SLOPE | KNOWN)) == KNOWN
            by_links = inputs.edges is not None or inputs.weight_y is not None or bool(alone.any())
            self._cache.components = find_components(flags, by_links)
        return self._cache.components

    def _find_sigma(self, inputs: Inputs, relief: _Relief, components: Components, factor: float) -> Floats:
        """Return the standard deviation of heights; the factor is of the variance of noise."""
        factor *= self._graph.scale
        if not inputs.weights_given:
            factor *= self._excess(inputs, relief, components)
        if relief.flags is not None:
            assert self._multigrid is not None
            assert relief.links is not None
            self._graph.put("flags", relief.flags)
            self._multigrid.rebuild(relief.links, strength=JOINED)
            sigma = self._multigrid.deviation(self._graph.flags, uneven=False)
        else:
            sigma = self._unit_sigma(inputs)
        sigma = sigma * np.float32(factor**0.5)
        return sigma if relief.doubt is None else np.sqrt(np.square(sigma) + relief.doubt)

    def _unit_sigma(self, inputs: Inputs) -> Floats:
        """Return the standard deviation of heights if the weights are inverse variances."""
        if self._cache.sigma is None:
            assert self._multigrid is not None
            ends = self._link_weights(inputs)
            uneven = inputs.weight_x is not None or max(ends) > _UNEVEN * min(ends)
            if uneven:
                self._cache.built = False  # other levels are built
            self._cache.sigma = self._multigrid.deviation(self._graph.flags, uneven)
        return self._cache.sigma

    def _respond(self, inputs: Inputs, components: Components, length: float) -> float:
        """Return the variance of heights if errors are correlated over a length, over that if they are not.

        It is the mean of draws: what correlated errors add depends on what is missing. Without stated
        weights, it is relative to the misfit.
        """
        errors = draw_errors(inputs, length, _DRAWS)
        relief = self._find_several(errors, IntegrationOptions(tolerance=_DRAWN))
        heights = self._levelling.level(components, relief.height, relief.planes)
        misfit = 1.0 if inputs.weights_given else self._excess(errors, relief, components)
        self._graph.set_slopes(inputs.each()[0])
        variance = np.square(self._unit_sigma(inputs)) * np.float32(self._graph.scale)
        counted = np.isfinite(heights) & (variance > 0)
        scaled = np.divide(np.square(heights), variance, out=np.zeros_like(heights), where=counted)
        factor = float(np.mean(scaled, where=counted)) if counted.any() else 1.0
        return factor if inputs.weights_given else factor / misfit

    def _excess(self, inputs: Inputs, relief: _Relief, components: Components) -> float:
        """Return the misfit over that expected for noise of variance 1; NaN without loops of links."""
        flags = self._cache.flags if relief.flags is None else relief.flags
        ends = self._link_weights(inputs)
        count = {bit: int(np.count_nonzero(flags & bit)) for bit in (RIGHT, DOWN, KNOWN, SLOPE | KNOWN)}
        links, loop_fraction = count[RIGHT] + count[DOWN], 1.0
        if relief.links is not None:  # the mean weight is this share of the full weight
            maps = relief.links.right, relief.links.down
            total = sum(
                float(link.read().sum(dtype=np.float64)) / w for link, w in zip(maps, ends, strict=True)
            )
            loop_fraction = total / max(1, links)
        free = int(np.count_nonzero(components.offset_unknown))
        unit = loop_fraction * expected_misfit(links, count[SLOPE | KNOWN], count[KNOWN], free, ends)
        misfit = 0.0
        each = inputs.each()
        for number, (surface, plane) in enumerate(zip(each, relief.planes, strict=True)):
            if len(each) > 1:
                self._graph.set_slopes(surface)
            misfit += self._graph.misfit(relief.height, plane, relief.links, number)
        return misfit / len(each) / unit if unit > 0 else math.nan

    def _link_weights(self, inputs: Inputs) -> tuple[float, float]:
        """Return the weights of links to the right and down between pixels of weight 1."""
        width, height = inputs.pixel_size
        return self._graph.scale / width**2, self._graph.scale / height**2


def _relief(solution: Solution, planes: list[Plane]) -> _Relief:
    numbers = solution.iterations, solution.residual, solution.converged
    return _Relief(solution.height, planes, "multigrid", *numbers)


def _as_result(
    height: Any,
    sigma: Floats | None,
    component: NDArray[np.int32],
    offset_unknown: NDArray[np.bool_],
    edges: Flags | None = None,
    *,
    method: Method,
    note: dict[str, ProcessValue],
    **numbers: ProcessValue,
) -> Result:
    process: dict[str, ProcessValue] = {"integration": method, **note}
    process |= {f"integration_{name}": value for name, value in numbers.items()}
    return Result(
        height=height,
        height_sigma=sigma,
        component=component,
        offset_unknown=offset_unknown.astype(np.uint8),
        filled=np.zeros(component.shape, np.uint8),
        edges=edges,
    ).with_process(process)


def explain(iterations: int, residual: float, tolerance: float | None) -> str:
    """Return the message of an integration that did not converge."""
    limit = "" if tolerance is None else f", more than {tolerance:.2g}"
    reached = f"{iterations} iterations left a residual of {residual:.2g}{limit}"
    remedy = "give engine.integrate a larger tolerance, or None to accept any residual"
    return f"the surface did not converge: {reached}; {remedy}"
