"""Heights of a surface that breaks where nobody says: bilateral weights, renewed step by step."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.graph import Links, Plane
from mirrorskin.engine.integration.validation import Flags, Inputs
from mirrorskin.engine.integration.vcycle import Multigrid
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.bilateral import DOWN, RIGHT

BROKEN = 0.02
"""Part of its full weight below which a link leads across a discontinuity."""

_Weights = tuple[NDArray[np.float32], NDArray[np.float32]]

_LOOSE, _TIGHT = 0.03, 1e-3  # residuals of a step's equations: as a rule, and where the energy rose
_CURL, _CLEAR = 4.0, 6.0  # standard deviations of the curl's noise: to open links; somewhere at least
_LEAST_CURL = 0.05  # to open links where there is no noise
_EAGER = 2.5  # times k: cuts are cheaper then
_BEYOND = 1.5  # times a step: the bound is lower up to twice of it, and this is sooner there
_ROUGH, _REST = 1e-3, 1e-6  # parts of the energy; to fall by less is to rest: at first, and in the end


@dataclass(frozen=True, slots=True)
class Robust:
    """Heights of a surface that may break, and where it does."""

    relief: Array  # (H, W), float32: heights above the plane, mm; meaningless where there is no pixel
    links: Links  # the graph that they solve, with the final weights
    flags: Flags  # (H, W), uint8: those given, without links whose weight is 0 now
    edges: Flags  # (H, W), uint8: 1 on either side of a discontinuity
    # Energy of the heights that the best descent began with, and after each of its steps.
    energies: tuple[float, ...]
    iterations: int  # steps of all descents
    # Norm of b - A u, of the links' final weights, over that of b; times the solver's own residual, if a last
    # solution was needed.
    residual: float
    # Whether the energy is stationary, and the residual within the tolerance or too small to lower it.
    converged: bool


@dataclass(slots=True)
class _Descent:
    """Where a descent has come to."""

    relief: Array
    energies: list[float]
    converged: bool = False


def solve_robust(
    inputs: Inputs,
    links: Links,
    flags: Flags,
    plane: Plane,
    sharpness: float,
    *,
    start: NDArray[np.floating[Any]] | None = None,
    tolerance: float = 1e-5,
    limit: int = 300,
    deadline: float | None = None,
) -> Robust:
    """Find heights that fit slopes and known heights, and the discontinuities between them.

    The energy of ``mirrorskin.kernels.bilateral`` is lowered step by step: a step solves the least squares
    that bound it at the heights so far, with low accuracy, for the change of the heights; the change is then
    taken one and a half times. A step that would raise the energy is done again with higher accuracy, or not
    at all. There are many minima, so descents from several starts compete: from plain least squares; where
    the curl of the slopes is far above its noise, from least squares without the links around it, where a
    surface must break; and from there by way of an energy in which breaks are cheaper.

    A height is determined along paths of links that are not cut, and a break must be worth its price, ln 2 /
    k for each pixel on either side and along it (k the sharpness).

    - What is cut off all round keeps its shape, and is a component with an unknown offset unless a height in
      it is known. As long as no slope contradicts, it is not cut off at all: a ball on a plane stays on it
      without a step, of whatever height.
    - Of two ways to cut that explain the slopes, the shorter one is found. A ramp that rises from a plane and
      ends in a cliff is distinguished from one that begins with the cliff if its foot is the longer side.
    - The place of a break is determined where its height changes along it; elsewhere it takes the shortest
      way.
    - A step lower than about two pixels (at k = 2; the square root of 8 / k) is taken for a bend, and bends
      the surface for some pixels around: so at the tip of a tear.
    - A known height that contradicts the slopes around it is worth four cuts at most: if it stands alone, its
      pixel breaks away. It takes about as many known heights as a break is long to move a component.
    - Creases err towards their flatter side by s^3 / (2 (2 + s^2)) pixels, s the slope on the other: 0.07 at
      35 degrees. It is how the energy counts, and 2 % of a step of 7 pixels with two creases.

    ``links`` are of heights above the plane; only these can be cut. ``sharpness`` is k, 1/pixel^2: a link is
    cut where it misses the slopes by well above the square root of 1 / k, seen across the surface. ``start``,
    heights above the plane, is the only start where it is given. ``tolerance`` is the residual of the least
    squares that the last weights make; a descent ends after ``limit`` steps, or at the ``deadline``, of
    ``time.perf_counter``.
    """
    search = _Search(_Bound(inputs, links, flags, plane), limit, deadline)
    starts = [(search.given(start), 1.0)] if start is not None else search.starts()
    found, steps = [], 0
    for relief, factor in starts:
        if factor != 1.0:
            first = search.descend(relief, factor * sharpness, _ROUGH)
            relief, steps = first.relief, steps + len(first.energies) - 1
        found.append(search.descend(relief, sharpness, _REST))
        steps += len(found[-1].energies) - 1
    return search.conclude(min(found, key=lambda one: one.energies[-1]), sharpness, tolerance, steps)


class _Search:
    """Descents of the energy of ``mirrorskin.kernels.bilateral`` on a device."""

    def __init__(self, bound: _Bound, limit: int, deadline: float | None) -> None:
        self._bound, self._limit, self._deadline = bound, limit, deadline
        self._zero = bound.given("zero", np.zeros(bound.flags.shape))
        self._bound.share(0.0, self._zero)
        self._solver = Multigrid(self._bound.link(self._zero))

    def given(self, relief: NDArray[np.floating[Any]]) -> Array:
        """Return a start that was given."""
        return self._bound.given("start", np.where(np.isfinite(relief), relief, 0.0))

    def starts(self) -> list[tuple[Array, float]]:
        """Return reliefs to begin with, and by what the sharpness is multiplied at first."""
        plain = self._solve(self._zero, _TIGHT)
        curl = self._bound.curl()
        sizes = np.abs(curl.download())
        curl.upload()
        some = sizes[sizes > 0]
        noise = float(np.median(some)) / 0.6745 if some.size else 0.0  # of a normal distribution
        if sizes.max() <= max(_CLEAR * noise, _LEAST_CURL):
            return [(plain, 1.0)]
        level = max(_CURL * noise, _LEAST_CURL)
        self._solver.rebuild(self._bound.link(self._zero, curl, level))
        opened = self._solve(self._zero, _TIGHT)
        return [(opened, 1.0), (opened, _EAGER), (plain, 1.0)]

    def descend(self, relief: Array, sharpness: float, rest: float) -> _Descent:
        """Lower the energy of a relief until it rests."""
        descent = _Descent(relief, [self._bound.share(sharpness, relief)])
        while len(descent.energies) <= self._limit and not descent.converged:
            if self._deadline is not None and time.perf_counter() > self._deadline:
                break
            before = descent.energies[-1]
            lower = self._lower(descent, sharpness)
            descent.converged = lower is None or lower > (1 - rest) * before
            if lower is not None:
                descent.energies.append(lower)
        return descent

    def _lower(self, descent: _Descent, sharpness: float) -> float | None:
        """Take a step that lowers the energy, and return that; None where rounding leaves none."""
        for tolerance, part in ((_LOOSE, _BEYOND), (_TIGHT, 1.0)):
            self._solver.rebuild(self._bound.link(descent.relief))
            stepped = self._solve(descent.relief, tolerance, part)
            energy = self._bound.share(sharpness, stepped)
            if energy < descent.energies[-1]:
                descent.relief = stepped
                return energy
            self._bound.share(sharpness, descent.relief)
        return None

    def _solve(self, relief: Array, tolerance: float, part: float = 1.0) -> Array:
        """Return a relief that goes so much of the way to that which solves the last graph, about."""
        return self._bound.step(relief, self._solver.solve(tolerance=tolerance).height, part)

    def conclude(self, best: _Descent, sharpness: float, tolerance: float, steps: int) -> Robust:
        """Solve the last graph to the tolerance, and return what was found."""
        bound, relief = self._bound, best.relief
        bound.share(0.0, relief)
        full = bound.weights(relief)
        bound.share(sharpness, relief)
        wanted, rest = (self._norm(bound.link(one)) for one in (self._zero, relief))
        residual, met = rest / wanted if wanted else 0.0, best.converged
        self._solver.rebuild(bound.link(relief))
        last = self._solver.solve(tolerance=min(1.0, tolerance / residual) if residual else 1.0)
        solved = bound.step(relief, last.height)
        weights = bound.weights(solved)
        energy = bound.share(sharpness, solved)
        if energy < best.energies[-1]:
            best.energies.append(energy)
            # The solver's own residual: that of float32 heights has a floor of their rounding.
            relief, residual, met = solved, residual * last.residual, met and last.converged
        flags, edges = _cut(bound.flags, weights, full)
        return Robust(
            relief=relief,
            links=bound.last,
            flags=flags,
            edges=edges,
            energies=tuple(best.energies),
            iterations=steps + 1,
            residual=residual,
            converged=met,
        )

    def _norm(self, links: Links) -> float:
        """Return the norm of the right side."""
        values = links.source.download().astype(np.float64)
        norm = float(np.sqrt(np.sum(values * values)))
        links.source.upload()
        return norm


def _cut(flags: Flags, weights: _Weights, full: _Weights) -> tuple[Flags, Flags]:
    """Return flags without the links that have no weight, and pixels beside those that have nearly none."""
    flags, edges = flags.copy(), np.zeros_like(flags)
    for bit, axis, weight, uncut in zip((RIGHT, DOWN), (1, 0), weights, full, strict=True):
        broken = weight < BROKEN * uncut
        edges |= broken | np.roll(broken, 1, axis)
        flags[weight == 0] &= np.uint8(~bit & 255)
    return flags, edges


class _Bound:
    """The energy of a relief, and the least squares that bound it, on the links' device."""

    def __init__(self, inputs: Inputs, links: Links, flags: Flags, plane: Plane) -> None:
        self.flags = flags
        self._device, self._shape = links.device, links.shape
        self._size = dict(zip(("width", "height"), inputs.pixel_size, strict=True))
        self._unit = inputs.typical_weight
        self._maps = {"flags": self._device.given("flags", flags, np.uint8), **self._slopes(inputs, plane)}
        self._confidence = self._find_confidence(inputs)
        self._anchor = links.anchor
        self._known = self._find_known(inputs, plane)
        names = "share_x", "share_y", "right", "down", "pull_x", "pull_y", "source"
        rooms = {name: self._room(name) for name in names}
        self._source = rooms.pop("source")
        self._shares = {name: rooms.pop(name) for name in ("share_x", "share_y")}
        self._links = rooms
        rows, columns = self._shape
        self._items = rows * -(-columns // min(self._device.layout.tile, 256))
        self._sums = self._room("sums", (self._items,))

    def given(self, name: str, values: NDArray[np.floating[Any]]) -> Array:
        """Return an array that holds values."""
        return self._device.given(name, values)

    def share(self, sharpness: float, relief: Array) -> float:
        """Divide the pixels' weights between their links; return the energy."""
        terms = {**self._maps, **self._confidence, **self._known, **self._size, **self._shares}
        self._run("shares", **terms, heights=relief, k=sharpness, sums=self._sums)
        energy = float(self._sums.download().sum(dtype=np.float64))
        self._sums.upload()
        return self._unit * energy

    def link(self, relief: Array, curl: Array | None = None, level: float = 0.0) -> Links:
        """Return the graph that the shares make, for a step from a relief; it may open at curl."""
        terms = {**self._maps, **self._confidence, **self._shares, **self._size}
        self._run("links", **terms, heights=relief, **self._links)
        if curl is not None:
            self._run("open", curl=curl, level=level, **self._links)
        known = {**self._known, "anchor": self._anchor, "heights": relief} if self._known else {}
        pulls = {name: self._links[name] for name in ("pull_x", "pull_y")}
        self._run("residual", **pulls, **known, residual=self._source)
        return self.last

    @property
    def last(self) -> Links:
        """The last graph, for the step from the relief on that it was made for."""
        right, down = self._links["right"], self._links["down"]
        return Links(self._device, self._shape, right, down, self._anchor, self._source)

    def weights(self, relief: Array) -> _Weights:
        """Return weights of the links to the right and down, as the shares are."""
        last = self.link(relief)
        found = last.right.download().copy(), last.down.download().copy()
        last.right.upload()
        last.down.upload()
        return found

    def curl(self) -> Array:
        """Return the curl of the slopes: what does not add up round four pixels."""
        found = self._room("curl")
        width, height = np.float32(self._size["width"]), np.float32(self._size["height"])
        mean = np.sqrt(width * height)
        maps = {name: self._maps[name] for name in ("flags", "slope_x", "slope_y")}
        self._run("curl", **maps, width=width / mean, height=height / mean, curl=found)
        return found

    def step(self, relief: Array, change: Array, part: float = 1.0) -> Array:
        """Return a relief changed by so much of a change."""
        found = self._room("relief")
        self._run("step", heights=relief, step=change, part=part, stepped=found)
        return found

    def _room(self, name: str, shape: tuple[int, ...] | None = None) -> Array:
        array = self._device.array(name, shape or self._shape, np.float32)
        array.upload()
        return array

    def _run(self, name: str, **arguments: Any) -> None:
        items = -(-self.flags.size // self._device.layout.tile) if name == "step" else self._items
        rows, columns = self._shape
        moved = sum(one.host.nbytes for one in arguments.values() if isinstance(one, Array))
        kernel = self._device.kernel("bilateral", f"bilateral_{name}", KNOWN=int(bool(self._known)))
        kernel(items, rows=rows, columns=columns, **arguments, moved=moved)

    def _slopes(self, inputs: Inputs, plane: Plane) -> dict[str, Array]:
        """Return slopes relative to the plane, to the right and down, and the squared z of the normals."""
        x, y = inputs.dz_dx, inputs.dz_dy
        good = np.isfinite(x) & np.isfinite(y)
        x, y = np.where(good, x, np.float32(0)), np.where(good, y, np.float32(0))
        steep = (
            1 / (1 + x * x + y * y) if inputs.steep is None else np.where(good, inputs.steep, np.float32(0))
        )
        return {
            "slope_x": self._device.given("slope x", x - np.float32(plane[0])),
            "slope_y": self._device.given("slope y", np.float32(plane[1]) - y),
            "steep": self._device.given("steep", steep),
        }

    def _find_confidence(self, inputs: Inputs) -> dict[str, Array]:
        """Return inverse variances along x and y, relative to the typical one."""
        factor = inputs.weight / inputs.typical_weight
        one = np.ones(self._shape, np.float32) if inputs.weight_x is None else inputs.weight_x
        first = second = self._device.given("weight x", factor * one)
        if inputs.weight_y is not None:
            second = self._device.given("weight y", factor * inputs.weight_y)
        return {"confidence_x": first, "confidence_y": second}

    def _find_known(self, inputs: Inputs, plane: Plane) -> dict[str, Array]:
        """Return known heights, and their weights relative to the typical one; nothing without any."""
        if inputs.known_heights is None or self._anchor is None:
            return {}
        row, column = np.indices(self._shape, np.float32)
        rise, fall = plane[0] * inputs.pixel_size[0], plane[1] * inputs.pixel_size[1]
        relief = inputs.known_heights - (plane[2] + rise * column - fall * row)
        weight = self._anchor.download() / np.float32(inputs.pixel_size[0] * inputs.pixel_size[1])
        self._anchor.upload()
        known = np.where(weight > 0, relief, 0)
        return {"anchor": self._device.given("held", weight), "known": self._device.given("known", known)}
