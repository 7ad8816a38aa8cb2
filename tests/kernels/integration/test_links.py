"""The links' kernels equal their reference, and the reference is correct."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mirrorskin.engine.integration.graph import PixelGraph
from mirrorskin.engine.integration.validation import Inputs, check_inputs
from mirrorskin.kernels.integration import links
from mirrorskin.kernels.integration.links import DOWN, KNOWN, LOST, RIGHT, SLOPE

SHAPES = [(1, 1), (1, 2), (1, 9), (9, 1), (3, 2), (23, 37), (18, 300)]
SIZE = 0.03, 0.04
PLANE = 0.1, -0.2, 0.05


@dataclass(frozen=True)
class Scene:
    """Which of the maps are given."""

    mask: bool = False
    weights: int = 0
    edges: bool = False
    heights: int = 0

    def inputs(self, shape: tuple[int, int]) -> Inputs:
        """Random maps, some of them with holes."""
        random = np.random.default_rng(shape[1])
        dz_dx, dz_dy = random.normal(0, 1, (2, *shape)).astype(np.float32)
        dz_dx[random.random(shape) < 0.05] = np.nan
        dz_dy[random.random(shape) < 0.03] = np.inf
        heights = np.where(random.random(shape) < 0.5, random.normal(-300, 1, shape), np.nan)
        some = random.random((3, *shape)) * (random.random((3, *shape)) > 0.1)
        return check_inputs(
            dz_dx,
            dz_dy,
            SIZE,
            mask=random.random(shape) > 0.1 if self.mask else None,
            slope_weights=[None, some[0], some[:2]][self.weights],
            edges=random.random(shape) < 0.1 if self.edges else None,
            known_heights=heights if self.heights else None,
            known_height_weights=some[2] if self.heights == 2 else None,
        )


SCENES = {
    "plain": Scene(),
    "mask": Scene(mask=True),
    "weights": Scene(weights=1),
    "two weights, edges": Scene(mask=True, weights=2, edges=True),
    "heights": Scene(edges=True, heights=1),
    "all": Scene(mask=True, weights=2, edges=True, heights=2),
}
scenes = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)


def flags_of(inputs):
    """The flags, by the reference."""
    maps = inputs.dz_dx, inputs.dz_dy
    rest = inputs.weight_x, inputs.weight_y, inputs.known_heights, inputs.known_height_weights
    flags = links.links_flags(*maps, inputs.mask, *rest)
    return flags if inputs.edges is None else links.links_cut(*maps, inputs.edges, flags)


def arguments(inputs, flags, scale):
    """What goes over links is given, by the reference."""
    weights = scale / SIZE[0] ** 2, scale / SIZE[1] ** 2, scale
    rest = inputs.weight_x, inputs.weight_y, inputs.known_heights, inputs.known_height_weights
    return inputs.dz_dx, inputs.dz_dy, flags, *rest, weights, SIZE, PLANE


def put(graph, values):
    """An array on the room's device."""
    array = graph.device.array("test", values.shape, np.float32)
    array.write(values)
    return array


def near(device_map, exact):
    np.testing.assert_allclose(device_map, exact, rtol=2e-5, atol=2e-6 * max(np.abs(exact).max(), 1e-3))


@pytest.mark.parametrize("shape", SHAPES)
@scenes
def test_kernels_and_reference_build_the_same_graph(device, shape, scene):
    inputs, graph = scene.inputs(shape), PixelGraph(device, shape)
    flags = flags_of(inputs)
    np.testing.assert_array_equal(graph.upload(inputs), flags)
    right, down, anchor, source = links.links_join(*arguments(inputs, flags, graph.scale))
    pixel_links = graph.links(PLANE)
    near(pixel_links.right.read(), right)
    near(pixel_links.down.read(), down)
    near(pixel_links.source.read(), source)
    assert (pixel_links.anchor is None) == (inputs.known_heights is None)
    if pixel_links.anchor is not None:
        near(pixel_links.anchor.read(), anchor)
    pixel_links = put(graph, np.zeros((3, *shape)))
    graph.put_source(PLANE, pixel_links, 1)
    near(pixel_links.read(), np.stack([0 * source, source, 0 * source]))


def test_links_are_put_into_rows_of_another_length(device):
    shape, start, stride = (23, 37), 5, 48
    graph = PixelGraph(device, shape)
    graph.upload(SCENES["weights"].inputs(shape))
    joined = graph.links()
    expected = {name: getattr(joined, name).read() for name in ("right", "down", "source")}
    maps = {name: put(graph, np.zeros(start + shape[0] * stride)) for name in expected}
    graph.put_links(maps, start, stride)
    for name, values in expected.items():
        rows = maps[name].read()[start:].reshape(-1, stride)
        np.testing.assert_array_equal(rows, np.pad(values, ((0, 0), (0, stride - shape[1]))))


