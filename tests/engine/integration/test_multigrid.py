import dataclasses
import itertools

import graphs
import numpy as np
import pytest

from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.hierarchy import Hierarchy
from mirrorskin.engine.integration.levels import cut_levels
from mirrorskin.engine.integration.vcycle import Multigrid, VCycle
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT

SHAPES = [(45, 70), (1, 33), (29, 1), (3, 5), (2, 2), (64, 48)]


def given(device, name, values):
    array = device.array(name, values.shape, np.float32)
    array.host[...] = values
    array.upload()
    return array


def links_of(device, graph):
    arrays = [given(device, name, getattr(graph, name)) for name in ("right", "down", "source")]
    anchor = None if graph.anchor is None else given(device, "anchor", graph.anchor)
    return Links(device, graph.right.shape, arrays[0], arrays[1], anchor, arrays[2])


def heights_of(solution):
    heights = solution.height.download().astype(float)
    solution.height.upload()
    return heights


def error_of(graph, heights):
    exact = graph.solve()
    return np.abs(graph.centred(heights) - exact).max() / max(np.ptp(exact), 1e-12)


@pytest.mark.parametrize("anchored", [False, True], ids=["free", "anchored"])
@pytest.mark.parametrize("kind", graphs.KINDS)
def test_heights_are_those_of_a_sparse_direct_solver(device, kind, anchored):
    graph = graphs.pixel_graph(kind, (45, 70), anchored)
    found = Multigrid(links_of(device, graph)).solve(tolerance=1e-6)
    assert found.converged
    assert found.residual <= 1e-6
    assert error_of(graph, heights_of(found)) < 5e-6
    assert 2 <= found.iterations <= 16


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_pictures_of_any_size_are_solved(device, shape):
    graph = graphs.pixel_graph("cuts", shape)
    assert error_of(graph, heights_of(Multigrid(links_of(device, graph)).solve(tolerance=1e-6))) < 1e-5


@pytest.mark.parametrize("kind", ["disc", "cuts", "holes"])
def test_the_residual_tells_the_error_within_a_factor_of_three(device, kind):
    graph = graphs.pixel_graph(kind, (60, 90))
    exact, matrix = graph.solve().ravel(), graph.matrix
    solver = Multigrid(links_of(device, graph))
    for tolerance in (1e-2, 1e-3, 1e-4):
        found = solver.solve(tolerance=tolerance)
        error = graph.centred(heights_of(found)).ravel() - exact
        share = np.sqrt(error @ (matrix @ error) / (exact @ (matrix @ exact)))
        assert found.residual <= tolerance
        assert share / 3 <= found.residual <= 3 * share


def test_cuts_cost_no_more_than_twice_the_iterations_of_a_mask(device):
    iterations = {}
    for kind in ("disc", "cuts", "soft"):
        graph = graphs.pixel_graph(kind, (200, 200))
        iterations[kind] = Multigrid(links_of(device, graph)).solve(tolerance=3e-5).iterations
    assert iterations["cuts"] <= 2 * iterations["disc"]
    assert iterations["soft"] <= 2 * iterations["disc"]


def test_without_a_tolerance_two_cycles_are_done(device):
    graph = graphs.pixel_graph("disc", (45, 70))
    found = Multigrid(links_of(device, graph)).solve(tolerance=None)
    assert found.iterations == 2
    assert found.converged
    assert error_of(graph, heights_of(found)) < 2e-3


def test_a_limit_that_is_too_low_is_told(device):
    found = Multigrid(links_of(device, graphs.pixel_graph("holes", (45, 70)))).solve(tolerance=1e-6, limit=2)
    assert found.iterations == 2
    assert not found.converged
    assert found.residual > 1e-6


def test_a_deadline_that_is_over_allows_one_cycle(device):
    solver = Multigrid(links_of(device, graphs.pixel_graph("holes", (45, 70))))
    assert solver.solve(tolerance=1e-6, deadline=0.0).iterations == 1


def test_the_solution_as_a_start_needs_no_more_than_a_cycle(device):
    graph = graphs.pixel_graph("cuts", (45, 70))
    solver = Multigrid(links_of(device, graph))
    start = given(device, "start", heights_of(solver.solve(tolerance=1e-7)))
    again = solver.solve(start, tolerance=1e-5)
    assert again.iterations <= 1
    assert error_of(graph, heights_of(again)) < 1e-5


