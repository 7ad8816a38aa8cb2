"""Several surfaces at once: the same results as each one alone."""

from __future__ import annotations

import graphs
import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.integration.graph import Links
from mirrorskin.engine.integration.hierarchy import choose_lanes
from mirrorskin.engine.integration.multigrid import Multigrid
from mirrorskin.evaluation.scenes import surfaces

SHAPE = 61, 83
DISC = surfaces.disc(SHAPE)
RANDOM = np.random.default_rng(4)
KNOWN = np.where(RANDOM.random(SHAPE) < 0.01, RANDOM.normal(size=SHAPE), np.nan)
GRAPHS = {
    "mask": {"mask": DISC},
    "known heights": {"mask": DISC, "known_heights": KNOWN},
    "weights": {"slope_weights": np.exp(RANDOM.normal(size=(2, *SHAPE)))},
    "rectangle": {},
    "rectangle with heights": {"known_heights": RANDOM.normal(size=SHAPE)},
}


def slopes(count, seed=0):
    """Return slopes of surfaces with noise, of which the last one is level."""
    noise = np.random.default_rng(seed).normal(0, 0.05, (2, count, *SHAPE))
    for number in range(count - 1):
        noise[:, number] += surfaces.sample(surfaces.cosines(11.0 + number, 1.5), SHAPE)[:2]
    noise[:, -1] = 0
    return noise.astype(np.float32)


@pytest.mark.parametrize(
    ("graph", "count"),
    [("mask", 18), ("known heights", 3), ("weights", 1), ("rectangle", 18), ("rectangle with heights", 3)],
)
def test_each_surface_is_that_found_alone(device, graph, count):
    gradients, options = slopes(count), {**GRAPHS[graph], "tolerance": 1e-6, "device": device}
    surface = engine.integrate(*gradients, 0.5, **options)
    assert surface.height.shape == (count, *SHAPE)
    assert surface.height_sigma.shape == surface.component.shape == SHAPE
    for pair, height in zip(np.moveaxis(gradients, 1, 0), surface.height, strict=True):
        alone = engine.integrate(*pair, 0.5, sigma=False, **options)
        np.testing.assert_allclose(height, alone.height, atol=1e-5 * max(1.0, np.nanmax(alone.height)))
        assert alone.process["integration"] == surface.process["integration"]
        np.testing.assert_array_equal(alone.component, surface.component)


def test_the_noise_is_that_of_all_surfaces():
    gradients = np.random.default_rng(1).normal(0, [[[[0.01]], [[0.03]]]], (2, 2, *SHAPE))
    both = engine.integrate(*gradients, 1.0, mask=DISC).height_sigma
    first, other = (engine.integrate(*gradients[:, k], 1.0, mask=DISC).height_sigma for k in (0, 1))
    np.testing.assert_allclose(both[DISC], np.sqrt((first**2 + other**2) / 2)[DISC], rtol=1e-3)


@pytest.mark.parametrize("mask", [DISC, None], ids=["disc", "rectangle"])
def test_a_pixel_without_a_slope_of_one_surface_is_left_out_of_all(mask):
    gradients, lost = slopes(3), np.zeros(SHAPE, bool)
    lost[30:33, 40:42] = True
    gradients[1, 1][lost] = np.nan
    surface = engine.integrate(*gradients, 0.5, mask=mask)
    agreed = engine.integrate(*np.where(lost, np.nan, gradients), 0.5, mask=mask)
    assert np.isnan(surface.height[:, lost]).all()
    assert surface.process["integration_invalid"] == agreed.process["integration_invalid"] == lost.sum()
    np.testing.assert_array_equal(surface.height, agreed.height)


@pytest.mark.parametrize("kind", ["comb", "cuts", "uneven"])
@pytest.mark.parametrize("anchored", [False, True], ids=["free", "anchored"])
def test_any_graph_is_solved_for_many_right_sides(device, kind, anchored):
    graph = graphs.pixel_graph(kind, (45, 70), anchored)
    sources = np.random.default_rng(0).normal(size=(6, 45, 70))
    sources = np.stack([graph.centred(values) for values in sources])
    maps = [device.from_host("links", getattr(graph, name)) for name in ("right", "down")]
    anchor = device.from_host("anchor", graph.anchor) if anchored else None
    solver = Multigrid(Links(device, (45, 70), *maps, anchor, device.from_host("source", sources[0])))
    solution = solver.solve_many(device.from_host("sources", sources), tolerance=1e-6)
    assert solution.converged
    for source, height in zip(sources, solution.height.read(), strict=True):
        graph.source[...] = source
        exact = graph.solve()
        np.testing.assert_allclose(graph.centred(height), exact, atol=2e-5 * np.ptp(exact))


def test_a_product_with_a_matrix_is_one_with_its_columns(device):
    right, down, held = np.ones((9, 10)), np.ones((8, 11)), np.full((9, 11), 0.1)
    columns = RANDOM.normal(size=(99, 5)) * [1, 1e-6, 1e6, 0, 1]
    for tolerance in (1e-6, None):
        inverse = engine.integration.invert_laplacian(right, down, held, tolerance=tolerance, device=device)
        product = inverse @ columns
        for column, answer in zip(columns.T, product.T, strict=True):
            np.testing.assert_allclose(answer, inverse @ column, atol=1e-5 * np.abs(answer).max())


def test_lanes_are_no_more_than_sides_need(device):
    assert choose_lanes(device, 1) == 1
    assert choose_lanes(device, 2) == 4
    assert choose_lanes(device, 40) in (4, 8, 16)


NONE, PAIR = np.zeros((0, *SHAPE)), slopes(2)
BAD = {
    "shapes (0, 61, 83) and (0, 61, 83)": (NONE, NONE, {}),
    "shapes (2, 61, 83) and (61, 83)": (PAIR[0], PAIR[0, 0], {}),
    "two maps of one size (H, W), or (K, H, W)": (PAIR[0][np.newaxis], PAIR[1][np.newaxis], {}),
    "mask: shape (2, 61, 83)": (*PAIR, {"mask": np.ones_like(PAIR[0])}),
    "two maps of one size (H, W) are": (*PAIR, {"robust": True}),
    "shapes (2, 61, 83)": (*PAIR, {"initial_heights": np.zeros(SHAPE)}),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_refused_in_one_line(message):
    x, y, options = BAD[message]
    with pytest.raises(io.InputError) as error:
        engine.integrate(x, y, 1.0, **options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
