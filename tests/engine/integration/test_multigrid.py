import dataclasses

import graphs
import numpy as np
import pytest

from mirrorskin.engine.integration.cycle import Cycle
from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.hierarchy import Hierarchy
from mirrorskin.engine.integration.multigrid import Multigrid
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT

SHAPES = [(1, 33), (29, 1), (2, 2), (64, 48)]
# For a residual of 1e-6; at most one and a half times what three draws of each took.
CYCLES = dict.fromkeys(["rectangle", "disc", "annulus"], 5) | {"holes": 13, "cuts": 15, "soft": 20}
CYCLES |= {"uneven": 20, "isolated": 16, "comb": 45}


def upload(device, name, values):
    array = device.array(name, values.shape, np.float32)
    array.write(values)
    return array


def links_of(device, graph):
    arrays = [upload(device, name, getattr(graph, name)) for name in ("right", "down", "source")]
    anchor = None if graph.anchor is None else upload(device, "anchor", graph.anchor)
    return Links(device, graph.right.shape, arrays[0], arrays[1], anchor, arrays[2])


def heights_of(solution):
    return solution.height.read().astype(float)


def error_of(graph, heights):
    exact = graph.solve()
    return np.abs(graph.centred(heights) - exact).max() / max(np.ptp(exact), 1e-12)


@pytest.mark.parametrize("anchored", [False, True], ids=["free", "anchored"])
@pytest.mark.parametrize("kind", graphs.KINDS)
def test_heights_are_those_of_a_sparse_direct_solver(device, kind, anchored):
    graph = graphs.pixel_graph(kind, (45, 70), anchored)
    solution = Multigrid(links_of(device, graph)).solve(tolerance=1e-6)
    assert solution.converged
    assert solution.residual <= 1e-6
    assert error_of(graph, heights_of(solution)) < 1e-5  # it is the energy that is within 1e-6
    assert 2 <= solution.iterations <= CYCLES[kind]


@pytest.mark.parametrize("anchored", [False, True], ids=["free", "anchored"])
@pytest.mark.parametrize("kind", ["disc", "cuts", "holes", "soft", "uneven", "isolated"])
def test_a_cycle_is_symmetric_and_positive_definite(device, kind, anchored):
    graph = graphs.pixel_graph(kind, (75, 130), anchored)
    hierarchy = Hierarchy(graph.right.shape, anchored, device)
    hierarchy.build(links_of(device, graph))
    cycle = Cycle(hierarchy)
    cycle.prepare()
    rng = np.random.default_rng(0)
    right = [graph.centred(rng.normal(size=graph.right.shape)) for _ in range(4)]
    # And one whose heights cycles hardly change: what is left of noise after some.
    slow = rng.normal(size=graph.right.shape)
    for _ in range(8):
        slow = graph.centred(slow - answer(cycle, image(graph, slow)))
        slow /= np.abs(slow).max()
    right.append(image(graph, slow))
    answers = [answer(cycle, values) for values in right]
    products = np.array([[(values * other).sum() for other in answers] for values in right])
    scale = np.sqrt(np.outer(products.diagonal(), products.diagonal()))
    assert (products.diagonal() > 0).all()
    np.testing.assert_allclose(products / scale, products.T / scale, atol=1e-4)
    assert np.linalg.eigvalsh((products + products.T) / scale).min() > 0


def image(graph, heights):
    return (graph.matrix @ heights.ravel()).reshape(heights.shape)


def answer(cycle, values):
    """Return what a cycle makes of a right side."""
    hierarchy = cycle._h
    hierarchy.copy_picture("admit", cycle.b, upload(hierarchy.device, "b", values))
    cycle.run()
    solution = upload(hierarchy.device, "found", np.zeros(values.shape))
    hierarchy.copy_picture("release", cycle.x, solution)
    return solution.read().astype(float)


@pytest.mark.parametrize("kind", ["comb", "spiral"])
def test_corridors_as_wide_as_a_pixel_are_solved(device, kind):
    shape = 120, 160
    graph = graphs.pixel_graph("comb", shape) if kind == "comb" else spiral(shape)
    solver = Multigrid(links_of(device, graph))
    solution = solver.solve(tolerance=1e-4)
    assert solution.converged
    assert error_of(graph, heights_of(solution)) < 1e-3
    if kind == "spiral":
        assert solver._alone.cycle._factors is not None  # of the second level: cycles alone do not do it


