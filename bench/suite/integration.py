"""Heights from slopes: the engine, the limits, SciPy and OpenCV on a full picture, pyamg within a mask.

Targets, from slopes to heights: five times as fast as SciPy's cosine transforms on a full picture; 100 times
as fast as pyamg (Ruge-Stuben, conjugate gradients) within a mask for the same error, 50 times with cuts; a
live frame of 640 x 480 in 4 ms; sixteen surfaces at once in six times the time of one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine
from mirrorskin.bench.suite.harness import Cases, agree, call_targets, check_memory, missing, ratio_target
from mirrorskin.cli.commands.bench.limits import time_works
from mirrorskin.cli.commands.bench.records import THREADS, Case, Row, Target
from mirrorskin.cli.commands.bench.timing import FIRST, OURS, Work
from mirrorskin.engine import Integrator
from mirrorskin.evaluation.scenes.inputs import (
    PIXEL,
    Shape,
    blob_mask,
    drifting_slopes,
    noisy_slopes,
    random_cuts,
)
from mirrorskin.kernels.device import Device

Floats = NDArray[Any]  # float32, or float64 for exact results
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Flags = NDArray[np.uint8]

SLOPES = "from slopes"  # without standard deviations, like the peers
PYAMG = "pyamg"
_SCIPY, _MASK, _CUTS = 5.0, 100.0, 50.0  # target speed relative to SciPy, and to pyamg
_FRAME = 4e-3  # limit for a live frame, seconds
_SIGMA = 2.5  # limit of a call with sigma, in times of a call without
_SIDES, _TOGETHER = 16, 6.0  # number of surfaces at once, and limit in times of a call for one

_MPIXEL, _LIVE, _QUICK = (1024, 1024), (480, 640), (48, 64)
_FULL, _MASKED = 2 * 4 + 4, 2 * 4 + 1 + 4  # bytes per pixel: slopes, mask and heights
_WORKING, _DIRECT = 400, 1200  # bytes per pixel: working memory of all works, and the direct solution
_FRAMES, _CHANGE = 16, 0.01  # number of live frames in a cycle, and relative change between frames
_NEAR = {"full": 1e-4, "mask": 1e-3, "live": 1e-2}  # tolerated differences of heights, shares of their range
_AROUND = ((0, 1), (0, -1), (1, 0), (-1, 0))  # right, left, below and above
_NEVER, _MOST = 1e-14, 40  # pyamg: tolerance that is never reached, and maximum number of iterations


def run_rectangle(name: str, shape: Shape, device: Device, quick: bool) -> Case:
    """Time heights of a full picture, the limits and the peers, after checking that heights agree."""
    shape = _QUICK if quick else shape
    moved = _FULL * math.prod(shape)
    check_memory(name, _WORKING * math.prod(shape))
    slopes = noisy_slopes(shape)
    exact = solve_with_scipy(link(slopes).source, divisors(shape, np.float64))
    works = _calls(slopes, None, None, moved, device)
    for peer, solve in (("SciPy", solve_with_scipy), ("OpenCV", _opencv)):
        works[f"{peer}, {SLOPES}"] = Work(partial(_transform, solve, slopes), moved)
    span, errors = float(np.ptp(exact)), {}

    def check(results: dict[str, Any]) -> None:
        for work in works:
            heights = results[work] - results[work].mean()
            agree(work, {"height": heights}, {"height": exact}, {"height": _NEAR["full"] * span})
            errors[work] = float(np.sqrt(np.mean(np.square(heights - exact)))) / span

    rows = time_works(works, moved, device, quick, check, first="triad")
    title = f"heights of a full picture; {' x '.join(map(str, shape))} float32"
    targets = () if quick else _targets(rows, f"SciPy, {SLOPES}", _SCIPY)
    return Case(name, title, list(rows.values()), {}, (_errors(errors),), targets)


def run_mask(name: str, cuts: int, device: Device, quick: bool) -> Case:
    """Time heights within a mask, with or without cuts, the limits, and pyamg to the same error."""
    shape = _QUICK if quick else _MPIXEL
    check_memory(name, (_WORKING + _DIRECT) * math.prod(shape))
    slopes, mask, edges = noisy_slopes(shape), blob_mask(shape), random_cuts(shape, cuts) if cuts else None
    truth = find_truth(slopes, mask, edges)
    moved = (_MASKED + bool(cuts)) * math.prod(shape)
    works, absent, notes = _calls(slopes, mask, edges, moved, device), missing(PYAMG), []
    if not absent:
        error = truth.error(np.asarray(works[f"{OURS}, {SLOPES}"].call()))
        theirs, count = _pyamg_works(slopes, mask, edges, truth, error)
        works[f"{PYAMG}, {SLOPES}"] = Work(theirs[SLOPES], moved)
        notes = [
            f"{PYAMG} does {count} iterations, the fewest that leave no larger an error than {error:.1e}"
        ]
    errors = {}

    def check(results: dict[str, Any]) -> None:
        for work in works:
            errors[work] = truth.error(results[work])
            truth.check(work, results[work], "mask")

    rows = time_works(works, moved, device, quick, check, first="triad")
    parts = f"{100 * np.mean(truth.wanted):.0f} % of {' x '.join(map(str, shape))} float32"
    title = f"heights of {parts}{f', {cuts} cuts' if cuts else ''}, in {truth.count} components"
    targets = () if quick else _targets(rows, f"{PYAMG}, {SLOPES}", _CUTS if cuts else _MASK)
    return Case(name, title, list(rows.values()), absent, (*notes, _errors(errors)), targets)


def run_frames(device: Device, quick: bool) -> Case:
    """Time live frames within a mask, from slopes to heights; each differs slightly from the preceding one.

    A round is a cycle of frames. The limits are for the bytes of one frame.
    """
    shape = _QUICK if quick else _LIVE
    mask, frames = blob_mask(shape), drifting_slopes(shape, _FRAMES, _CHANGE)
    truth, integrator = find_truth(frames[-1], mask, None), Integrator(shape, PIXEL, device=device)
    seconds: list[float] = []

    def circle() -> NDArray[np.float32]:
        for dz_dx, dz_dy in frames:
            start = time.perf_counter()
            integrator.push(dz_dx, dz_dy, mask=mask)
            height: NDArray[np.float32] = integrator.result().height
            seconds.append(time.perf_counter() - start)
        return height

    def check(results: dict[str, Any]) -> None:
        truth.check(OURS, results[OURS], "live")
        seconds.clear()  # removes the warm-up

    moved = _MASKED * math.prod(shape)
    works = {OURS: Work(circle, _FRAMES * moved, _FRAMES)}
    rows = time_works(works, moved, device, quick, check, first="triad")
    lower, middle, upper = 1e3 * np.percentile(seconds, [25, 50, 75])
    notes = (f"a frame: median {middle:.2f} ms, quartiles {lower:.2f}-{upper:.2f}",)
    title = f"live, warm; heights of {100 * np.mean(mask):.0f} % of {' x '.join(map(str, shape))} float32"
    bound = f"at most {1e3 * _FRAME:.0f} ms a frame"
    target = Target(OURS, bound, f"{middle:.2f} ms", bool(middle <= 1e3 * _FRAME))
    return Case("integrate-live", title, list(rows.values()), {}, notes, () if quick else (target,))


def run_many(device: Device, quick: bool) -> Case:
    """Time heights of many surfaces within one mask, and one of them alone, by the engine and by pyamg."""
    shape = _QUICK if quick else _MPIXEL
    pixels, alone = math.prod(shape), "one surface"
    check_memory("integrate-many", _SIDES * _WORKING * pixels)
    slopes, mask = np.stack([noisy_slopes(shape, k) for k in range(_SIDES)], axis=1), blob_mask(shape)
    truth = find_truth(slopes[:, -1], mask, None)

    def find(some: Floats) -> Floats:
        height: Floats = engine.integrate(some[0], some[1], PIXEL, mask=mask, device=device).height
        return height

    one_side, all_ = (count * _FULL * pixels + pixels for count in (1, _SIDES))
    works = {OURS: Work(partial(find, slopes), all_), alone: Work(partial(find, slopes[:, -1]), one_side)}
    absent, solve = missing(PYAMG), f"{PYAMG}, solve only"
    if not absent:
        error = truth.error(np.asarray(works[alone].call()))
        theirs, _ = _pyamg_works(slopes[:, -1], mask, None, truth, error)
        works |= {f"{PYAMG}, {part}": Work(call, one_side) for part, call in theirs.items()}

    def check(results: dict[str, Any]) -> None:
        truth.check(OURS, results[OURS][-1], "mask")
        truth.check(alone, results[alone], "mask")

    rows = time_works(works, all_, device, quick, check, first="triad")
    notes: tuple[str, ...] = ()
    if not absent:
        ours, whole, again = (rows[name].wall.median for name in (OURS, f"{PYAMG}, {SLOPES}", solve))
        ratio = (whole + (_SIDES - 1) * again) / ours
        notes = (f"{OURS} against {PYAMG} with one set-up for all surfaces: {ratio:.1f} times as fast",)
    part = f"{100 * np.mean(mask):.0f} % of {' x '.join(map(str, shape))} float32"
    target = ratio_target(OURS, _TOGETHER, rows[OURS], rows[alone], alone, faster=False)
    title = f"heights of {_SIDES} surfaces, {part}"
    return Case("integrate-many", title, list(rows.values()), absent, notes, () if quick else (target,))


CASES: Cases = {
    "integrate-rectangle": partial(run_rectangle, "integrate-rectangle", _MPIXEL),
    "integrate-rectangle-4k": partial(run_rectangle, "integrate-rectangle-4k", (2160, 3840)),
    "integrate-mask": partial(run_mask, "integrate-mask", 0),
    "integrate-cuts": partial(run_mask, "integrate-cuts", 50),
    "integrate-live": run_frames,
    "integrate-many": run_many,
}


def _calls(
    slopes: Floats, mask: Flags | None, edges: Flags | None, moved: int, device: Device
) -> dict[str, Work]:
    """Return calls of `integrate` with its defaults, which include sigma, and without sigma."""

    def call(sigma: bool) -> Floats:
        height: Floats = engine.integrate(
            slopes[0], slopes[1], PIXEL, mask=mask, edges=edges, sigma=sigma, device=device
        ).height
        return height

    default = partial(call, True)
    return {
        OURS: Work(default, moved),
        FIRST: Work(default, moved, before=engine.free_memory),
        f"{OURS}, {SLOPES}": Work(partial(call, False), moved),
    }


def _targets(rows: Mapping[str, Row], peer: str, faster: float) -> tuple[Target, ...]:
    """Return the targets of the whole call: relative to a peer, and for the overhead of sigma."""
    plain = rows[f"{OURS}, {SLOPES}"]
    sigma = ratio_target(OURS, _SIGMA, rows[OURS], plain, "without sigma", faster=False)
    return *call_targets(rows, {peer: faster}), sigma


def _errors(errors: Mapping[str, float]) -> str:
    parts = (f"{name} {error:.1e}" for name, error in errors.items())
    return f"root mean square error, in ranges of the heights: {'; '.join(parts)}"


def solve_with_scipy(source: Floats, inverse: Floats) -> Floats:
    """Solve with SciPy's cosine transforms on all cores, the second one in place."""
    from scipy.fft import dctn, idctn

    spectrum = dctn(source, workers=THREADS)
    spectrum *= inverse
    heights: Floats = idctn(spectrum, overwrite_x=True, workers=THREADS)
    return heights