def test_a_solver_takes_one_graph_after_the_other(device):
    solver = None
    for number, (kind, anchored) in enumerate(
        [("disc", False), ("holes", True), ("cuts", False), ("disc", True)]
    ):
        graph = graphs.pixel_graph(kind, (45, 70), anchored, seed=number)
        links = links_of(device, graph)
        if solver is None:
            solver = Multigrid(links)
        else:
            solver.rebuild(links)
        assert error_of(graph, heights_of(solver.solve(tolerance=1e-6))) < 1e-5


def test_what_float32_cannot_reach_is_told_and_the_next_graph_is_solved(device):
    length = 3000  # a corridor so long that rounding bends it more than the tolerance
    corridor = graphs.pixel_graph("rectangle", (1, length))
    corridor.source[...] = np.random.default_rng(0).normal(size=(1, length))
    corridor.source -= corridor.source.mean()
    solver = Multigrid(links_of(device, corridor))
    found = solver.solve(tolerance=1e-9)
    assert not found.converged
    assert found.iterations < 30
    again = graphs.pixel_graph("rectangle", (1, length))
    again.source[...] = 0
    again.source[0, 0], again.source[0, -1] = -1, 1
    solver.rebuild(links_of(device, again))
    assert error_of(again, heights_of(solver.solve(tolerance=1e-4))) < 1e-3


def test_what_asks_for_nothing_is_level_at_once(device):
    graph = graphs.pixel_graph("holes", (45, 70))
    graph.source[...] = 0
    found = Multigrid(links_of(device, graph)).solve(tolerance=1e-6)
    assert (found.iterations, found.residual, found.converged) == (0, 0.0, True)
    assert not heights_of(found).any()


def test_the_same_graph_gives_the_same_bits(device):
    graph = graphs.pixel_graph("cuts", (45, 70))
    one, two = (heights_of(Multigrid(links_of(device, graph)).solve()) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_weights_of_any_size_are_solved(device):
    graph = graphs.pixel_graph("uneven", (45, 70))
    graph.right, graph.down, graph.source = graph.right * 1e6, graph.down * 1e6, graph.source * 1e6
    assert error_of(graph, heights_of(Multigrid(links_of(device, graph)).solve(tolerance=1e-6))) < 1e-5


@pytest.mark.parametrize("anchored", [False, True], ids=["free", "anchored"])
@pytest.mark.parametrize("kind", ["disc", "cuts", "holes"])
def test_half_cycles_in_one_pass_do_what_single_passes_do(kind, anchored):
    graph = graphs.pixel_graph(kind, (150, 270), anchored)
    answers = []
    for shape in (CPU_LAYOUT, GPU_LAYOUT):
        device = Device(device_layer._find()[0])
        device.info = dataclasses.replace(device.info, shares_memory=False)
        device.layout, device.tuned = shape, True
        links = links_of(device, graph)
        hierarchy = Hierarchy(graph.right.shape, anchored, device)
        hierarchy.build(links)
        cycle = VCycle(hierarchy)
        cycle.prepare()
        hierarchy.copy_picture("admit", cycle.full_b, links.source)
        to = given(device, "to", np.zeros(hierarchy.levels[0].end))
        cycle.start(to)
        hierarchy.copy_picture("admit", cycle.b, links.source)
        product = cycle.run()
        finest = hierarchy.levels[0].end
        answers.append((product, to.download().copy(), cycle.x.download()[:finest].copy()))
    (one, first, other), (two, second, another) = answers
    np.testing.assert_allclose(one, two, rtol=1e-5)
    np.testing.assert_allclose(first, second, atol=2e-5 * np.ptp(second))
    np.testing.assert_allclose(other, another, atol=2e-5 * np.ptp(another))


@pytest.mark.parametrize("shape", [(480, 640), (1, 1), (5, 4), (1, 1000), (33, 17)])
def test_levels_halve_and_never_overlap(shape):
    levels = cut_levels(shape)
    assert (levels[0].rows, levels[0].columns) == shape
    assert max(levels[-1].rows, levels[-1].columns) <= 4
    for fine, coarse in itertools.pairwise(levels):
        assert (coarse.rows, coarse.columns) == (-(-fine.rows // 2), -(-fine.columns // 2))
        assert coarse.base >= fine.end
        assert coarse.stride >= fine.stride / 2
