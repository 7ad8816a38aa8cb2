"""Heights from slopes: the engine, the limits, SciPy and OpenCV on a full picture, pyamg within a mask.

Aims, from slopes: five times as fast as SciPy's cosine transforms on a full picture, a hundred times as fast
as pyamg (Ruge-Stuben, conjugate gradients) within a mask to the same error, fifty times with cuts, a live
frame of 640 x 480 in 4 ms, and sixteen surfaces at once in six times the time of one.
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
from mirrorskin.bench.harness import (
    FIRST,
    OURS,
    THREADS,
    Case,
    Cases,
    Measured,
    Row,
    Target,
    Work,
    agree,
    call_targets,
    check_memory,
    missing,
    ratio_target,
)
from mirrorskin.bench.limits import beside_limits
from mirrorskin.bench.scenes import PIXEL, Shape, blob_mask, drifting_slopes, noisy_slopes, random_cuts
from mirrorskin.engine import Integrator
from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.multigrid import Multigrid
from mirrorskin.engine.integration.rectangle import Rectangle
from mirrorskin.kernels.device import Device

Floats = NDArray[Any]  # float32, or float64 where an exact answer is wanted
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Flags = NDArray[np.uint8]

SLOPES, SETUP, SOLVE = "from slopes", "set-up and solve", "solve only"
PYAMG = "pyamg"
_SCIPY, _MASK, _CUTS = 5.0, 100.0, 50.0  # times as fast as SciPy, and as pyamg, that we want to be
_FRAME = 4e-3  # seconds of a live frame
_SIGMA = 2.5  # times of a call without sigma that one with it may take
_SIDES, _TOGETHER = 16, 6.0  # surfaces at once, and times of a call for one that they may take

_MPIXEL, _LIVE, _QUICK = (1024, 1024), (480, 640), (48, 64)
_FULL = {SLOPES: 2 * 4 + 4, SETUP: 2 * 4, SOLVE: 2 * 4}  # bytes of a pixel of a full picture: in and out
_MASKED = {SLOPES: 2 * 4 + 1 + 4, SETUP: 4 * 4, SOLVE: 4 * 4}  # within a mask; or of links and source
_ROOM, _DIRECT = 400, 1200  # bytes of a pixel for what all works keep, and for the direct solution
_FRAMES, _CHANGE = 16, 0.01  # of a circle of live frames, and what changes from one to the next
_NEAR = {"full": 1e-4, "mask": 1e-3, "live": 1e-2}  # of the range, by which heights may differ
_AROUND = ((0, 1), (0, -1), (1, 0), (-1, 0))  # right, left, below and above
_NEVER, _MOST = 1e-14, 40  # of pyamg: a residual that stops no run, and iterations that reach nothing more


def run_rectangle(name: str, shape: Shape, device: Device, quick: bool) -> Case:
    """Time the direct solver of a full picture, the limits and the peers; heights must be the same first.

    Bytes are those of the source, or of the slopes, and of the heights, each once.
    """
    pixels = math.prod(shape)
    check_memory(name, _ROOM * pixels)
    slopes = noisy_slopes(shape)
    source = link(slopes).source
    exact = solve_with_scipy(source, divisors(shape, np.float64))
    single, span = source.astype(np.float32), float(np.ptp(exact))
    given, ready = device.given("source", single), Rectangle(shape, (1.0, 1.0), device)
    works: dict[str, Work] = {
        **_calls(slopes, None, None, device),
        f"{OURS}, {SETUP}": lambda: Rectangle(shape, (1.0, 1.0), device).solve(given).download(),
        f"{OURS}, {SOLVE}": lambda: ready.solve(given).download(),
    }
    for peer, solve in (("SciPy", solve_with_scipy), ("OpenCV", _opencv)):
        works |= _transform_works(peer, solve, slopes, single)
    errors = {}

    def check(results: dict[str, Any]) -> None:
        for work, found in results.items():
            if work in works:
                found = found - found.mean()
                agree(work, {"height": found}, {"height": exact}, {"height": _NEAR["full"] * span})
                errors[work] = float(np.sqrt(np.mean(np.square(found - exact)))) / span

    before = {FIRST: engine.free_memory}
    rows, measured = beside_limits(
        works, _FULL[SOLVE] * pixels, device, quick, check, first="triad", before=before
    )
    rows += [Row(work, measured[work], _FULL.get(_part(work), _FULL[SLOPES]) * pixels) for work in works]
    notes = (_ratios(measured, "SciPy"), _errors(errors))
    title = f"heights of a full picture; {' x '.join(map(str, shape))} float32"
    targets = () if quick else _targets(rows, f"SciPy, {SLOPES}", _SCIPY)
    return Case(name, title, rows, {}, notes, targets)


def run_mask(name: str, cuts: int, device: Device, quick: bool) -> Case:
    """Time heights within a mask, cut or not, the limits, and pyamg until its error is as small as ours.

    Bytes are those of the slopes with mask and edges, or of links and source, and of the heights, each once.
    """
    shape = _QUICK if quick else _MPIXEL
    pixels = math.prod(shape)
    check_memory(name, (_ROOM + _DIRECT) * pixels)
    slopes, mask, edges = noisy_slopes(shape), blob_mask(shape), random_cuts(shape, cuts) if cuts else None
    truth = find_truth(slopes, mask, edges)
    works, absent = _mask_works(slopes, mask, edges, device), missing(PYAMG)
    notes = []
    if not absent:
        error = truth.error(np.asarray(works[f"{OURS}, {SLOPES}"]()))
        theirs, count = _pyamg_works(slopes, mask, edges, truth, error)
        works |= theirs
        notes = [f"{PYAMG} does {count} iterations: as few as leave no larger an error than {error:.1e}"]
    errors = {}

    def check(results: dict[str, Any]) -> None:
        for work in works:
            errors[work] = truth.error(results[work])
            values = results[work]
            found = truth.as_map(truth.centred(values)) if _part(work) in (SETUP, SOLVE) else values
            near = {"height": _NEAR["mask"] * truth.span}
            agree(work, {"height": found}, {"height": truth.map}, near, whose="a direct solution")

    moved = _MASKED | {SLOPES: _MASKED[SLOPES] + (edges is not None)}
    before = {FIRST: engine.free_memory}
    rows, measured = beside_limits(
        works, moved[SLOPES] * pixels, device, quick, check, first="triad", before=before
    )
    rows += [Row(work, measured[work], moved.get(_part(work), moved[SLOPES]) * pixels) for work in works]
    notes += [] if absent else [_ratios(measured, PYAMG)]
    parts = f"{100 * np.mean(truth.wanted):.0f} % of {' x '.join(map(str, shape))} float32"
    title = f"heights of {parts}{f', {cuts} cuts' if cuts else ''}, in {truth.count} components"
    targets = () if quick else _targets(rows, f"{PYAMG}, {SLOPES}", _CUTS if cuts else _MASK)
    return Case(name, title, rows, absent, (*notes, _errors(errors)), targets)


def run_frames(device: Device, quick: bool) -> Case:
    """Time live frames within a mask: slopes in, heights out, each frame a little unlike the one before.

    A turn is a circle of frames, one after the other. Bytes are, of each frame, those of slopes, mask and
    heights, each once; the limits are those of as many bytes as one frame moves.
    """
    shape = _QUICK if quick else _LIVE
    mask, frames = blob_mask(shape), drifting_slopes(shape, _FRAMES, _CHANGE)
    truth, integrator = find_truth(frames[-1], mask, None), Integrator(shape, PIXEL, device=device)
    seconds: list[float] = []

    def circle() -> NDArray[np.float32]:
        for dz_dx, dz_dy in frames:
            begun = time.perf_counter()
            integrator.push(dz_dx, dz_dy, mask=mask)
            height = integrator.result().height
            seconds.append(time.perf_counter() - begun)
        return height

    def check(results: dict[str, Any]) -> None:
        near = {"height": _NEAR["live"] * truth.span}
        agree(OURS, {"height": results[OURS]}, {"height": truth.map}, near, whose="a direct solution")
        seconds.clear()  # of the warm-up

    moved = _MASKED[SLOPES] * math.prod(shape)
    limits, measured = beside_limits({OURS: circle}, moved, device, quick, check, first="triad")
    rows = [*limits, Row(OURS, measured[OURS], _FRAMES * moved, _FRAMES)]
    lower, middle, upper = 1e3 * np.percentile(seconds, [25, 50, 75])
    notes = (f"a frame: median {middle:.2f} ms, quartiles {lower:.2f}-{upper:.2f}",)
    title = f"live, warm; heights of {100 * np.mean(mask):.0f} % of {' x '.join(map(str, shape))} float32"
    aim = Target(OURS, f"at most {1e3 * _FRAME:.0f} ms a frame", f"{middle:.2f} ms", middle <= 1e3 * _FRAME)
    return Case("integrate-live", title, rows, {}, notes, () if quick else (aim,))


def run_many(device: Device, quick: bool) -> Case:
    """Time heights of many surfaces within one mask, and one of them alone, by the engine and by pyamg.

    Bytes are those of the slopes with the mask, and of the heights, each once.
    """
    shape = _QUICK if quick else _MPIXEL
    pixels = math.prod(shape)
    check_memory("integrate-many", _SIDES * _ROOM * pixels)
    slopes, mask = np.stack([noisy_slopes(shape, k) for k in range(_SIDES)], axis=1), blob_mask(shape)
    truth = find_truth(slopes[:, -1], mask, None)
    alone = "one surface"

    def find(some: Floats) -> Floats:
        return engine.integrate(some[0], some[1], PIXEL, mask=mask, device=device).height

    works: dict[str, Work] = {OURS: partial(find, slopes), alone: partial(find, slopes[:, -1])}
    absent = missing(PYAMG)
    if not absent:
        error = truth.error(np.asarray(works[alone]()))
        theirs, _ = _pyamg_works(slopes[:, -1], mask, None, truth, error)
        works |= {f"{PYAMG}, {part}": theirs[f"{PYAMG}, {part}"] for part in (SLOPES, SOLVE)}

    def check(results: dict[str, Any]) -> None:
        near = {"height": _NEAR["mask"] * truth.span}
        for work, last in ((OURS, results[OURS][-1]), (alone, results[alone])):
            agree(work, {"height": last}, {"height": truth.map}, near, whose="a direct solution")

    moved = (2 * 4 + 4) * pixels
    rows, measured = beside_limits(works, _SIDES * moved + pixels, device, quick, check, first="triad")
    by_name = {
        work: Row(work, measured[work], (_SIDES if work == OURS else 1) * moved + pixels) for work in works
    }
    notes: tuple[str, ...] = ()
    if not absent:
        ours, whole, solve = (
            measured[name].wall.median for name in (OURS, f"{PYAMG}, {SLOPES}", f"{PYAMG}, {SOLVE}")
        )
        ratio = (whole + (_SIDES - 1) * solve) / ours
        notes = (f"{OURS} against {PYAMG} with one set-up for all surfaces: {ratio:.1f} times as fast",)
    title = (
        f"heights of {_SIDES} surfaces, {100 * np.mean(mask):.0f} % of {' x '.join(map(str, shape))} float32"
    )
    aim = ratio_target(OURS, _TOGETHER, by_name[OURS], by_name[alone], alone, faster=False)
    return Case("integrate-many", title, [*rows, *by_name.values()], absent, notes, () if quick else (aim,))


def _rectangle(name: str, shape: Shape) -> Callable[[Device, bool], Case]:
    return lambda device, quick: run_rectangle(name, _QUICK if quick else shape, device, quick)


CASES: Cases = {
    "integrate-rectangle": _rectangle("integrate-rectangle", _MPIXEL),
    "integrate-rectangle-4mp": _rectangle("integrate-rectangle-4mp", (2048, 2048)),
    "integrate-rectangle-4k": _rectangle("integrate-rectangle-4k", (2160, 3840)),
    "integrate-mask": partial(run_mask, "integrate-mask", 0),
    "integrate-cuts": partial(run_mask, "integrate-cuts", 50),
    "integrate-live": run_frames,
    "integrate-many": run_many,
}


def _calls(slopes: Floats, mask: Flags | None, edges: Flags | None, device: Device) -> dict[str, Work]:
    """Return `integrate` with its defaults, so with sigma, and without sigma."""
    dz_dx, dz_dy = slopes

    def call(sigma: bool) -> Floats:
        known: dict[str, Any] = {"mask": mask, "edges": edges, "sigma": sigma, "device": device}
        return engine.integrate(dz_dx, dz_dy, PIXEL, **known).height

    default = partial(call, True)
    return {OURS: default, FIRST: default, f"{OURS}, {SLOPES}": partial(call, False)}


def _targets(rows: list[Row], peer: str, faster: float) -> tuple[Target, ...]:
    """Return what the whole call aims at: a peer's time, and with sigma little more than without."""
    by_name = {row.name: row for row in rows}
    plain = by_name[f"{OURS}, {SLOPES}"]
    sigma = ratio_target(OURS, _SIGMA, by_name[OURS], plain, "without sigma", faster=False)
    return *call_targets(rows, {peer: faster}), sigma