def spiral(shape):
    """Return a graph of a corridor that winds to the middle, walls a pixel wide between its turns."""
    graph = graphs.pixel_graph("rectangle", shape)
    valid = np.zeros(shape, bool)
    (top, first), (bottom, right) = (0, 0), (shape[0] - 1, shape[1] - 1)
    while bottom - top > 3 and right - first > 3:
        valid[top, max(first - 2, 0) : right + 1] = valid[top : bottom + 1, right] = True
        valid[bottom, first : right + 1] = valid[top + 2 : bottom + 1, first] = True
        top, first, bottom, right = top + 2, first + 2, bottom - 2, right - 2
    graph.right[:, :-1] *= valid[:, 1:] & valid[:, :-1]
    graph.down[:-1] *= valid[1:] & valid[:-1]
    rise = np.random.default_rng(0).normal(size=(2, *shape)) + 0.5
    along, across = graph.right * rise[0], graph.down * rise[1]
    graph.source[...] = -along - across
    graph.source[:, 1:] += along[:, :-1]
    graph.source[1:] += across[:-1]
    return graph


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_pictures_of_any_size_are_solved(device, shape):
    graph = graphs.pixel_graph("cuts", shape)
    assert error_of(graph, heights_of(Multigrid(links_of(device, graph)).solve(tolerance=1e-6))) < 1e-5


@pytest.mark.parametrize("kind", ["disc", "cuts", "holes"])
def test_the_residual_estimates_the_error_within_a_factor_of_four(device, kind):
    graph = graphs.pixel_graph(kind, (60, 90))
    exact, matrix = graph.solve().ravel(), graph.matrix
    solver = Multigrid(links_of(device, graph))
    for tolerance in (1e-2, 1e-3, 1e-4):
        solution = solver.solve(tolerance=tolerance)
        error = graph.centred(heights_of(solution)).ravel() - exact
        relative_error = np.sqrt(error @ (matrix @ error) / (exact @ (matrix @ exact)))
        assert solution.residual <= tolerance
        assert relative_error / 4 <= solution.residual <= 4 * relative_error


def test_cuts_cost_few_cycles_more_than_a_mask_does(device):
    limits = {"disc": 4, "cuts": 8, "soft": 15}
    for kind, cycles in limits.items():
        graph = graphs.pixel_graph(kind, (200, 200))
        assert Multigrid(links_of(device, graph)).solve(tolerance=3e-5).iterations <= cycles


def test_without_a_tolerance_two_cycles_are_done(device):
    graph = graphs.pixel_graph("disc", (45, 70))
    solution = Multigrid(links_of(device, graph)).solve(tolerance=None)
    assert solution.iterations == 2
    assert solution.converged
    assert error_of(graph, heights_of(solution)) < 2e-3


def test_a_limit_that_is_too_low_is_reported(device):
    result = Multigrid(links_of(device, graphs.pixel_graph("holes", (45, 70)))).solve(tolerance=1e-6, limit=2)
    assert result.iterations == 2
    assert not result.converged
    assert result.residual > 1e-6


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
    solution = solver.solve(tolerance=1e-9)
    assert not solution.converged
    assert solution.iterations < 30
    again = graphs.pixel_graph("rectangle", (1, length))
    again.source[...] = 0
    again.source[0, 0], again.source[0, -1] = -1, 1
    solver.rebuild(links_of(device, again))
    assert error_of(again, heights_of(solver.solve(tolerance=1e-4))) < 1e-3


@pytest.mark.parametrize(("kind", "anchored"), [("disc", True), ("cuts", False), ("holes", True)])
def test_lanes_of_a_gpu_answer_as_vectors_do(kind, anchored):
    graph = graphs.pixel_graph(kind, (150, 270), anchored)
    answers = []
    for layout in (CPU_LAYOUT, GPU_LAYOUT):
        device = Device(device_layer._find()[0])
        device.info = dataclasses.replace(device.info, shares_memory=False)
        device.layout = layout
        answers.append(Multigrid(links_of(device, graph)).solve(tolerance=1e-6))
    first, other = answers  # a GPU's cycles have fewer launches
    assert other.converged
    assert other.iterations <= first.iterations + 1
    heights = [graph.centred(heights_of(first)) for first in answers]
    np.testing.assert_allclose(*heights, atol=1e-5 * np.ptp(heights[0]))