@scenes
def test_kernels_and_reference_find_the_same_misfit(device, scene):
    inputs, graph = scene.inputs((23, 37)), PixelGraph(device, (23, 37))
    flags = graph.upload(inputs).copy()
    relief = np.random.default_rng(1).normal(0, 1, graph.shape).astype(np.float32)
    exact = links.links_misfit(*arguments(inputs, flags, graph.scale), relief)
    assert exact > 1
    assert graph.misfit(put(graph, relief), PLANE) * graph.scale == pytest.approx(exact, rel=1e-5)


def test_links_may_have_weights_of_their_own(device):
    inputs, graph = SCENES["heights"].inputs((23, 37)), PixelGraph(device, (23, 37))
    flags = graph.upload(inputs).copy()
    joined = graph.links(PLANE)
    slope_weights = [np.random.default_rng(n).random(graph.shape).astype(np.float32) for n in (1, 2)]
    for array, values in zip((joined.right, joined.down), slope_weights, strict=True):
        array.write(values)
    maps = (*slope_weights, inputs.known_heights, inputs.known_height_weights)
    numbers = (1.0, 1.0, graph.scale), SIZE, PLANE
    inputs_of_links = inputs.dz_dx, inputs.dz_dy, flags, *maps, *numbers
    relief = np.random.default_rng(3).normal(0, 1, graph.shape).astype(np.float32)
    exact = links.links_misfit(*inputs_of_links, relief, owned=True)
    several = put(graph, np.stack([0 * relief, relief]))
    assert graph.misfit(several, PLANE, joined, 1) * graph.scale == pytest.approx(exact, rel=1e-5)


def grid(shape):
    row, column = np.indices(shape)
    return column * SIZE[0], -row * SIZE[1]


def test_a_cubic_surface_leaves_no_misfit_where_four_are_in_line():
    x, y = grid((9, 9))
    dz_dx, dz_dy = (1 + x - 6 * x**2, 2 - y + 3 * y**2)
    inputs = check_inputs(dz_dx.astype(np.float32), dz_dy.astype(np.float32), SIZE)
    height = x + x**2 / 2 - 2 * x**3 + 2 * y - y**2 / 2 + y**3
    flags = flags_of(inputs)
    inner = flags.copy()
    inner[:, [0, -2]] &= ~np.uint8(RIGHT)
    inner[[0, -2]] &= ~np.uint8(DOWN)
    maps = arguments(inputs, flags, 1.0)
    steps = links._steps(*maps[:5], *maps[7:], owned=False)
    for (_, step), bit, axis in zip(steps, (RIGHT, DOWN), (1, 0), strict=True):
        real = np.roll(height, -1, axis) - height
        level = (PLANE[0] * SIZE[0], -PLANE[1] * SIZE[1])[1 - axis]
        where = inner & bit != 0
        assert where.sum() > 40
        np.testing.assert_allclose((step + level)[where], real[where], atol=1e-8)
        assert np.abs((step + level - real)[flags & ~inner & bit != 0]).min() > 1e-7  # of two pixels only


def test_a_pixel_is_described_by_its_maps():
    nan, unit = np.nan, 1.0
    dz = np.array([[unit, nan, unit, unit, nan]], np.float32)
    inputs = check_inputs(
        dz, np.ones_like(dz), SIZE, slope_weights=[[1, 1, 0, 1, 0]], known_heights=[[nan, 2, nan, 3, nan]]
    )
    assert flags_of(inputs).tolist() == [[SLOPE, LOST | KNOWN, 0, SLOPE | KNOWN, 0]]


def test_a_pixel_on_an_edge_keeps_its_link_to_the_neighbour_most_like_it():
    dz_dx = np.zeros((3, 4), np.float32)
    dz_dx[:, 2:], dz_dx[1, 1] = 1.0, 0.9
    marked = np.zeros((3, 4), bool)
    marked[:, 1] = True
    flags = flags_of(check_inputs(dz_dx, np.zeros_like(dz_dx), SIZE, edges=marked))
    assert (flags & RIGHT).tolist() == [[1, 0, 1, 0], [0, 1, 1, 0], [1, 0, 1, 0]]
    assert (flags[:-1] & DOWN > 0).tolist() == [[1, 0, 1, 1], [1, 0, 1, 1]]