def _part(work: str) -> str:
    return work.partition(", ")[2]


def _ratios(measured: Mapping[str, Measured], who: str) -> str:
    """Say how many times as fast we are, part by part."""
    parts = []
    for part in (SLOPES, SETUP, SOLVE):
        theirs, ours = (measured[f"{name}, {part}"].wall.median for name in (who, OURS))
        parts.append(f"{part} {theirs / ours:.1f}")
    return f"{OURS} against {who}, times as fast: {', '.join(parts)}"


def _errors(errors: Mapping[str, float]) -> str:
    """Say how far each answer is from the exact one."""
    parts = (f"{name} {error:.1e}" for name, error in errors.items() if not name.endswith(SETUP))
    return f"root mean square error, in ranges of the heights: {'; '.join(parts)}"


def solve_with_scipy(source: Floats, inverse: Floats) -> Floats:
    """Solve with SciPy's cosine transforms, on all cores, in place behind the first."""
    from scipy.fft import dctn, idctn

    spectrum = dctn(source, workers=THREADS)
    spectrum *= inverse
    found: Floats = idctn(spectrum, overwrite_x=True, workers=THREADS)
    return found


def _opencv(source: Floats, inverse: Floats) -> Floats:
    """Solve with OpenCV's, for pictures of even sizes."""
    import cv2

    spectrum = cv2.dct(source)
    cv2.multiply(spectrum, inverse, dst=spectrum)
    return np.asarray(cv2.idct(spectrum, dst=spectrum))


