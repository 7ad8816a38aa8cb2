"""Heights from slopes: `integrate`, the same for frame after frame, and the choice of a solver."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.integration.graph import (
    LEVEL,
    Components,
    Levelling,
    Links,
    PixelGraph,
    Plane,
    find_components,
)
from mirrorskin.engine.integration.height_variance import find_sigma
from mirrorskin.engine.integration.rectangle import Rectangle
from mirrorskin.engine.integration.robust import solve_robust
from mirrorskin.engine.integration.surface import IntegrationMethod, Surface
from mirrorskin.engine.integration.validation import (
    Flags,
    Floats,
    Inputs,
    check_above_zero,
    check_inputs,
    check_map,
    check_pixel_size,
)
from mirrorskin.engine.integration.vcycle import Multigrid
from mirrorskin.io import InputError
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.links import KNOWN, LOST, SLOPE

_STIFF = 100.0  # times a link's that known heights weigh, above which the direct solver loses too many digits
_GOAL = 1e-4  # residual that is near enough where there is a deadline instead of a tolerance
# The memory of the last call, some 100 bytes a pixel, is kept for the next one: making it takes as long as a
# solution (512 x 512 within a mask: 12 ms instead of 26). Not above so many pixels.
_KEPT = 2**21
_spare: list[tuple[tuple[Device, tuple[int, int], tuple[float, float]], SurfaceSolver]] = []


def integrate(
    dz_dx: ArrayLike,
    dz_dy: ArrayLike,
    pixel_size: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    slope_weights: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    known_heights: ArrayLike | None = None,
    known_height_weights: ArrayLike | None = None,
    robust: bool = False,
    bilateral_sharpness: float = 2.0,
    sigma: bool = True,
    initial_heights: ArrayLike | None = None,
    tolerance: float | None = 1e-5,
    budget: float | None = None,
    device: str | Device | None = None,
) -> Surface:
    """Find the heights that fit slopes, and heights where they are known, best.

    Neighbours i and j with slopes are linked. The heights u are those of the least ::

        sum of w (u_j - u_i - d)^2  +  sum of a (u_i - k_i)^2

    over all links and known heights k; d is the pixel size times the slope of the link, which is
    (-s[-1] + 13 s[0] + 13 s[1] - s[2]) / 24 of four pixels in line where links lead through all of them, else
    the mean of two. w is the harmonic mean of both pixels' weights over the pixel size squared, a the weight
    of the known height. The border is free (natural boundary). A full rectangle with even weights is solved
    directly, all else by conjugate gradients with multigrid.

    Parameters
    ----------
    dz_dx, dz_dy : array_like, (H, W)
        Slopes along x (to the right) and along y, which runs up the picture. Not finite where there is none.
    pixel_size : array_like
        Millimetres, one number or (x, y).
    mask : array_like, (H, W), optional
        0 where no answer is wanted.
    slope_weights : array_like, scalar, (H, W) or (2, H, W), optional
        Inverse variances of the slopes, or of dz_dx and of dz_dy; 0 where there is none. By default all are
        equally noisy, and ``sigma`` is estimated from how well they fit together. What is below 1e-4 or above
        1e3 of their median counts as that; what is 0 in float32, as 0.
    edges : array_like, (H, W), optional
        Not 0 on pixels where the surface breaks: they keep but one link, to that neighbour off the edge whose
        slopes are the most similar, and so never join two sides.
    known_heights : array_like, (H, W), optional
        Known heights, mm; NaN elsewhere. They need no slope.
    known_height_weights : array_like, scalar or (H, W), optional
        Their inverse variances, 1/mm^2; 0 where nothing is known. 1 by default. What is above 1e4 of a link's
        weight w counts as that.
    robust : bool
        Whether to look for discontinuities beyond ``edges``, by bilateral weights.
    bilateral_sharpness : float
        How sharply these choose a side, 1/pixel^2: k of Cao et al., Bilateral normal integration, 2022.
    sigma : bool
        Whether to estimate the standard deviation of the heights; this takes as long as 80 low-accuracy
        solutions.
    initial_heights : array_like, (H, W), optional
        Heights to begin with, NaN where there is none.
    tolerance : float or None
        Of the residual, which is `Surface.residual`; parts of small weight may be less near. None takes what
        full multigrid and two cycles give.
    budget : float, optional
        Seconds, in place of the tolerance: after the first, no cycle is begun that would end later. The
        set-up is not cut.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Surface

    Raises
    ------
    mirrorskin.io.InputError
        Maps that do not fit each other, or of which nothing can be used; numbers out of range.
    NotConverged
        The tolerance was not met.
    mirrorskin.kernels.errors.DeviceError
        No device, or one without room for the maps.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> surface = engine.integrate(np.full((2, 3), 0.5), np.zeros((2, 3)), 1.0)
    >>> surface.height[0].round(3).tolist()
    [-0.5, 0.0, 0.5]
    """
    began = time.perf_counter()
    inputs = check_inputs(
        dz_dx,
        dz_dy,
        pixel_size,
        mask=mask,
        slope_weights=slope_weights,
        edges=edges,
        known_heights=known_heights,
        known_height_weights=known_height_weights,
    )
    check_above_zero(bilateral_sharpness=bilateral_sharpness, tolerance=tolerance, budget=budget)
    start = None
    if initial_heights is not None:
        start = check_map("initial_heights", initial_heights, inputs.shape).astype(np.float64)
    options = SolverOptions(
        tolerance=tolerance,
        deadline=None if budget is None else began + budget,
        sharpness=bilateral_sharpness if robust else None,
        sigma=sigma,
    )
    with _borrowed_solver(open_device(device), inputs) as solver:
        return solver.solve(inputs, options, start)


@contextmanager
def _borrowed_solver(device: Device, inputs: Inputs) -> Iterator[SurfaceSolver]:
    """Take the last call's solver if it fits, and give it back."""
    key = device, inputs.shape, inputs.pixel_size
    try:
        kept, solver = _spare.pop()  # at once, so that no two threads have it
    except IndexError:
        kept, solver = None, None
    if solver is None or kept != key:
        solver = SurfaceSolver(device, inputs.shape)
    yield solver  # one that failed is not kept
    solver.reset()
    if math.prod(inputs.shape) <= _KEPT and not _spare:
        _spare.append((key, solver))