def _opencv(source: Floats, inverse: Floats) -> Floats:
    """Solve with OpenCV's cosine transforms, for pictures of even sizes."""
    import cv2

    spectrum = cv2.dct(source)
    cv2.multiply(spectrum, inverse, dst=spectrum)
    return np.asarray(cv2.idct(spectrum, dst=spectrum))


def divisors(shape: Shape, dtype: type[np.floating[Any]]) -> Floats:
    """Return the inverse eigenvalues of the cosines of a rectangle, (H, W)."""
    down, across = (4 * np.square(np.sin(np.pi * np.arange(n) / (2 * n))).astype(dtype) for n in shape)
    values: Floats = np.add(down[:, np.newaxis], across)
    values[0, 0] = np.inf  # the mean
    np.divide(dtype(1), values, out=values)
    return values


def _transform(solve: Callable[[Floats, Floats], Floats], slopes: Floats) -> Floats:
    source = link(slopes).source.astype(np.float32)
    return solve(source, divisors((source.shape[0], source.shape[1]), np.float32))


def _pyamg_works(
    slopes: Floats, mask: Flags, edges: Flags | None, truth: Truth, error: float
) -> tuple[dict[str, Callable[[], object]], int]:
    """Return pyamg from slopes and its solution alone, with the fewest iterations that reach `error`."""
    pyamg = import_module(PYAMG)
    system = truth.system
    ready = pyamg.ruge_stuben_solver(system.matrix)
    count = 0

    def follow(values: Doubles) -> None:
        nonlocal count
        count += 1
        if truth.error(values) <= error:
            raise StopIteration

    with suppress(StopIteration):
        ready.solve(system.source, tol=_NEVER, maxiter=_MOST, accel="cg", callback=follow)

    def solve(hierarchy: Any, source: Doubles) -> Doubles:
        heights: Doubles = hierarchy.solve(source, tol=_NEVER, maxiter=count, accel="cg")
        return heights

    def whole() -> NDArray[np.float32]:
        equations = assemble(link(slopes, mask, edges))
        values = solve(pyamg.ruge_stuben_solver(equations.matrix), equations.source)
        return truth.as_map(truth.centred(values))

    return {SLOPES: whole, "solve only": partial(solve, ready, system.source)}, count