def divisors(shape: Shape, dtype: type[np.floating[Any]]) -> Floats:
    """Return the inverse eigenvalues of a rectangle's cosines, (H, W): the set-up of a transform's solve."""
    down, across = (4 * np.square(np.sin(np.pi * np.arange(n) / (2 * n))).astype(dtype) for n in shape)
    found: Floats = np.add(down[:, np.newaxis], across)
    found[0, 0] = np.inf  # the mean
    np.divide(dtype(1), found, out=found)
    return found


def _transform_works(
    peer: str, solve: Callable[[Floats, Floats], Floats], slopes: Floats, source: Floats
) -> dict[str, Work]:
    shape, dtype = (source.shape[0], source.shape[1]), np.float32
    ready = divisors(shape, dtype)
    return {
        f"{peer}, {SLOPES}": lambda: solve(link(slopes).source.astype(dtype), divisors(shape, dtype)),
        f"{peer}, {SETUP}": lambda: solve(source, divisors(shape, dtype)),
        f"{peer}, {SOLVE}": lambda: solve(source, ready),
    }


def _mask_works(slopes: Floats, mask: Flags, edges: Flags | None, device: Device) -> dict[str, Work]:
    """Return the engine's works; only that from slopes has mean 0 in each component, and NaN outside."""
    graph = link(slopes, mask, edges)
    right, down = np.zeros((2, *mask.shape), np.float32)
    right[:, :-1], down[:-1] = graph.right, graph.down
    maps = device.given("right", right), device.given("down", down)
    links = Links(device, mask.shape, *maps, None, device.given("source", graph.source))
    ready = Multigrid(links)
    return {
        **_calls(slopes, mask, edges, device),
        f"{OURS}, {SETUP}": lambda: Multigrid(links).solve().height.download(),
        f"{OURS}, {SOLVE}": lambda: ready.solve().height.download(),
    }


