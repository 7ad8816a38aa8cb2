"""What the pixels' graph goes through: ``links.cl``, ``components.cl`` and ``bilateral.cl``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Work
from mirrorskin.bench.slopes import PIXEL, noisy_slopes, random_cuts
from mirrorskin.bench.sweep.scene import make_mask
from mirrorskin.bench.sweep.sweep import MAPS_ONLY, Family, Job, Shape, agree, run_kernel
from mirrorskin.engine.integration.graph import LEVEL, Levelling, PixelGraph, find_components
from mirrorskin.engine.integration.validation import Inputs, check_inputs
from mirrorskin.kernels import bilateral, components, links
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.bilateral import DOWN, RIGHT
from mirrorskin.kernels.device import Device

_CUTS = 50
_PEER = 3_000_000  # pixels up to which NumPy is timed, which takes seconds beyond
_K = 2.0  # of the bilateral weights
_LEVEL = 0.3  # curl at which a link has opened by three quarters
_PIECE = 256  # pixels of an item at most; see bilateral.cl

Maps = dict[str, NDArray[Any]]
Doubles = NDArray[np.float64]


def _inputs(shape: Shape) -> Inputs:
    """Return noisy slopes within a mask, with cuts."""
    dz_dx, dz_dy = noisy_slopes(shape)
    mask, edges = make_mask(shape), random_cuts(shape, _CUTS)
    return check_inputs(dz_dx, dz_dy, PIXEL, mask=mask, edges=edges)


def _make_links(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return flags and cuts, links with their right side, the misfit, and one step of smoothing."""
    inputs, room = _inputs(shape), PixelGraph(device, shape)
    flags = room.upload(inputs).copy()
    values = np.random.default_rng(1).standard_normal(shape, np.float32)
    relief = device.given("relief", values)

    weight = room.scale * inputs.weight / PIXEL**2
    maps = inputs.dz_dx, inputs.dz_dy, flags, inputs.weight_x, inputs.weight_y, None, None
    given = *maps, (weight, weight, 0.0), inputs.pixel_size, LEVEL

    def check_flags() -> None:
        told = links.links_flags(inputs.dz_dx, inputs.dz_dy, inputs.mask, None, None, None, None)
        assert inputs.edges is not None
        told = links.links_cut(inputs.dz_dx, inputs.dz_dy, inputs.edges, told)
        agree("links_flags and links_cut", room.upload(inputs), told)

    def check_join() -> None:
        found, expected = room.links(), links.links_join(*given)
        for name, exact in zip(("right", "down", "source"), (*expected[:2], expected[3]), strict=True):
            agree(f"links_join, {name}", getattr(found, name).download(), exact, 1e-4 * np.abs(exact).max())

    def check_misfit() -> None:
        exact = np.array([links.links_misfit(*given, values)])
        agree("links_misfit", np.array([room.misfit(relief) * room.scale]), exact, 1e-4 * exact)

    def check_smooth() -> None:
        agree("links_smooth", room.smooth(values, 1), links.links_smooth(flags, values), 1e-5)

    pixels = shape[0] * shape[1]

    def job(work: Work, each: int, operations: int, check: Callable[[], None]) -> Job:
        return Job(work, each * pixels, check, 0, operations * pixels)

    return {
        "links_flags and links_cut": job(lambda: room.upload(inputs), 8 + 1 + 1 + 1, 8, check_flags),
        "links_join": job(run_kernel(device, room.links), 8 + 1 + 12, 18, check_join),
        "links_misfit": job(lambda: room.misfit(relief), 8 + 1 + 4, 14, check_misfit),
        "links_smooth": job(lambda: room.smooth(values, 1), 4 + 1 + 4, 8, check_smooth),
    }