class Graph(NamedTuple):
    """The least-squares problem u_j - u_i = d on every link, for heights u.

    `right`, (H, W - 1), and `down`, (H - 1, W), are the links. `source`, (H, W) float64, is the sum of d over
    the links that end in a pixel, minus the sum over the links that start there.
    """

    right: Mask
    down: Mask
    source: Floats


def link(slopes: Floats, mask: Flags | None = None, edges: Flags | None = None) -> Graph:
    """Return the graph of slopes dz/dx and dz/dy, (2, H, W), equal to the engine's, as plain arrays."""
    valid = np.isfinite(slopes[0]) & np.isfinite(slopes[1])
    if mask is not None:
        valid &= mask != 0
    right, down = valid[:, :-1] & valid[:, 1:], valid[:-1] & valid[1:]
    if edges is not None:
        _cut(right, down, valid, edges != 0, slopes)
    source = np.zeros(valid.shape)  # in double precision it sums to 0
    across, up = _rises(slopes[0], right), _rises(slopes[1].T, down.T).T
    source[:, :-1] -= across
    source[:, 1:] += across
    source[:-1] += up
    source[1:] -= up
    return Graph(right, down, source)


def _cut(right: Mask, down: Mask, valid: Mask, edges: Mask, slopes: Floats) -> None:
    """Keep one link of each pixel on an edge: to the most similar neighbour that is not on an edge."""
    right &= ~(edges[:, :-1] | edges[:, 1:])
    down &= ~(edges[:-1] | edges[1:])
    free, values = np.pad(valid & ~edges, 1), np.pad(slopes, ((0, 0), (1, 1), (1, 1)))
    row, column = np.nonzero(valid & edges)
    here = values[:, row + 1, column + 1].astype(np.float64)
    unlike = np.empty((4, len(row)))
    for far, (below, right_of) in zip(unlike, _AROUND, strict=True):
        neighbour = np.s_[row + 1 + below, column + 1 + right_of]
        far[:] = np.where(free[neighbour], np.sum(np.square(values[:, *neighbour] - here), axis=0), np.inf)
    nearest = np.where(np.isfinite(unlike).any(axis=0), unlike.argmin(axis=0), -1)
    for number, (links, up, back) in enumerate(((right, 0, 0), (right, 0, 1), (down, 0, 0), (down, 1, 0))):
        chosen = nearest == number
        links[row[chosen] - up, column[chosen] - back] = True