def _pyamg_works(
    slopes: Floats, mask: Flags, edges: Flags | None, truth: Truth, error: float
) -> tuple[dict[str, Work], int]:
    """Return pyamg's works, and how few iterations bring its error to `error`."""
    pyamg = import_module(PYAMG)

    def solve(hierarchy: Any, source: Doubles) -> Doubles:
        found: Doubles = hierarchy.solve(source, tol=_NEVER, maxiter=count, accel="cg")
        return found

    graph, system = link(slopes, mask, edges), truth.system
    ready = pyamg.ruge_stuben_solver(system.matrix)
    count = 0

    def follow(values: Doubles) -> None:
        nonlocal count
        count += 1
        if truth.error(values) <= error:
            raise StopIteration

    with suppress(StopIteration):
        ready.solve(system.source, tol=_NEVER, maxiter=_MOST, accel="cg", callback=follow)

    def set_up() -> Doubles:
        made = assemble(graph)
        return solve(pyamg.ruge_stuben_solver(made.matrix), made.source)

    def whole() -> NDArray[np.float32]:
        made = assemble(link(slopes, mask, edges))
        values = solve(pyamg.ruge_stuben_solver(made.matrix), made.source)
        return truth.as_map(truth.centred(values))

    works: dict[str, Work] = {
        f"{PYAMG}, {SLOPES}": whole,
        f"{PYAMG}, {SETUP}": set_up,
        f"{PYAMG}, {SOLVE}": lambda: solve(ready, system.source),
    }
    return works, count