def _make_components(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return the sums over pieces and the heights that follow from them, and NumPy's."""
    room = PixelGraph(device, shape)
    flags = room.upload(_inputs(shape)).copy()
    found = find_components(flags, cut=True)
    values = np.random.default_rng(1).standard_normal(shape, np.float32)
    relief, settler = device.given("relief", values), Levelling(room)
    settler.use(found)
    level = (0.0, 0.0, 0.0)

    def settle() -> NDArray[np.float32]:
        return settler.level(relief, LEVEL, 0.0)

    def peer() -> Doubles:
        sums, shares = components.components_sum(flags, found.labels, values, level, None, None, found.count)
        return components.components_settle(flags, found.labels, values, level, -sums / shares)

    def check() -> None:
        agree("components_sum and components_settle", settle(), peer(), 1e-5)

    pixels = shape[0] * shape[1]
    moved = pixels * (1 + 4 + 4 + 1 + 4 + 4 + 4)
    jobs = {"components_sum and components_settle": Job(settle, moved, check, 0, 8 * pixels)}
    return jobs | ({"NumPy": Job(peer, moved, lambda: None)} if pixels <= _PEER else {})


def _make_bilateral(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return each pass of a step of the bilateral weights."""
    maps = _graph(shape)
    arrays = {name: device.given(name, values, values.dtype) for name, values in maps.items()}
    pixels = shape[0] * shape[1]
    pieces = shape[0] * -(-shape[1] // min(device.layout.tile, _PIECE))
    arrays["sums"] = device.given("sums", np.zeros(pieces))
    jobs = {}
    for name, (wanted, numbers, outputs, each, operations) in _PASSES.items():
        given = [arrays[one] for one in wanted.split()]
        values = [_NUMBERS.get(one, PIXEL) for one in numbers.split()]
        out = [arrays[one] for one in outputs.split()]
        items = -(-pixels // device.layout.tile) if name == "step" else pieces
        launch = _launcher(device, name, shape, items, [*given, *values, *out], each * pixels)
        check = _checker(name, maps, arrays, launch)
        jobs[f"bilateral_{name}"] = Job(
            run_kernel(device, launch), each * pixels, check, 0, operations * pixels
        )
    return jobs


_NUMBERS = {"k": _K, "level": _LEVEL, "part": 0.5}
_PLANES = "flags slope_x slope_y"
_PASSES = {  # what goes in, its numbers, what comes out, bytes and operations of a pixel
    "curl": (_PLANES, "width height", "curl", 13, 8),
    "shares": (f"{_PLANES} steep sure_x sure_y heights", "k width height", "share_x share_y sums", 33, 64),
    "links": (
        f"{_PLANES} steep sure_x sure_y share_x share_y heights",
        "width height",
        "right down pull_x pull_y",
        49,
        18,
    ),
    "left": ("pull_x pull_y", "", "left", 12, 3),
    "step": ("heights left", "part", "stepped", 12, 1),
    "open": ("curl", "level", "right down pull_x pull_y", 36, 16),
}


def _launcher(
    device: Device, name: str, shape: Shape, items: int, values: list[Array | float], moved: int
) -> Callable[[], None]:
    kernel = device.kernel("bilateral", f"bilateral_{name}", KNOWN=0)
    arguments: dict[str, Any] = dict(zip(kernel.arguments, [*shape, *values], strict=True))
    return lambda: kernel(items, **arguments, moved=moved)


def _checker(
    name: str, maps: Maps, arrays: dict[str, Array], launch: Callable[[], None]
) -> Callable[[], None]:
    """Return what compares a pass with its reference, from what the passes before it left on the device."""
    wanted, numbers, outputs, *_ = _PASSES[name]

    def check() -> None:
        before = {one: arrays[one].download().copy() for one in maps}
        for array in arrays.values():
            array.upload()
        launch()
        given: list[Any] = [before[one] for one in wanted.split()]
        if name == "shares":  # the reference is always told of known heights
            given[6:6] = [np.zeros_like(before["heights"])] * 2
        values: list[Any] = [_NUMBERS.get(one, PIXEL) for one in numbers.split()]
        if name == "left":
            values = [0.0, 0.0, before["heights"]]
        if name == "open":
            given += [before[one] for one in outputs.split()]
            given.insert(1, values.pop())
        found = getattr(bilateral, f"bilateral_{name}")(*given, *values)
        expected = found if isinstance(found, tuple) else (found,)
        for one, exact in zip(outputs.split(), expected, strict=True):
            told = arrays[one].download()
            if one == "sums":
                exact, told = np.array([exact]), np.array([told.sum(dtype=np.float64)])
            agree(f"bilateral_{name}, {one}", told, exact, 1e-5 * np.abs(exact).max())
        for array in arrays.values():
            array.upload()

    return check


def _graph(shape: Shape) -> Maps:
    """Return a graph with gaps, slopes, confidences and heights, and room for what the passes make."""
    generator = np.random.default_rng(0)
    slope_x, slope_y = noisy_slopes(shape)
    linked = generator.random((2, *shape), np.float32) < 0.95
    flags = (linked[0] * RIGHT + linked[1] * DOWN).astype(np.uint8)
    flags[:, -1] &= DOWN
    flags[-1] &= RIGHT
    made = {"flags": flags, "slope_x": slope_x, "slope_y": -slope_y}
    made["steep"] = 1 / (1 + slope_x**2 + slope_y**2)
    made["sure_x"], made["sure_y"] = 0.5 + generator.random((2, *shape), np.float32)
    made["heights"] = PIXEL * generator.standard_normal(shape, np.float32)
    for name in ("curl", "share_x", "share_y", "right", "down", "pull_x", "pull_y", "left", "stepped"):
        made[name] = np.zeros(shape, np.float32)
    return made


LINKS = Family(
    "sweep-links",
    f"links.cl: the graph of slopes within a mask, {_CUTS} cuts",
    _make_links,
    MAPS_ONLY,
    "triad",
    120,
    "bytes are those of slopes, mask, edges and flags; of slopes, flags, links and source; of slopes, flags "
    "and relief; of values, flags and values; flags and smoothing bring their maps to the device in each "
    "turn; operations a pixel: 8 comparisons; 18 for two links of four slopes, their weights and source; 14 "
    "for two misfits; 8",
)
COMPONENTS = Family(
    "sweep-components",
    f"components.cl: heights of the pieces within a mask, {_CUTS} cuts",
    _make_components,
    MAPS_ONLY,
    "triad",
    120,
    "bytes are those of flags, labels and relief, twice, and of the heights; 8 operations a pixel: the "
    "plane, the sums and the offset",
)
BILATERAL = Family(
    "sweep-bilateral",
    "bilateral.cl: the passes of one step",
    _make_bilateral,
    MAPS_ONLY,
    "triad",
    140,
    "bytes are those of each pass' maps, in and out, each once; operations of a pixel: 8, 64 with an "
    "exponential and a logarithm along each axis, 18, 3, 1, and 16",
)