def _rises(slope: Floats, linked: Mask) -> Floats:
    """Return the rise along each link to the next column; 0 where there is none."""
    half, inner, outer = (slope.dtype.type(weight * PIXEL) for weight in (1 / 2, 13 / 24, 1 / 24))
    rises: Floats = half * (slope[:, :-1] + slope[:, 1:])
    wide = inner * (slope[:, 1:-2] + slope[:, 2:-1]) - outer * (slope[:, :-3] + slope[:, 3:])
    four = linked[:, :-2] & linked[:, 1:-1] & linked[:, 2:]
    np.copyto(rises[:, 1:-1], wide, where=four)
    rises[~linked] = 0
    return rises


class System(NamedTuple):
    """The equations of the N pixels with a link: `matrix` (N, N), CSR, times heights is `source` (N,).

    `linked`, (H, W), is true at those pixels.
    """

    matrix: Any
    source: Doubles
    linked: Mask


def assemble(graph: Graph) -> System:
    """Return the equations of a graph, in the order of a CSR matrix, so that nothing has to be sorted."""
    import scipy.sparse as sparse

    shape = graph.source.shape
    entries = np.zeros((5, *shape), np.int8)  # above, left, the pixel itself, right, below
    np.negative(graph.down, out=entries[0, 1:], dtype=np.int8, casting="unsafe")
    np.negative(graph.right, out=entries[1, :, 1:], dtype=np.int8, casting="unsafe")
    entries[3, :, :-1], entries[4, :-1] = entries[1, :, 1:], entries[0, 1:]
    np.negative(entries.sum(axis=0, dtype=np.int8), out=entries[2])
    linked = entries[2] != 0
    number = np.cumsum(linked, dtype=np.int32) - np.int32(1)
    place = np.flatnonzero(linked).astype(np.int32)
    values = entries.reshape(5, -1)[:, place].T
    columns = place[:, np.newaxis] + np.array([-shape[1], -1, 0, 1, shape[1]], np.int32)
    nonzero = values != 0
    starts = np.concatenate([[0], np.cumsum(np.count_nonzero(nonzero, axis=1))]).astype(np.int32)
    parts = values[nonzero].astype(np.float64), number[columns[nonzero]], starts
    return System(
        sparse.csr_matrix(parts, (len(place),) * 2), graph.source[linked].astype(np.float64), linked
    )


