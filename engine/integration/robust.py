"""Integration of a discontinuous surface: links get a confidence from the normals, and are cut at misfits."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.graph import Components, Links, Plane
from mirrorskin.engine.integration.multigrid import Multigrid, Solution
from mirrorskin.engine.integration.parts import (
    find_doubt,
    find_parts,
    find_ties,
    join_fragments,
    largest_within,
    place_parts,
)
from mirrorskin.engine.integration.validation import Flags, Floats, Inputs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.integration.breaks import DOWN, RIGHT
from mirrorskin.kernels.integration.slopes import sum_around
from mirrorskin.kernels.numerics.least_squares import mad_sigma

_BROKEN = 6.0
"""k r^2 (see ``mirrorskin.kernels.integration.breaks``) above which a link crosses a discontinuity."""

_SCALES = 16.0, 8.0, 4.0, 2.0, 1.0  # tolerated misfits of a link, in 1 / sqrt(2 k)
_STEPS = 3  # at a scale
_LOOSE, _CYCLES = 0.001, 10  # residual and maximum number of cycles of the first solution of a search

_MAX_SQUARE = 1e4  # k r^2 above which a link is cut for a step, because tiny weights cannot be solved
_ROUNDED = 1e-4  # residual that rounding may leave where weights differ by orders of magnitude
_AGAIN = 3  # largest number of additional solutions at the end
_MIN_NOISE = 0.03  # smallest standard deviation of slopes
_CLEAR_Z_SCORE = 3.0  # standard deviations of the curl's noise up to which there is no contradiction
_SLACK = 0.25  # share of the difference of slopes that is no misfit: a crease may be anywhere between pixels
_MIN_TRUST = 1e-5  # smallest confidence, relative to a link's weight
_SAMPLES = 1 << 16  # pixels from which the curl's noise is estimated
_LOCAL, _WIDE = (1, 0.5, 2.0), (5, 0.1, 2.0)  # searches: reach of the curl's sums; factors of bend and tear


@dataclass(frozen=True, slots=True)
class Robust:
    """Heights of a surface, and its discontinuities."""

    relief: Array  # (H, W), float32: heights above the plane, mm; arbitrary without an answer
    links: Links  # the graph with the final weights, within parts
    flags: Flags  # (H, W), uint8: the flags without broken links, and without links between parts
    edges: Flags  # (H, W), uint8: 1 on both sides of a discontinuity
    doubt: Floats  # (H, W): variance of heights about the mean of their component because of breaks, mm^2
    iterations: int  # number of solutions and steps
    residual: float  # of the last solution
    converged: bool  # whether all steps were done, and the last residual is within tolerance or rounding


def solve_robust(
    inputs: Inputs,
    links: Links,
    flags: Flags,
    plane: Plane,
    sharpness: float,
    *,
    plain: Floats,
    components: Components,
    solver: Multigrid,
    start: NDArray[np.floating[Any]] | None = None,
    tolerance: float = 1e-5,
    deadline: float | None = None,
) -> Robust:
    """Find heights that fit slopes and known heights, and the discontinuities between them.

    The initial confidence of a link is lower where the surface is seen obliquely, where it bends, and where
    slopes contradict each other (curl; see ``kernels/integration/breaks.py``). The first heights are weighted
    least squares. Then links with a misfit lose weight, at smaller and smaller scales. Finally links with a
    misfit above 2.4 / sqrt(2 k) are cut, and the rest is solved to the tolerance. There are two searches,
    with contradictions counted locally and over 11 x 11 corners; the heights that break fewer links win.

    - A part of the surface that few confident links hold is a component of its own, with an unknown offset
      unless it has a known height. It is as high as these links and ``plain``, the heights of least squares
      without a search, say together (``mirrorskin.engine.integration.parts``).
    - The position of a discontinuity is determined where its height changes along it; elsewhere it follows
      the largest differences between normals.
    - A step lower than about one pixel (at k = 2) counts as a bend.

    Only ``links``, of heights above the plane, can be cut. They connect the ``components``. ``sharpness`` is
    k, 1/pixel^2. With a ``start``, heights above the plane, only the last scales are used. After the
    ``deadline``, a ``time.perf_counter``, only the first cycle of the last solution is started. The memory of
    the ``solver`` is used.
    """
    search = _Search(inputs, links, flags, plane, sharpness, solver, deadline)
    search.trust(*_LOCAL)
    if start is not None:
        first = links.device.from_host("start", np.where(np.isfinite(start), start, 0.0))
        return search.conclude(search.descend(first), flags, tolerance, plain, components)
    best = search.descend()
    if search.contradicted and not search.late():
        local, broken = best.read(), search.broken(best)
        search.trust(*_WIDE)
        best = search.descend()
        search.trust(*_LOCAL)
        best = search.descend(best)
        if search.broken(best) >= broken:
            best = links.device.from_host("first", local)
    return search.conclude(best, flags, tolerance, plain, components)


class _Search:
    """Steps towards heights that break few links."""

    def __init__(
        self,
        inputs: Inputs,
        links: Links,
        flags: Flags,
        plane: Plane,
        sharpness: float,
        solver: Multigrid,
        deadline: float | None,
    ) -> None:
        self._links, self._shape, self._given = links, links.shape, links.device.from_host
        self._sharpness, self._deadline, self._steps = 2 * sharpness, deadline, 0
        self._size = dict(zip(("width", "height"), inputs.pixel_size, strict=True))
        rows, columns = links.shape
        self._items = rows * -(-columns // min(links.device.layout.tile, 256))
        names = "tears", "weight_x", "weight_y", "rise_x", "rise_y", "right", "down", "source"
        self._maps = {name: self._array(name, links.shape) for name in names}
        layout = links.device.layout
        self._group = layout.group if layout.tile == 1 else 1
        self._sums = self._array("sums", (-(-self._items // self._group),))
        self._slopes, self._facing = self._find_slopes(inputs, plane)
        self._held = self._find_held(inputs, plane)
        self._curl, self._noise = self._find_curl(flags)
        self._solver = solver

    def late(self) -> bool:
        """Return whether the deadline has passed."""
        return self._deadline is not None and time.perf_counter() > self._deadline

    def trust(self, reach: int, bend: float, tear: float) -> None:
        """Compute the initial confidence of the links, which does not depend on heights."""
        maps, noise = self._maps, max(_MIN_NOISE, self._noise / math.sqrt(2))
        sums = self._curl
        for downwards, name in enumerate(("rise_x", "rise_y")):
            self._run("sum", values=sums, reach=reach, downwards=downwards, sums=maps[name])
            sums = maps[name]
        limits = {"reach": reach, "noise": _CLEAR_Z_SCORE * self._noise, "wide": int(reach > 1)}
        self._run("spread", curl=self._curl, sums=sums, **limits, tears=maps["tears"])
        outputs = {name: maps[name] for name in ("tears", "weight_x", "weight_y", "rise_x", "rise_y")}
        numbers = {"noise": noise**2, "bend": bend, "tear": tear, "min_trust": _MIN_TRUST}
        links = {"right": self._links.right, "down": self._links.down, **self._slopes}
        self._run("trust", **links, facing=self._facing, **numbers, **outputs)

    def descend(self, heights: Array | None = None) -> Array:
        """Return heights from iteratively reweighted least squares at decreasing scales.

        From given heights, only the last scales are used.
        """
        scales: tuple[float, ...] = _SCALES[3:]
        if heights is None:
            self.link(self._held, math.inf)
            heights, scales = self._solve(None, tolerance=_LOOSE, limit=_CYCLES).height, _SCALES
        start: Array | None = heights
        for scale in scales:
            for step in range(_STEPS):
                if self.late():
                    return heights
                self.link(heights, scale)
                links = self._current()
                if step == 0:
                    self._solver.rebuild(links)
                heights, start = (
                    self._solver.follow(links, deep=False, start=start, anew=start is not None),
                    None,
                )
        return heights

    def link(self, heights: Array, scale: float = 1.0, cap: float = math.inf) -> None:
        """Compute the weights of links from the misfit of heights."""
        names = "weight_x", "weight_y", "rise_x", "rise_y", "right", "down", "source"
        numbers = {
            "sharpness": self._sharpness / scale**2,
            "max_square": min(cap, _MAX_SQUARE),
            "slack": _SLACK,
        }
        maps = {**{name: self._maps[name] for name in names}, **self._slopes}
        maps |= {"held": self._held, "heights": heights, "sums": self._sums}
        self._run("links", **maps, **self._size, **numbers)

    def broken(self, heights: Array) -> float:
        """Return the number of links that heights break."""
        self.link(heights)
        return float(self._sums.read().sum(dtype=np.float64))

    def _current(self) -> Links:
        """Return the graph with the weights of the last `link`."""
        right, down, source = (self._maps[name] for name in ("right", "down", "source"))
        self._steps += 1
        self.last = Links(self._links.device, self._shape, right, down, self._links.anchor, source)
        return self.last

    def _solve(self, start: Array | None, **goal: Any) -> Solution:
        """Solve for the weights of the last `link`."""
        self._solver.rebuild(self._current())
        return self._solver.solve(start, deadline=self._deadline, **goal)

    def conclude(
        self, heights: Array, flags: Flags, tolerance: float, plain: Floats, components: Components
    ) -> Robust:
        """Cut broken links, solve the rest to the tolerance, place the parts, and return the surface."""
        complete = not self.late()
        self.link(heights)
        right, down = self._confidence()
        self.link(heights, cap=_BROKEN)
        last = self._solve(heights, tolerance=tolerance)
        for _ in range(_AGAIN):  # a restart recomputes the residual, whose rounding errors stop the iteration
            if last.converged or self.late():
                break
            last = self._solver.solve(last.height, tolerance=tolerance, deadline=self._deadline)
        answered = components.labels >= 0
        parts, relief = find_parts(right, down, answered), last.height.read()
        anchor_weight = np.zeros_like(relief) if self._links.anchor is None else self._links.anchor.read()
        ties = find_ties(parts, right, down)
        lifts = place_parts(parts, ties, plain - relief, components, anchor_weight)
        joined = join_fragments(parts, ties)
        largest = largest_within(parts, joined)
        relief += np.where(answered, lifts[largest], 0)
        doubt = find_doubt(plain - relief, joined)
        flags, edges = flags.copy(), np.zeros_like(flags)
        for bit, axis, link in ((RIGHT, 1, self.last.right), (DOWN, 0, self.last.down)):
            weight = link.read()
            broken = (flags & bit != 0) & (weight == 0)
            edges |= broken | np.roll(broken, 1, axis)
            broken |= (flags & bit != 0) & (joined != np.roll(joined, -1, axis))
            flags[broken] &= np.uint8(~bit & 255)
            link.write(np.where(broken, np.float32(0), weight))
        return Robust(
            relief=self._given("relief", relief),
            links=self.last,
            flags=flags,
            edges=edges,
            doubt=doubt,
            iterations=self._steps,
            residual=last.residual,
            converged=complete and (last.converged or last.residual <= _ROUNDED),
        )

    def _confidence(self) -> tuple[Floats, Floats]:
        """Return the confidences of the links to the right and down after the last `link`.

        With the weight w of a link, its trusted weight t, and the weight u of its misfit as well, it is
        u / w (t / w)^1/2: the misfit has to be small, and the slope well known in addition.
        """
        confidences = []
        maps = ("right", "weight_x", self._links.right), ("down", "weight_y", self._links.down)
        for link, trusted, full in maps:
            weight = full.read()
            with np.errstate(invalid="ignore", divide="ignore"):
                trust = np.sqrt(self._maps[trusted].read() / weight)
                confidence = self._maps[link].read() / weight * trust
            confidences.append(np.where(weight > 0, confidence, np.float32(0)))
        return confidences[0], confidences[1]

    def _find_slopes(self, inputs: Inputs, plane: Plane) -> tuple[dict[str, Array], Array]:
        """Return slopes relative to the plane, to the right and down, and the normals' cosines.

        The variance 1 / cosine^2 is a mean over 5 x 5 pixels: confidences that depended on the noise of the
        pixel itself would flatten noisy slopes.
        """
        x, y = inputs.dz_dx, inputs.dz_dy
        defined = np.isfinite(x) & np.isfinite(y)
        x, y = np.where(defined, x, np.float32(0)), np.where(defined, y, np.float32(0))
        steep = 1 / (1 + x * x + y * y) if inputs.steep is None else inputs.steep
        slopes = {"slope_x": x - np.float32(plane[0]), "slope_y": np.float32(plane[1]) - y}
        maps = {name: self._given(name, slope) for name, slope in slopes.items()}
        wanted = defined if inputs.mask is None else defined & (inputs.mask != 0)
        slant = sum_around(np.where(wanted, 1 / steep, 0).astype(np.float32))
        count = sum_around(wanted.astype(np.float32))
        return maps, self._given("cosine", np.sqrt(np.where(wanted, count / np.maximum(slant, 1), 1)))

    def _find_held(self, inputs: Inputs, plane: Plane) -> Array:
        """Return the right side of known heights: weight times height above the plane."""
        anchor = self._links.anchor
        if inputs.known_heights is None or anchor is None:
            return self._given("held", np.zeros(self._shape))
        row, column = np.ogrid[: self._shape[0], : self._shape[1]]
        rise, fall = plane[0] * inputs.pixel_size[0], plane[1] * inputs.pixel_size[1]
        weight = anchor.read()
        above = inputs.known_heights - (plane[2] + rise * column - fall * row)
        return self._given("held", np.where(weight > 0, weight * above, 0))

    def _find_curl(self, flags: Flags) -> tuple[Array, float]:
        """Return the curl of the slopes, and the standard deviation of its noise."""
        curl, mean = self._array("curl", self._shape), math.sqrt(math.prod(self._size.values()))
        size = {name: length / mean for name, length in self._size.items()}
        self._run("curl", flags=self._given("flags", flags, np.uint8), **self._slopes, **size, curl=curl)
        sizes = np.abs(curl.read())
        largest, step = float(sizes.max()), max(1, sizes.size // _SAMPLES)
        samples = sizes.ravel()[::step][(flags & (RIGHT | DOWN) == RIGHT | DOWN).ravel()[::step]]
        noise = mad_sigma(samples)
        self.contradicted = largest > _CLEAR_Z_SCORE * noise
        return curl, noise

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        return self._links.device.array(name, shape, np.float32)

    def _run(self, name: str, **arguments: Any) -> None:
        rows, columns = self._shape
        moved = sum(value.nbytes for value in arguments.values() if isinstance(value, Array))
        macros = {"GROUP": self._group} if name == "links" else {}
        kernel = self._links.device.kernel("breaks", f"breaks_{name}", **macros)
        kernel(self._items, rows=rows, columns=columns, **arguments, moved=moved)
