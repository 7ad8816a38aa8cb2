"""Heights from slopes: the call, its sequel for frame after frame, and the choice of a solver."""

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
    Graph,
    LinkRoom,
    Links,
    Plane,
    Settler,
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
    check_pixel_size,
    fitting,
)
from mirrorskin.engine.integration.vcycle import Multigrid
from mirrorskin.io import InputError
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.links import KNOWN, LOST, SLOPE

_STIFF = 100.0  # times a link's that known heights weigh, above which the direct solver loses too many digits
_GOAL = 1e-4  # residual that is near enough where there is a deadline instead of a tolerance


@dataclass(frozen=True, slots=True)
class Wish:
    """What is asked of a solver.

    Attributes
    ----------
    tolerance : float or None
        Of the residual; None: as near as two cycles get.
    deadline : float or None
        Of ``time.perf_counter``; where there is one, no tolerance must be met.
    k : float or None
        Of the bilateral weights that look for discontinuities; None where none are looked for.
    sigma : bool
        Whether to tell how sure the heights are.
    """

    tolerance: float | None = None
    deadline: float | None = None
    k: float | None = None
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
    """Solvers for pictures of one shape and pixel size; what they allocated and found is used again.

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.
    """

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device = device
        self._room = LinkRoom(device, shape)
        self._settler = Settler(self._room)
        self._rectangle: Rectangle | None = None
        self._multigrid: Multigrid | None = None
        self._flags = np.zeros(shape, np.uint8)
        self._key: tuple[object, ...] | None = None
        self._next_key: tuple[object, ...] | None = None
        self._components: Components | None = None
        self._plane: Plane | None = None
        self._last: Array | None = None
        self._rest = 0.0

    def restart(self) -> None:
        """Forget the last picture and its heights."""
        self._last = self._plane = self._components = self._key = None

    def solve(self, inputs: Inputs, wish: Wish, start: NDArray[np.floating] | None = None) -> Surface:
        """Return the surface of a picture.

        Parameters
        ----------
        inputs : Inputs
        wish : Wish
        start : ndarray, (H, W), optional
            Heights to begin with, mm, NaN where there is none; by default those found last.

        Raises
        ------
        mirrorskin.io.InputError
            No pixel has slopes or a known height.
        NotConverged
            The tolerance was not met.
        """
        flags = self._room.take(inputs)
        if not np.bitwise_or.reduce(flags, axis=None) & (SLOPE | KNOWN):
            raise InputError("nothing to integrate: no pixel that is wanted has slopes or a known height")
        same = self._is_same(inputs, flags)
        relief = self._find(inputs, wish, start, same)
        if not relief.converged and wish.deadline is None:
            raise NotConverged(explain(relief.iterations, relief.residual, wish.tolerance))
        begun = time.perf_counter()
        surface = self._finish(inputs, wish, relief, same)
        self._rest = time.perf_counter() - begun
        return surface

    def _is_same(self, inputs: Inputs, flags: Flags) -> bool:
        """Tell whether the graph is that of the last multigrid; until there is a new one, it is no one's."""
        maps = inputs.weight_x, inputs.height_weights
        key = inputs.weight, inputs.height_weight, inputs.heights is None, inputs.pixel_size
        plain = all(one is None for one in maps)
        same = plain and key == self._key and np.array_equal(flags, self._flags)
        self._key, self._next_key = None, key if plain else None
        if not same:
            self._flags = flags.copy()
        return same

    def _find(self, inputs: Inputs, wish: Wish, start: NDArray[np.floating] | None, same: bool) -> _Relief:
        """Choose a solver and run it."""
        if wish.k is None and self._is_plain(inputs):
            return self._solve_rectangle(inputs)
        if self._plane is None:
            self._plane = self._room.lean()
        first = None if start is None else self._above_plane(start, inputs)
        if wish.k is not None:
            return self._solve_robust(inputs, wish, wish.k, first)
        begin = self._last if first is None else self._room.put("start", first)
        links = self._room.join(self._plane)
        if self._multigrid is None:
            self._multigrid = Multigrid(links)
        elif not same:
            self._multigrid.rebuild(links)
        self._key = self._next_key
        goal = wish.tolerance if wish.deadline is None else wish.tolerance or _GOAL
        deadline = None if wish.deadline is None else wish.deadline - self._rest
        found = self._multigrid.solve(begin, tolerance=goal, deadline=deadline)
        self._last = found.height
        return _Relief(
            found.height, self._plane, "multigrid", found.iterations, found.residual, found.converged
        )

    def _is_plain(self, inputs: Inputs) -> bool:
        """Tell whether all pixels, links and known heights are alike."""
        every = SLOPE if inputs.heights is None else SLOPE | KNOWN
        uniform = inputs.weight_x is None and inputs.edges is None and inputs.height_weights is None
        uniform = uniform and self._screening(inputs) <= _STIFF
        return uniform and bool(np.bitwise_and.reduce(self._flags, axis=None) & every == every)

    def _solve_rectangle(self, inputs: Inputs) -> _Relief:
        height = self._find_rectangle(inputs).solve(self._room.ask(), self._screening(inputs))
        return _Relief(height, LEVEL, "direct", 1, 0.0, True)

    def _find_rectangle(self, inputs: Inputs) -> Rectangle:
        if self._rectangle is None:
            scale = self._room.scale * inputs.weight
            self._rectangle = Rectangle(self._room.shape, inputs.pixel_size, self._device, scale)
        return self._rectangle

    def _screening(self, inputs: Inputs) -> float:
        return 0.0 if inputs.heights is None else self._room.scale * inputs.height_weight

    def _above_plane(self, start: NDArray[np.floating], inputs: Inputs) -> Floats:
        """Return heights to begin with above the plane, about 0 where nothing is known of them."""
        known = np.isfinite(start)
        rise = self._room.rise(self._plane or LEVEL)
        row, column = np.ogrid[: start.shape[0], : start.shape[1]]
        above = start - (rise[2] + rise[0] * column + rise[1] * row)
        datum = (
            inputs.datum
            if inputs.heights is not None
            else np.mean(above, where=known)
            if known.any()
            else 0.0
        )
        return np.where(known, above - datum, 0.0).astype(np.float32)

    def _solve_robust(self, inputs: Inputs, wish: Wish, k: float, start: Floats | None) -> _Relief:
        plane = self._plane or LEVEL
        graph = Graph(self._room.join(plane), self._flags, self._room.scale, plane)
        tolerance = wish.tolerance or _GOAL
        found = solve_robust(inputs, graph, k, start=start, tolerance=tolerance, deadline=wish.deadline)
        numbers = found.iterations, found.residual, found.converged or wish.tolerance is None
        return _Relief(found.relief, plane, "robust", *numbers, found.links, found.flags, found.edges)

    def _finish(self, inputs: Inputs, wish: Wish, relief: _Relief, same: bool) -> Surface:
        """Bring relief to its height, and tell how sure it is."""
        components = self._find_components(inputs, relief, same)
        self._settler.take(components)
        height = self._settler.settle(relief.height, relief.plane, inputs.datum)
        return Surface(
            height=height,
            sigma=self._find_sigma(inputs, relief) if wish.sigma else None,
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
            labels, unknown = np.zeros(self._room.shape, np.int32), np.array([inputs.heights is None])
            return Components(labels, unknown)
        if relief.flags is not None:
            return find_components(relief.flags, True)
        if not same or self._components is None:
            alone = (self._flags & (SLOPE | KNOWN)) == KNOWN
            cut = inputs.edges is not None or inputs.weight_y is not None or bool(alone.any())
            self._components = find_components(self._flags, cut)
        return self._components

    def _find_sigma(self, inputs: Inputs, relief: _Relief) -> Floats:
        links, room = relief.links, self._room
        solver = self._multigrid if links is None else Multigrid(replace(links, source=room.ask(links=links)))

        def solve() -> Array:
            source = room.ask(links=links)
            if relief.method == "direct" or solver is None:
                return self._find_rectangle(inputs).solve(source, self._screening(inputs))
            return solver.solve(tolerance=None).height

        misfit = None if inputs.absolute else room.misfit(relief.height, relief.plane, links)
        return find_sigma(inputs, room, self._settler, solve, links, misfit)


def explain(iterations: int, residual: float, tolerance: float | None) -> str:
    """Say why a surface is not told, where so many iterations did not get as near as was asked for."""
    asked = "" if tolerance is None else f", more than {tolerance:.2g}"
    reached = f"{iterations} iterations left a residual of {residual:.2g}{asked}"
    remedy = "give engine.integrate a larger tolerance, or None to take it as it is"
    return f"the surface did not converge: {reached}; {remedy}"


_KEPT = 2**21  # pixels up to which the room of the last call, some 100 bytes each, is kept for the next
_spare: list[tuple[tuple[Device, tuple[int, int], tuple[float, float]], SurfaceSolver]] = []


def integrate(
    dz_dx: ArrayLike,
    dz_dy: ArrayLike,
    pixel_size: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    heights: ArrayLike | None = None,
    height_weights: ArrayLike | None = None,
    robust: bool = False,
    k: float = 2.0,
    sigma: bool = True,
    start: ArrayLike | None = None,
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
    of the known height. Nothing is asked of the surface's border. What is full and even all over is solved
    directly, all else by conjugate gradients with multigrid.

    Parameters
    ----------
    dz_dx, dz_dy : array_like, (H, W)
        Slopes along x (to the right) and along y, which runs up the picture. Not finite where there is none.
    pixel_size : array_like
        Millimetres, one number or (x, y).
    mask : array_like, (H, W), optional
        0 where no answer is wanted.
    weights : array_like, scalar, (H, W) or (2, H, W), optional
        Inverse variances of the slopes, or of dz_dx and of dz_dy; 0 where there is none. By default all are
        as noisy as each other; how noisy that is, for ``sigma``, is told from how well they fit together.
        What is below 1e-4 or above 1e3 of their median counts as that; what is 0 in float32, as 0.
    edges : array_like, (H, W), optional
        Not 0 on pixels where the surface breaks: they keep but one link, to that neighbour off the edge whose
        slopes are the most similar, and so never join two sides.
    heights : array_like, (H, W), optional
        Known heights, mm; NaN elsewhere. They need no slope.
    height_weights : array_like, scalar or (H, W), optional
        Their inverse variances, 1/mm^2; 0 where nothing is known. 1 by default. What is above 1e4 of a link's
        weight w counts as that: such a height stands against all that slopes say, but for a part in 1e4.
    robust : bool
        Whether to look for discontinuities that ``edges`` do not tell, by bilateral weights.
    k : float
        How sharply these choose a side, 1/pixel^2 (Cao et al., Bilateral normal integration, 2022).
    sigma : bool
        Whether to tell how sure the heights are; this takes as long as 80 hasty solves.
    start : array_like, (H, W), optional
        Heights to begin with, NaN where there is none.
    tolerance : float or None
        Of the residual: how far the heights are from the solution, as the sum above weighs it, over the
        heights themselves, both without the plane that the slopes lean with; parts of small weight may be
        less near. None takes what full multigrid and two cycles give.
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
    """
    began = time.perf_counter()
    inputs = check_inputs(
        dz_dx,
        dz_dy,
        pixel_size,
        mask=mask,
        weights=weights,
        edges=edges,
        heights=heights,
        height_weights=height_weights,
    )
    check_above_zero(k=k, tolerance=tolerance, budget=budget)
    first = None if start is None else fitting("start", start, inputs.shape).astype(np.float64)
    deadline = None if budget is None else began + budget
    wish = Wish(tolerance=tolerance, deadline=deadline, k=k if robust else None, sigma=sigma)
    with _solver(open_device(device), inputs) as solver:
        return solver.solve(inputs, wish, first)


@contextmanager
def _solver(device: Device, inputs: Inputs) -> Iterator[SurfaceSolver]:
    """Lend the last call's solver if it fits, for making its room takes as long as a solution."""
    key = device, inputs.shape, inputs.pixel_size
    try:
        kept, solver = _spare.pop()  # at once, so that no two threads have it
    except IndexError:
        kept, solver = None, None
    if solver is None or kept != key:
        solver = SurfaceSolver(device, inputs.shape)
    yield solver  # one that failed is not kept
    solver.restart()
    if math.prod(inputs.shape) <= _KEPT and not _spare:
        _spare.append((key, solver))


class Integrator:
    """Integrate slopes again and again: its room on the device stays, and heights start from the last ones.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the maps.
    pixel_size : array_like
        Millimetres, one number or (x, y).
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    """

    def __init__(
        self, shape: tuple[int, int], pixel_size: ArrayLike, *, device: str | Device | None = None
    ) -> None:
        self._shape, self._pixel_size = tuple(shape), check_pixel_size(pixel_size)
        self._solver = SurfaceSolver(open_device(device), shape)

    def integrate(
        self,
        dz_dx: ArrayLike,
        dz_dy: ArrayLike,
        *,
        mask: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        edges: ArrayLike | None = None,
        heights: ArrayLike | None = None,
        height_weights: ArrayLike | None = None,
        budget: float | None = None,
        tolerance: float | None = None,
    ) -> Surface:
        """Return the surface of one frame, without its sigma.

        The maps are those of `mirrorskin.engine.integrate`. By default two cycles after the last frame's
        heights must do.

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
            Maps that cannot be used, or of another size than was said.
        NotConverged
            The tolerance was not met, without a budget.
        """
        began = time.perf_counter()
        inputs = check_inputs(
            dz_dx,
            dz_dy,
            self._pixel_size,
            mask=mask,
            weights=weights,
            edges=edges,
            heights=heights,
            height_weights=height_weights,
        )
        if inputs.shape != self._shape:
            raise InputError(f"slopes have shape {inputs.shape}, not {self._shape}: make another Integrator")
        check_above_zero(tolerance=tolerance, budget=budget)
        deadline = None if budget is None else began + budget
        return self._solver.solve(inputs, Wish(tolerance=tolerance, deadline=deadline))

    def restart(self) -> None:
        """Forget the last frame's heights: the next frame has nothing to do with it."""
        self._solver.restart()