class Integrator:
    """Integrate slopes frame after frame: memory is kept, and heights start from the last ones.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the maps.
    pixel_size : array_like
        Millimetres, one number or (x, y).
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> integrator = engine.Integrator((2, 3), 1.0)
    >>> for slope in (0.25, 0.5):
    ...     integrator.push(np.full((2, 3), slope), np.zeros((2, 3)))
    >>> integrator.result().height[0].round(3).tolist()
    [-0.5, 0.0, 0.5]
    """

    def __init__(
        self, shape: tuple[int, int], pixel_size: ArrayLike, *, device: str | Device | None = None
    ) -> None:
        self._shape, self._pixel_size = tuple(shape), check_pixel_size(pixel_size)
        self._solver = SurfaceSolver(open_device(device), shape)
        self._surface: Surface | None = None

    def push(
        self,
        dz_dx: ArrayLike,
        dz_dy: ArrayLike,
        *,
        mask: ArrayLike | None = None,
        slope_weights: ArrayLike | None = None,
        edges: ArrayLike | None = None,
        known_heights: ArrayLike | None = None,
        known_height_weights: ArrayLike | None = None,
        budget: float | None = None,
        tolerance: float | None = None,
    ) -> None:
        """Integrate the slopes of one frame, without the heights' sigma.

        The maps are those of `mirrorskin.engine.integrate`. By default two cycles are done, from the last
        frame's heights on.

        Parameters
        ----------
        budget : float, optional
            Seconds; after the first, cycles are done as long as they end in time, and until they are of no
            more use.
        tolerance : float, optional
            Of the residual; with a budget it may be missed.

        Raises
        ------
        mirrorskin.io.InputError
            Maps that cannot be used, or of another shape than the integrator's.
        NotConverged
            The tolerance was not met, without a budget.
        """
        began = time.perf_counter()
        inputs = check_inputs(
            dz_dx,
            dz_dy,
            self._pixel_size,
            mask=mask,
            slope_weights=slope_weights,
            edges=edges,
            known_heights=known_heights,
            known_height_weights=known_height_weights,
        )
        if inputs.shape != self._shape:
            raise InputError(f"slopes have shape {inputs.shape}, not {self._shape}: make another Integrator")
        check_above_zero(tolerance=tolerance, budget=budget)
        self._surface = None
        deadline = None if budget is None else began + budget
        self._surface = self._solver.solve(inputs, SolverOptions(tolerance=tolerance, deadline=deadline))

    def result(self) -> Surface:
        """Return the surface of the last frame.

        Raises
        ------
        mirrorskin.io.InputError
            There was none, or it had none.
        """
        if self._surface is None:
            raise InputError("there is no surface yet: push the slopes of a frame first")
        return self._surface

    def reset(self) -> None:
        """Forget the last frame's heights: the next frame has nothing to do with it."""
        self._surface = None
        self._solver.reset()


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """How near a solver comes, and what it tells besides.

    Attributes
    ----------
    tolerance : float or None
        Of the residual; None: as near as two cycles get.
    deadline : float or None
        Of ``time.perf_counter``; where there is one, no tolerance must be met.
    sharpness : float or None
        Of the bilateral weights that look for discontinuities; None where none are looked for.
    sigma : bool
        Whether to estimate the heights' standard deviation.
    """

    tolerance: float | None = None
    deadline: float | None = None
    sharpness: float | None = None
    sigma: bool = False