class Graph(NamedTuple):
    """Heights u with u_j - u_i = d on every link, as nearly as may be.

    `right`, (H, W - 1), and `down`, (H - 1, W), are the links; `source`, (H, W) float64, is of each pixel the
    sum of d over links that end in it, less that over links that begin there.
    """

    right: Mask
    down: Mask
    source: Floats


def link(slopes: Floats, mask: Flags | None = None, edges: Flags | None = None) -> Graph:
    """Return the graph of slopes dz/dx and dz/dy, (2, H, W), as the engine makes it, in plain arrays."""
    known = np.isfinite(slopes[0]) & np.isfinite(slopes[1])
    if mask is not None:
        known &= mask != 0
    right, down = known[:, :-1] & known[:, 1:], known[:-1] & known[1:]
    if edges is not None:
        _cut(right, down, known, edges != 0, slopes)
    source = np.zeros(known.shape)  # sums to 0, as nothing in single precision would
    across, up = _rises(slopes[0], right), _rises(slopes[1].T, down.T).T
    source[:, :-1] -= across
    source[:, 1:] += across
    source[:-1] += up
    source[1:] -= up
    return Graph(right, down, source)


def _cut(right: Mask, down: Mask, known: Mask, edges: Mask, slopes: Floats) -> None:
    """Leave each pixel on an edge only its link to the neighbour that is the most alike and on none."""
    right &= ~(edges[:, :-1] | edges[:, 1:])
    down &= ~(edges[:-1] | edges[1:])
    free, values = np.pad(known & ~edges, 1), np.pad(slopes, ((0, 0), (1, 1), (1, 1)))
    row, column = np.nonzero(known & edges)
    here = values[:, row + 1, column + 1].astype(np.float64)
    unlike = np.empty((4, len(row)))
    for far, (below, beside) in zip(unlike, _AROUND, strict=True):
        there = np.s_[row + 1 + below, column + 1 + beside]
        far[:] = np.where(free[there], np.sum(np.square(values[:, *there] - here), axis=0), np.inf)
    nearest = np.where(np.isfinite(unlike).any(axis=0), unlike.argmin(axis=0), -1)
    for number, (links, up, left) in enumerate(((right, 0, 0), (right, 0, 1), (down, 0, 0), (down, 1, 0))):
        chosen = nearest == number
        links[row[chosen] - up, column[chosen] - left] = True


