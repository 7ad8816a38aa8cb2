import dataclasses

import graphs
import numpy as np
import pytest

from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.hierarchy import Hierarchy
from mirrorskin.engine.integration.vcycle import Multigrid, VCycle
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT

SHAPES = [(1, 33), (29, 1), (2, 2), (64, 48)]


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
    assert error_of(graph, heights_of(found)) < 2e-5  # it is the energy that is within 1e-6
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


def test_a_limit_that_is_too_low_is_reported(device):
    found = Multigrid(links_of(device, graphs.pixel_graph("holes", (45, 70)))).solve(tolerance=1e-6, limit=2)
    assert found.iterations == 2
    assert not found.converged
    assert found.residual > 1e-6


def test_a_deadline_that_is_over_allows_one_cycle(device):
    solver = Multigrid(links_of(device, graphs.pixel_graph("holes", (45, 70))))
    assert solver.solve(tolerance=1e-6, deadline=0.0).iterations == 1


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


def test_what_float32_cannot_reach_is_reported_and_the_next_graph_is_solved(device):
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


@pytest.mark.parametrize(("kind", "anchored"), [("disc", True), ("cuts", False), ("holes", True)])
def test_half_cycles_in_one_pass_do_what_single_passes_do(kind, anchored):
    graph = graphs.pixel_graph(kind, (150, 270), anchored)
    answers = []
    for shape in (CPU_LAYOUT, GPU_LAYOUT):
        device = Device(device_layer._find()[0])
        device.info = dataclasses.replace(device.info, shares_memory=False)
        device.layout = shape
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