class Truth:
    """The direct solution of one problem in double precision, and the errors of other solutions."""

    def __init__(self, system: System, members: Mask) -> None:
        import scipy.sparse as sparse
        from scipy.sparse.csgraph import connected_components
        from scipy.sparse.linalg import splu

        self.system, self.wanted = system, members
        self.count, self._label = connected_components(system.matrix, directed=False)
        first = np.unique(self._label, return_index=True)[1]  # pixel of each component, fixed at 0
        held = sparse.csc_matrix((np.ones(len(first)), (first, first)), system.matrix.shape)
        # The matrix is symmetric and positive definite: no pivoting is needed.
        options: dict[str, Any] = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}}
        factors = splu((system.matrix + held).tocsc(), diag_pivot_thresh=0.0, **options)
        self.values = self.centred(factors.solve(system.source))
        self.span, self.map = float(np.ptp(self.values)), self.as_map(self.values)

    def centred(self, answer: Floats) -> Doubles:
        """Return heights, (N,) or (H, W), at the pixels of the equations, with mean 0 in each component."""
        values = (answer if answer.ndim == 1 else answer[self.system.linked]).astype(np.float64)
        sums, sizes = np.bincount(self._label, values, self.count), np.bincount(self._label)
        return np.asarray(values - (sums / sizes)[self._label])

    def check(self, name: str, height: Floats, how: str) -> None:
        """Raise DisagreementError unless a map of heights is close to the direct solution."""
        near = {"height": _NEAR[how] * self.span}
        agree(name, {"height": height}, {"height": self.map}, near, whose="a direct solution")

    def error(self, answer: Floats) -> float:
        """Return the root mean square error of heights, as a share of their range."""
        return float(np.sqrt(np.mean(np.square(self.centred(answer) - self.values)))) / self.span

    def as_map(self, values: Doubles) -> NDArray[np.float32]:
        """Return heights as a map: 0 at pixels of the mask without a link, NaN outside the mask."""
        heights = np.where(self.wanted, np.float32(0), np.float32(np.nan))
        heights[self.system.linked] = values
        return heights


def find_truth(slopes: Floats, mask: Flags, edges: Flags | None) -> Truth:
    """Return the direct solution of slopes within a mask."""
    return Truth(assemble(link(slopes.astype(np.float64), mask, edges)), mask != 0)