@dataclass(frozen=True, slots=True)
class _Relief:
    """Heights above a plane as a solver leaves them, on the device."""

    height: Array
    plane: Plane
    method: IntegrationMethod
    iterations: int
    residual: float
    converged: bool
    links: Links | None = None
    flags: Flags | None = None
    edges: Flags | None = None


class SurfaceSolver:
    """Solvers for pictures of one shape and pixel size; what they allocated and found is used again."""

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device = device
        self._graph = PixelGraph(device, shape)
        self._levelling = Levelling(self._graph)
        self._rectangle: Rectangle | None = None
        self._multigrid: Multigrid | None = None
        self._flags = np.zeros(shape, np.uint8)
        self._key: tuple[object, ...] | None = None
        self._next_key: tuple[object, ...] | None = None
        self._components: Components | None = None
        self._plane: Plane | None = None
        self._last: Array | None = None
        self._finishing = 0.0  # seconds that the last picture took after its solution

    def reset(self) -> None:
        """Forget the last picture and its heights."""
        self._last = self._plane = self._components = self._key = None

    def solve(
        self, inputs: Inputs, options: SolverOptions, start: NDArray[np.floating] | None = None
    ) -> Surface:
        """Return the surface of a picture, from a start, (H, W), mm, or the last heights on."""
        flags = self._graph.upload(inputs)
        if not np.bitwise_or.reduce(flags, axis=None) & (SLOPE | KNOWN):
            raise InputError("nothing to integrate: no pixel that is wanted has slopes or a known height")
        same = self._is_same(inputs, flags)
        relief = self._find(inputs, options, start, same)
        if not relief.converged and options.deadline is None:
            raise NotConverged(explain(relief.iterations, relief.residual, options.tolerance))
        begun = time.perf_counter()
        surface = self._finish(inputs, options, relief, same)
        self._finishing = time.perf_counter() - begun
        return surface

    def _is_same(self, inputs: Inputs, flags: Flags) -> bool:
        """Tell whether the graph is that of the last multigrid; until there is a new one, it is no one's."""
        even = inputs.weight_x is None and inputs.known_height_weights is None
        heights = inputs.known_height_weight, inputs.known_heights is None
        key = inputs.weight, *heights, inputs.pixel_size
        same = even and key == self._key and np.array_equal(flags, self._flags)
        self._key, self._next_key = None, key if even else None
        if not same:
            self._flags = flags.copy()
        return same

    def _find(
        self, inputs: Inputs, options: SolverOptions, start: NDArray[np.floating] | None, same: bool
    ) -> _Relief:
        """Choose a solver and run it."""
        if options.sharpness is None and self._is_full_and_even(inputs):
            height = self._find_rectangle(inputs).solve(self._graph.source(), self._screening(inputs))
            return _Relief(height, LEVEL, "direct", 1, 0.0, True)
        if self._plane is None:
            self._plane = self._graph.mean_plane()
        first = None if start is None else self._above_plane(start, inputs, self._plane)
        links = self._graph.links(self._plane)
        if options.sharpness is not None:
            return self._solve_robust(inputs, links, options, options.sharpness, first)
        begin = self._last if first is None else self._graph.put("start", first)
        if self._multigrid is None:
            self._multigrid = Multigrid(links)
        elif not same:
            self._multigrid.rebuild(links)
        self._key = self._next_key
        goal = options.tolerance if options.deadline is None else options.tolerance or _GOAL
        deadline = None if options.deadline is None else options.deadline - self._finishing
        found = self._multigrid.solve(begin, tolerance=goal, deadline=deadline)
        self._last = found.height
        numbers = found.iterations, found.residual, found.converged
        return _Relief(found.height, self._plane, "multigrid", *numbers)

    def _is_full_and_even(self, inputs: Inputs) -> bool:
        """Tell whether all pixels, links and known heights are alike."""
        if inputs.weight_x is not None or inputs.edges is not None or inputs.known_height_weights is not None:
            return False
        every = SLOPE if inputs.known_heights is None else SLOPE | KNOWN
        full = bool(np.bitwise_and.reduce(self._flags, axis=None) & every == every)
        return full and self._screening(inputs) <= _STIFF

    def _find_rectangle(self, inputs: Inputs) -> Rectangle:
        if self._rectangle is None:
            scale = self._graph.scale * inputs.weight
            self._rectangle = Rectangle(self._graph.shape, inputs.pixel_size, self._device, scale)
        return self._rectangle

    def _screening(self, inputs: Inputs) -> float:
        return 0.0 if inputs.known_heights is None else self._graph.scale * inputs.known_height_weight

    def _above_plane(self, start: NDArray[np.floating], inputs: Inputs, plane: Plane) -> Floats:
        """Return heights to begin with above the plane, about 0 where nothing is known of them."""
        known = np.isfinite(start)
        along_x, along_y, begin = self._graph.steps(plane)
        row, column = np.ogrid[: start.shape[0], : start.shape[1]]
        above = start - (begin + along_x * column + along_y * row)
        datum = inputs.datum
        if inputs.known_heights is None:
            datum = float(np.mean(above, where=known)) if known.any() else 0.0
        return np.where(known, above - datum, 0.0).astype(np.float32)

    def _solve_robust(
        self, inputs: Inputs, links: Links, options: SolverOptions, sharpness: float, start: Floats | None
    ) -> _Relief:
        assert self._plane is not None
        tolerance = options.tolerance or _GOAL
        found = solve_robust(
            inputs,
            links,
            self._flags,
            self._plane,
            sharpness,
            start=start,
            tolerance=tolerance,
            deadline=options.deadline,
        )
        numbers = found.iterations, found.residual, found.converged or options.tolerance is None
        return _Relief(found.relief, self._plane, "robust", *numbers, found.links, found.flags, found.edges)

    def _finish(self, inputs: Inputs, options: SolverOptions, relief: _Relief, same: bool) -> Surface:
        """Add plane and offsets to relief, and estimate its standard deviation."""
        components = self._find_components(inputs, relief, same)
        self._levelling.use(components)
        height = self._levelling.level(relief.height, relief.plane, inputs.datum)
        return Surface(
            height=height,
            sigma=self._find_sigma(inputs, relief, components) if options.sigma else None,
            component=components.labels,
            offset_unknown=components.offset_unknown,
            filled=np.zeros(height.shape, np.uint8),
            edges=relief.edges,
            iterations=relief.iterations,
            residual=relief.residual,
            converged=relief.converged,
            method=relief.method,
            invalid=int(np.count_nonzero(self._flags & LOST)),
        )

    def _find_components(self, inputs: Inputs, relief: _Relief, same: bool) -> Components:
        if relief.method == "direct":
            labels, unknown = np.zeros(self._graph.shape, np.int32), np.array([inputs.known_heights is None])
            return Components(labels, unknown)
        if relief.flags is not None:
            return find_components(relief.flags, True)
        if not same or self._components is None:
            alone = (self._flags & (SLOPE | KNOWN)) == KNOWN
            cut = inputs.edges is not None or inputs.weight_y is not None or bool(alone.any())
            self._components = find_components(self._flags, cut)
        return self._components

    def _find_sigma(self, inputs: Inputs, relief: _Relief, components: Components) -> Floats:
        links, graph = relief.links, self._graph
        solver = (
            self._multigrid if links is None else Multigrid(replace(links, source=graph.source(links=links)))
        )

        def solve() -> Array:
            source = graph.source(links=links)
            if relief.method == "direct" or solver is None:
                return self._find_rectangle(inputs).solve(source, self._screening(inputs))
            return solver.solve(tolerance=None).height

        misfit = None if inputs.weights_given else graph.misfit(relief.height, relief.plane, links)
        return find_sigma(inputs, graph, self._levelling, components.labels, solve, links, misfit)


def explain(iterations: int, residual: float, tolerance: float | None) -> str:
    """Say that and why there is no surface, in one line."""
    wanted = "" if tolerance is None else f", more than {tolerance:.2g}"
    reached = f"{iterations} iterations left a residual of {residual:.2g}{wanted}"
    remedy = "give engine.integrate a larger tolerance, or None to take it as it is"
    return f"the surface did not converge: {reached}; {remedy}"
