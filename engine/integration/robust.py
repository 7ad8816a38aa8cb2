"""Heights of a surface that breaks where nobody says: links are trusted by what normals tell, and let go."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.graph import Links, Plane
from mirrorskin.engine.integration.multigrid import Multigrid, Solution
from mirrorskin.engine.integration.validation import Flags, Inputs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.breaks import DOWN, RIGHT

_BROKEN = 6.0
"""Of k r^2 (see ``mirrorskin.kernels.breaks``) above which a link leads across a discontinuity."""

_SCALES = 32.0, 16.0, 8.0, 4.0, 2.0, 1.0  # over the root of 2 k: by what a link may miss its slope
_MOST, _REST = 4, 0.02  # steps at a scale, and by what part of the broken links they must lower these
_LOOSE = 0.001  # residual of a step's equations
_CYCLES = 10  # of a step, at most
_GONE = (
    1e4  # of k r^2, above which a link is cut for a step: what hangs by links of no weight cannot be solved
)
_AGAIN = 3  # more solutions in the end, at most
_NOISE = 0.03  # of slopes, at least
_CLEAR = 3.0  # standard deviations of the curl's noise that do not tell of a tear
_SLACK = 0.25  # of the difference of slopes, by which a link may miss for nothing: a crease may lie anywhere
_LEAST = 1e-5  # of a link's weight, that trust leaves it
_SAMPLES = 1 << 16  # of the curl, that tell of its noise
_LOCAL, _WIDE = (1, 0.5, 2.0), (5, 0.1, 2.0)  # of two searches: reach of the curl's sums; bend, tear


@dataclass(frozen=True, slots=True)
class Robust:
    """Heights of a surface that may break, and where it does."""

    relief: Array  # (H, W), float32: heights above the plane, mm; meaningless where there is no pixel
    links: Links  # the graph that they solve, with the final weights
    flags: Flags  # (H, W), uint8: those given, without links that are broken
    edges: Flags  # (H, W), uint8: 1 on either side of a discontinuity
    iterations: int  # solutions in all
    residual: float  # of the last one
    converged: bool  # whether all steps were done, and the last one within the tolerance


def solve_robust(
    inputs: Inputs,
    links: Links,
    flags: Flags,
    plane: Plane,
    sharpness: float,
    *,
    start: NDArray[np.floating[Any]] | None = None,
    tolerance: float = 1e-5,
    deadline: float | None = None,
) -> Robust:
    """Find heights that fit slopes and known heights, and the discontinuities between them.

    A link is trusted less where the surface is seen from aside, where it bends, and where slopes contradict
    each other (see ``mirrorskin.kernels.breaks``). Least squares of the links so weighted come first; then
    links that miss their slopes lose weight, step by step by smaller misses. At last those are cut that miss
    theirs by more than 2.4 over the root of 2 k, and the rest is solved to the tolerance. There are two
    searches, with contradictions counted where they are and over 11 x 11 corners; the heights that
    break fewer links are taken.

    - What is cut off all round keeps its shape, and is a component with an unknown offset unless a height in
      it is known. As long as no slope contradicts, it is not cut off at all: a ball on a plane stays on it.
    - The place of a break is determined where its height changes along it; elsewhere it takes the way of the
      normals that differ most.
    - A step lower than about one pixel (at k = 2) is taken for a bend.

    ``links`` are of heights above the plane; only these can be cut. ``sharpness`` is k, 1/pixel^2. From a
    ``start``, heights above the plane, only the last scale is used. After the ``deadline``, of
    ``time.perf_counter``, no step is begun but the last solution's first cycle.
    """
    search = _Search(inputs, links, flags, plane, sharpness, deadline)
    search.trust(*_LOCAL)
    if start is not None:
        given = np.where(np.isfinite(start), start, 0.0)
        return search.conclude(search.descend(links.device.given("start", given)), flags, tolerance)
    best = search.descend()
    if search.contradicted and not search.late():
        known, broken = np.array(best.download()), search.link(best)
        best.upload()
        search.trust(*_WIDE)
        best = search.descend()
        search.trust(*_LOCAL)
        best = search.descend(best)
        if search.link(best) >= broken:
            best = links.device.given("first", known)
    return search.conclude(best, flags, tolerance)


class _Search:
    """Steps towards heights that break few links, on the links' device."""

    def __init__(
        self,
        inputs: Inputs,
        links: Links,
        flags: Flags,
        plane: Plane,
        sharpness: float,
        deadline: float | None,
    ) -> None:
        self._links, self._shape, self._given = links, links.shape, links.device.given
        self._sharpness, self._deadline, self._steps = 2 * sharpness, deadline, 0
        self._size = dict(zip(("width", "height"), inputs.pixel_size, strict=True))
        rows, columns = links.shape
        self._items = rows * -(-columns // min(links.device.layout.tile, 256))
        names = "tears", "weight_x", "weight_y", "rise_x", "rise_y", "right", "down", "source"
        self._room = {name: self._array(name, links.shape) for name in names}
        self._sums = self._array("sums", (self._items,))
        self._slopes, self._facing = self._find_slopes(inputs, plane)
        self._held = self._find_held(inputs, plane)
        self._curl, self._noise = self._find_curl(flags)
        self._solver: Multigrid | None = None

    def late(self) -> bool:
        """Tell whether the deadline is over."""
        return self._deadline is not None and time.perf_counter() > self._deadline

    def trust(self, reach: int, bend: float, tear: float) -> None:
        """Weigh links by what is known of them before any heights."""
        room, noise = self._room, max(_NOISE, self._noise / math.sqrt(2))
        sums = self._curl
        for downwards, name in enumerate(("rise_x", "rise_y")):
            self._run("sum", values=sums, reach=reach, downwards=downwards, sums=room[name])
            sums = room[name]
        known = {"reach": reach, "noise": _CLEAR * self._noise, "wide": int(reach > 1)}
        self._run("spread", curl=self._curl, sums=sums, **known, tears=room["tears"])
        found = {name: room[name] for name in ("tears", "weight_x", "weight_y", "rise_x", "rise_y")}
        numbers = {"noise": noise**2, "bend": bend, "tear": tear, "least": _LEAST}
        links = {"right": self._links.right, "down": self._links.down, **self._slopes}
        self._run("trust", **links, facing=self._facing, **numbers, **found)

    def descend(self, heights: Array | None = None) -> Array:
        """Solve for heights again and again, by the links that the last ones keep at each scale.

        From given heights on, it begins with the last scales.
        """
        scales: tuple[float, ...] = _SCALES[3:]
        if heights is None:
            heights, scales = self._solve(self._held, _LOOSE, math.inf).height, _SCALES
        for scale in scales:
            broken = math.inf
            for _ in range(_MOST):
                if self.late():
                    return heights
                before, broken = broken, self.link(heights, scale)
                if broken > (1 - _REST) * before:
                    break
                heights = self._solve(heights, _LOOSE, scale).height
        return heights

    def link(self, heights: Array, scale: float = 1.0, most: float = math.inf) -> float:
        """Make the links that heights keep; return how many are broken."""
        names = "weight_x", "weight_y", "rise_x", "rise_y", "right", "down", "source"
        room = {name: self._room[name] for name in names}
        numbers = {"sharpness": self._sharpness / scale**2, "most": min(most, _GONE), "slack": _SLACK}
        maps = {**room, **self._slopes, "held": self._held, "heights": heights, "sums": self._sums}
        self._run("links", **maps, **self._size, **numbers)
        broken = float(self._sums.download().sum(dtype=np.float64))
        self._sums.upload()
        return broken

    def _solve(self, heights: Array, tolerance: float, scale: float, most: float = math.inf) -> Solution:
        self.link(heights, scale, most)
        right, down, source = (self._room[name] for name in ("right", "down", "source"))
        links = Links(self._links.device, self._shape, right, down, self._links.anchor, source)
        if self._solver is None:
            self._solver = Multigrid(links)
        else:
            self._solver.rebuild(links)
        self._steps += 1
        self.last = links
        start = None if scale == math.inf else heights
        limit = _CYCLES if tolerance == _LOOSE else 100
        return self._solver.solve(start, tolerance=tolerance, limit=limit, deadline=self._deadline)

    def conclude(self, heights: Array, flags: Flags, tolerance: float) -> Robust:
        """Cut what is broken, solve the rest to the tolerance, and return what was found."""
        done = not self.late()
        last = self._solve(heights, tolerance, 1.0, _BROKEN)
        for _ in range(
            _AGAIN
        ):  # from new residuals on, where rounding of steps ends the descent of weak links
            if last.converged or self.late():
                break
            assert self._solver is not None
            last = self._solver.solve(last.height, tolerance=tolerance, deadline=self._deadline)
        flags, edges = flags.copy(), np.zeros_like(flags)
        for bit, axis, link in ((RIGHT, 1, self.last.right), (DOWN, 0, self.last.down)):
            broken = (flags & bit != 0) & (link.download() == 0)
            link.upload()
            flags[broken] &= np.uint8(~bit & 255)
            edges |= broken | np.roll(broken, 1, axis)
        return Robust(
            relief=last.height,
            links=self.last,
            flags=flags,
            edges=edges,
            iterations=self._steps,
            residual=last.residual,
            converged=done and last.converged,
        )

    def _find_slopes(self, inputs: Inputs, plane: Plane) -> tuple[dict[str, Array], Array]:
        """Return slopes relative to the plane, to the right and down, and the normals' cosines."""
        x, y = inputs.dz_dx, inputs.dz_dy
        good = np.isfinite(x) & np.isfinite(y)
        x, y = np.where(good, x, np.float32(0)), np.where(good, y, np.float32(0))
        steep = 1 / (1 + x * x + y * y) if inputs.steep is None else inputs.steep
        slopes = {"slope_x": x - np.float32(plane[0]), "slope_y": np.float32(plane[1]) - y}
        maps = {name: self._given(name, one) for name, one in slopes.items()}
        return maps, self._given("cosine", np.sqrt(steep))

    def _find_held(self, inputs: Inputs, plane: Plane) -> Array:
        """Return the right side of known heights: weights times their heights above the plane."""
        anchor = self._links.anchor
        if inputs.known_heights is None or anchor is None:
            return self._given("held", np.zeros(self._shape))
        row, column = np.ogrid[: self._shape[0], : self._shape[1]]
        rise, fall = plane[0] * inputs.pixel_size[0], plane[1] * inputs.pixel_size[1]
        weight = anchor.download()
        above = inputs.known_heights - (plane[2] + rise * column - fall * row)
        held = np.where(weight > 0, weight * above, 0)
        anchor.upload()
        return self._given("held", held)

    def _find_curl(self, flags: Flags) -> tuple[Array, float]:
        """Return the curl of the slopes, and the standard deviation of its noise."""
        curl, mean = self._array("curl", self._shape), math.sqrt(math.prod(self._size.values()))
        size = {name: one / mean for name, one in self._size.items()}
        self._run("curl", flags=self._given("flags", flags, np.uint8), **self._slopes, **size, curl=curl)
        sizes = np.abs(curl.download())
        curl.upload()
        most, step = float(sizes.max()), max(1, sizes.size // _SAMPLES)
        some = sizes.ravel()[::step][(flags & (RIGHT | DOWN) == RIGHT | DOWN).ravel()[::step]]
        noise = float(np.median(some)) / 0.6745 if some.size else 0.0  # of a normal distribution
        self.contradicted = most > _CLEAR * noise
        return curl, noise

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        array = self._links.device.array(name, shape, np.float32)
        array.upload()
        return array

    def _run(self, name: str, **arguments: Any) -> None:
        rows, columns = self._shape
        moved = sum(one.host.nbytes for one in arguments.values() if isinstance(one, Array))
        kernel = self._links.device.kernel("breaks", f"breaks_{name}")
        kernel(self._items, rows=rows, columns=columns, **arguments, moved=moved)