def _rises(slope: Floats, linked: Mask) -> Floats:
    """Return the rise along each link to the next column; 0 where there is none."""
    half, inner, outer = (slope.dtype.type(share * PIXEL) for share in (1 / 2, 13 / 24, 1 / 24))
    rises: Floats = half * (slope[:, :-1] + slope[:, 1:])
    wide = inner * (slope[:, 1:-2] + slope[:, 2:-1]) - outer * (slope[:, :-3] + slope[:, 3:])
    four = linked[:, :-2] & linked[:, 1:-1] & linked[:, 2:]
    np.copyto(rises[:, 1:-1], wide, where=four)
    rises[~linked] = 0
    return rises


class System(NamedTuple):
    """The equations of the N pixels that have a link: `matrix` (N, N), CSR, times heights is `source` (N,).

    `linked`, (H, W), is true at those pixels.
    """

    matrix: Any
    source: Doubles
    linked: Mask


def assemble(graph: Graph) -> System:
    """Return the equations of a graph, row by row as a CSR matrix has them: no sort, no sum."""
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
    there = values != 0
    starts = np.concatenate([[0], np.cumsum(np.count_nonzero(there, axis=1))]).astype(np.int32)
    parts = values[there].astype(np.float64), number[columns[there]], starts
    return System(
        sparse.csr_matrix(parts, (len(place),) * 2), graph.source[linked].astype(np.float64), linked
    )


class Truth:
    """The direct solution of one problem in double precision, and how far an answer is from it."""

    def __init__(self, system: System, wanted: Mask) -> None:
        import scipy.sparse as sparse
        from scipy.sparse.csgraph import connected_components
        from scipy.sparse.linalg import splu

        self.system, self.wanted = system, wanted
        self.count, self._label = connected_components(system.matrix, directed=False)
        first = np.unique(self._label, return_index=True)[1]  # of each component is held at 0
        held = sparse.csc_matrix((np.ones(len(first)), (first, first)), system.matrix.shape)
        # The matrix is symmetric and positive, so its diagonal needs no search for a pivot.
        known: dict[str, Any] = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}}
        factors = splu((system.matrix + held).tocsc(), diag_pivot_thresh=0.0, **known)
        self.values = self.centred(factors.solve(system.source))
        self.span, self.map = float(np.ptp(self.values)), self.as_map(self.values)

    def centred(self, answer: Floats) -> Doubles:
        """Return an answer, (N,) or (H, W), at the pixels of the equations with mean 0 in each component."""
        values = (answer if answer.ndim == 1 else answer[self.system.linked]).astype(np.float64)
        sums, sizes = np.bincount(self._label, values, self.count), np.bincount(self._label)
        return np.asarray(values - (sums / sizes)[self._label])

    def error(self, answer: Floats) -> float:
        """Return the root mean square error of an answer, in ranges of the heights."""
        return float(np.sqrt(np.mean(np.square(self.centred(answer) - self.values)))) / self.span

    def as_map(self, values: Doubles) -> NDArray[np.float32]:
        """Return heights as a map: 0 at wanted pixels without a link, NaN where none is wanted."""
        heights = np.where(self.wanted, np.float32(0), np.float32(np.nan))
        heights[self.system.linked] = values
        return heights


def find_truth(slopes: Floats, mask: Flags, edges: Flags | None) -> Truth:
    """Return the direct solution of slopes within a mask."""
    return Truth(assemble(link(slopes.astype(np.float64), mask, edges)), mask != 0)
