"""What the solvers of heights go through: ``rectangle.cl`` and ``multigrid.cl``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.integration import scipy_
from mirrorskin.bench.peers.integration.graph import link
from mirrorskin.bench.peers.integration.rectangle import divisors
from mirrorskin.bench.slopes import PIXEL, noisy_slopes
from mirrorskin.bench.sweep.scene import make_mask
from mirrorskin.bench.sweep.sweep import MAPS_ONLY, Family, Job, Shape, agree, run_kernel
from mirrorskin.bench.truth import find_truth
from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.hierarchy import WIDTH, part_of
from mirrorskin.engine.integration.levels import Level, cut_levels
from mirrorskin.engine.integration.rectangle import Rectangle, are_rows_easier, find_rates, make_plan
from mirrorskin.engine.integration.vcycle import Multigrid
from mirrorskin.kernels import multigrid, rectangle
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

_OMEGA = 0.5617  # of a step of Jacobi's method

Maps = dict[str, NDArray[np.float32]]


def _make_rectangle(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return the direct solver of a full picture, and SciPy's."""
    source = link(noisy_slopes(shape), PIXEL).source.astype(np.float32)
    given, solver = device.given("source", source), Rectangle(shape, (1.0, 1.0), device)
    ready = divisors(shape, np.float32)

    def solve() -> Array:
        return solver.solve(given)

    def peer() -> NDArray[np.float32]:
        found: NDArray[np.float32] = scipy_.solve(source, ready)
        return found

    def check() -> None:
        expected = _refer_rectangle(source, device)
        near = 2e-5 * np.ptp(expected)
        agree("rectangle", solve().download(), expected, near)
        agree("SciPy", peer(), expected, near)

    pixels = shape[0] * shape[1]
    operations = 2 * pixels * _transform(min(shape)) + 6 * pixels
    return {
        "rectangle": Job(run_kernel(device, solve), 8 * pixels, check, 0, operations),
        "SciPy": Job(peer, 8 * pixels, lambda: None),
    }


def _transform(length: int) -> int:
    """Return the multiply-adds of a point in a real Fourier transform of a line."""
    return round(1.25 * math.log2(length))


def _refer_rectangle(source: NDArray[np.float32], device: Device) -> NDArray[np.float64]:
    """Return the heights of a full picture by the reference, along the lines that the device takes."""
    shape = source.shape[0], source.shape[1]
    along = are_rows_easier(shape, side_by_side=device.layout.tile == 1)
    picture = source if along else source.T
    lines, length = picture.shape
    plan = make_plan(length)
    spectrum = np.zeros((len(plan.place) // 8, lines, 16))
    rectangle.rectangle_modes(picture, plan.turns, spectrum)
    rectangle.rectangle_columns(True, *find_rates(length, lines, 1.0, 1.0, 0.0), spectrum)
    height = np.zeros(picture.shape)
    rectangle.rectangle_heights(spectrum, plan.turns / (2 * length), height)
    return height if along else height.T


def _make_multigrid(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return passes over the finest level, and the whole solution within a mask."""
    levels = cut_levels(shape)[:2]
    maps = _nodes(*levels)
    arrays = {name: device.given(name, values) for name, values in maps.items()}
    jobs = {f"multigrid_{name}": _pass(device, levels, maps, arrays, name) for name in _PASSES}
    slopes, mask = noisy_slopes(shape), make_mask(shape)
    graph = link(slopes, PIXEL, mask)
    right, down = np.zeros((2, *shape), np.float32)
    right[:, :-1], down[:-1] = graph.right, graph.down
    given = device.given("right", right), device.given("down", down)
    solver = Multigrid(Links(device, shape, *given, None, device.given("source", graph.source)))

    def solve() -> Array:
        return solver.solve().height

    def check() -> None:
        truth = find_truth(slopes, mask, None)
        agree("multigrid", truth.settle(solve().download()), truth.values, 1e-3 * truth.range)

    pixels = shape[0] * shape[1]
    return jobs | {"multigrid to 1e-5": Job(run_kernel(device, solve), 16 * pixels, check)}


_PASSES = {  # arguments in order, which of them is written, bytes and operations of a node
    "smooth": ("right down anchor b x out", "out", 20, 15),
    "residual": ("right down anchor b x out", "out", 20, 9),
    "restrict": ("right down left coarse", "coarse", 13, 5),
    "prolong": ("right down inverse e x out", "out", 21, 5),
}


def _pass(device: Device, levels: list[Level], maps: Maps, arrays: dict[str, Array], name: str) -> Job:
    """Return one pass over the finest level, or between it and the next one."""
    fine, coarse = levels
    wanted, written, each, operations = _PASSES[name]
    between = name in ("restrict", "prolong")
    sizes: tuple[int, ...] = fine.base, fine.rows, fine.stride
    if between:
        sizes = fine.base, fine.stride, coarse.base, coarse.rows, coarse.stride
    numbers = {"smooth": [_OMEGA], "prolong": [1.0]}.get(name, [])
    width = WIDTH if device.layout.tile > 1 else 1
    kernel = device.kernel("multigrid", f"multigrid_{name}", ANCHORED=0, PART=part_of(device), WIDTH=width)
    items = coarse.rows if between else -(-fine.nodes // device.layout.tile)
    values = [*sizes, *numbers, *(arrays[key] for key in wanted.split())]
    arguments: dict[str, Any] = dict(zip(kernel.arguments, values, strict=True))
    moved = each * fine.nodes

    def launch() -> None:
        kernel(items, **arguments, moved=moved)

    def check() -> None:
        launch()
        given = [maps[key].astype(np.float64) for key in wanted.split()]
        getattr(multigrid, f"multigrid_{name}")(*sizes, *numbers, *given)
        expected = dict(zip(wanted.split(), given, strict=True))[written]
        agree(f"multigrid_{name}", arrays[written].download(), expected, 1e-4)

    return Job(run_kernel(device, launch), moved, check, 0, operations * fine.nodes)


def _nodes(fine: Level, coarse: Level) -> Maps:
    """Return random links and heights of two levels."""
    generator, size = np.random.default_rng(0), coarse.end
    maps = {name: np.zeros(size, np.float32) for name in ("right", "down", "anchor", "out", "coarse")}
    for level in (fine, coarse):
        picture = slice(level.first, level.first + level.nodes)
        for name, inside in (("right", np.s_[:, : level.columns - 1]), ("down", np.s_[:-1, : level.columns])):
            plane = maps[name][picture].reshape(level.rows, level.stride)
            plane[inside] = generator.random(plane[inside].shape, np.float32)
    for name in ("b", "x", "e", "left"):
        maps[name] = generator.standard_normal(size, np.float32)
    maps["inverse"] = 0.2 + 0.1 * generator.random(size, np.float32)
    return maps


RECTANGLE = Family(
    "sweep-rectangle",
    "rectangle.cl: heights of a full picture",
    _make_rectangle,
    MAPS_ONLY,
    "triad",
    60,
    "bytes are those of source and heights, each once; multiply-adds: 1.25 log2 of the shorter side a point "
    "in each of two transforms, and 6 in between",
)
MULTIGRID = Family(
    "sweep-multigrid",
    "multigrid.cl: passes over the finest level, and the solution within a mask",
    _make_multigrid,
    MAPS_ONLY,
    "triad",
    260,
    "bytes of a pass are those of its maps, each once; of the solution those of links, source and heights; "
    "operations of a node: 15, 9, 5 and 5; those of the solution depend on its iterations, and nobody counts",
)
