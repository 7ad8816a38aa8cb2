"""Heights against formulas and against float64 solved directly (tests/support/slope_oracle.py)."""

import itertools
import pickle
from functools import cache

import numpy as np
import pytest
import slope_oracle
import surfaces
from slope_oracle import Problem

from mirrorskin import engine, io

SHAPE, PIXEL = (49, 62), (0.03, 0.05)
MASKS = {
    "rectangle": np.ones(SHAPE, bool),
    "disc": surfaces.disc(SHAPE),
    "hole": surfaces.disc(SHAPE, hole=0.4),
    "blobs": surfaces.blobs(SHAPE),
    "two contacts": surfaces.two_contacts(SHAPE),
    "one-pixel bridge": surfaces.two_contacts(SHAPE, bridge=True),
    "single pixels": surfaces.specks(SHAPE),
    "20 % holes": surfaces.holes(SHAPE),
    "comb": surfaces.comb(SHAPE),
    "spiral": surfaces.spiral(SHAPE),
}
EXACT = {  # what links between neighbours lose nothing of
    "plane": surfaces.plane(0.3, -0.7),
    "nearly upright plane": surfaces.plane(*surfaces.STEEP),
    "bowl": surfaces.quadratic(0.02, 0.004, 0.015, 0.1, -0.2),
    "saddle": surfaces.quadratic(0.03, 0.05, -0.02),
}
CURVED = {
    "bump": surfaces.bump(9, 12, 3, -2),
    "bump cut by the border": surfaces.bump(12, 15, 28, 20),
    "waves": surfaces.cosines(17, 2.5),
}


def problem(surface, noise=0.0, seed=0, pixel_size=PIXEL, shape=SHAPE, **options):
    """Sample a surface, with noise of the slopes."""
    seen = surfaces.sample(surface, shape, pixel_size)
    added = np.random.default_rng([seed, 11]).normal(0, noise, (2, *shape))
    return Problem(seen.dz_dx + added[0], seen.dz_dy + added[1], pixel_size, **options)


def truth(surface, pixel_size=PIXEL, shape=SHAPE):
    return surfaces.sample(surface, shape, pixel_size).height


def integrated(asked, device, **more):
    return engine.integrate(*asked.arguments, **asked.options, **{"sigma": False, **more}, device=device)


def worst(found, expected, mask):
    """Return the largest error as a share of the range, each component about its own mean."""
    assert np.array_equal(np.isfinite(found.height), mask)
    assert np.array_equal(found.component >= 0, mask)
    error = np.where(mask, found.height - expected, np.nan)
    for label in range(len(found.offset_unknown)):
        within = found.component == label
        error[within] -= error[within].mean()
    return np.abs(error[mask]).max() / np.ptp(expected[mask])


@cache
def _solved(pickled):
    return slope_oracle.solve(pickle.loads(pickled))


def apart(found, asked):
    """Return how far heights are from the direct solve's, as a share of their range."""
    expected = _solved(pickle.dumps(asked))  # once for all devices
    np.testing.assert_array_equal(found.component, expected.component)
    np.testing.assert_array_equal(found.offset_unknown.astype(bool), expected.offset_unknown)
    np.testing.assert_array_equal(np.isfinite(found.height), np.isfinite(expected.height))
    return np.nanmax(np.abs(found.height - expected.height)) / np.ptp(
        expected.height[expected.component >= 0]
    )


def uneven(shape=SHAPE, seed=0):
    """Return weights (2, H, W) as normals have them: other on other flanks, and from pixel to pixel."""
    x, y = surfaces.places(shape)
    smooth = np.exp(np.stack([np.sin(x / 9 + y / 14), np.cos(y / 8 - x / 21)]))
    return smooth * np.exp(np.random.default_rng([seed, 12]).normal(0, 0.3, smooth.shape))


@pytest.mark.parametrize(
    ("surface", "mask"),
    [*itertools.product(("nearly upright plane", "bowl"), MASKS), ("plane", "disc"), ("saddle", "blobs")],
)
def test_planes_and_quadratics_are_exact_on_any_mask(device, surface, mask):
    found = integrated(problem(EXACT[surface], mask=MASKS[mask]), device)
    assert found.converged
    assert found.invalid == 0
    assert worst(found, truth(EXACT[surface]), MASKS[mask]) <= 1e-4


@pytest.mark.parametrize("kind", [surfaces.comb, surfaces.holes])
def test_a_quadratic_is_exact_on_larger_masks_too(device, kind):
    shape, square = (97, 130), (1.0, 1.0)
    mask, bowl = kind(shape), surfaces.quadratic(0.004, 0.001, 0.003, 0.1, -0.2)
    found = integrated(problem(bowl, pixel_size=square, shape=shape, mask=mask), device)
    assert worst(found, truth(bowl, square, shape), mask) <= 1e-4


@pytest.mark.parametrize("sigma", [3, 10, 40])
@pytest.mark.parametrize("region", ["rectangle", "disc"])
def test_a_bump_of_any_size_has_its_height(device, sigma, region):
    shape = 240, 320
    mask = surfaces.disc(shape) if region == "disc" else np.ones(shape, bool)
    bump, square = surfaces.bump(sigma, 0.6 * sigma), (0.03, 0.03)
    found = integrated(problem(bump, pixel_size=square, shape=shape, mask=mask), device)
    expected = truth(bump, square, shape)
    assert np.nanmax(found.height) - np.nanmin(found.height) == pytest.approx(
        np.ptp(expected[mask]), rel=0.002
    )


@pytest.mark.parametrize(("surface", "noise"), [("bump cut by the border", 0.0), ("waves", 0.2)])
@pytest.mark.parametrize("mask", MASKS)
def test_it_is_as_the_direct_solve(device, mask, surface, noise):
    asked = problem(CURVED[surface], noise, mask=MASKS[mask])
    assert apart(integrated(asked, device), asked) <= 1e-4


@pytest.mark.parametrize("mask", ["rectangle", "disc", "20 % holes", "single pixels"])
def test_weights_are_as_in_the_direct_solve(device, mask):
    weights = uneven()
    weights[:, 20:23, 5:40] = 0
    weights[1, 30:40, 8] = 0  # a slope along x alone
    asked = problem(CURVED["bump"], 0.2, mask=MASKS[mask], slope_weights=weights)
    assert apart(integrated(asked, device), asked) <= 1e-4


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1e12])
def test_only_the_ratio_of_weights_matters(device, scale):
    asked = problem(CURVED["bump"], 0.2, mask=MASKS["disc"], slope_weights=scale * uneven())
    assert apart(integrated(asked, device), asked) <= 1e-4


@pytest.mark.parametrize("mask", ["rectangle", "disc", "20 % holes"])
@pytest.mark.parametrize("count", [1, 10, 60])
def test_cuts_are_as_in_the_direct_solve(device, mask, count):
    asked = problem(
        CURVED["waves"], 0.2, mask=MASKS[mask], edges=surfaces.random_cuts(SHAPE, count, seed=count)
    )
    assert apart(integrated(asked, device), asked) <= 1e-4


def test_a_closed_line_of_edges_parts_what_is_within(device):
    edges = surfaces.disc(SHAPE, 0.7) & ~surfaces.disc(SHAPE, 0.62)
    asked = problem(CURVED["bump"], 0.1, edges=edges)
    found = integrated(asked, device)
    centre, corner = found.component[24, 31], found.component[0, 0]
    assert centre != corner
    assert found.offset_unknown.all()
    assert apart(found, asked) <= 1e-4


@pytest.mark.parametrize("mask", ["rectangle", "20 % holes", "two contacts"])
@pytest.mark.parametrize("share", [0.0005, 0.01, 0.3, 1.0])
def test_known_heights_are_as_in_the_direct_solve(device, mask, share):
    generator = np.random.default_rng(5)
    heights = truth(CURVED["bump"]) + generator.normal(0, 0.01, SHAPE)
    heights[generator.random(SHAPE) >= share] = np.nan
    row, column = np.argwhere(MASKS[mask])[100]
    heights[row, column] = 0.1
    pull = np.exp(generator.normal(0, 1, SHAPE)) * 30
    asked = problem(CURVED["bump"], 0.1, mask=MASKS[mask], known_heights=heights, known_height_weights=pull)
    assert apart(integrated(asked, device), asked) <= 1e-4


@pytest.mark.parametrize("pull", [1e-4, 1.0, 1e4, 1e8])
def test_a_rectangle_that_is_held_everywhere_alike(device, pull):
    heights = truth(CURVED["bump"]) + np.random.default_rng(6).normal(0, 0.02, SHAPE)
    asked = problem(CURVED["bump"], 0.1, known_heights=heights, known_height_weights=pull)
    assert apart(integrated(asked, device), asked) <= 1e-4


@pytest.mark.parametrize("offset", [-300.0, 700.0])
@pytest.mark.parametrize("mask", ["rectangle", "disc"])
def test_heights_far_from_zero_lose_nothing(device, offset, mask):
    heights = offset + truth(CURVED["bump"], (0.3, 0.5))
    heights[np.random.default_rng(7).random(SHAPE) > 0.05] = np.nan
    asked = problem(CURVED["bump"], 0.1, pixel_size=(0.3, 0.5), mask=MASKS[mask], known_heights=heights)
    assert apart(integrated(asked, device), asked) <= 1e-4


def test_each_component_is_held_by_its_own_known_heights(device):
    mask = MASKS["two contacts"]
    heights = np.full(SHAPE, np.nan)
    right = mask & (surfaces.places(SHAPE)[0] > 0)
    heights[right] = 5 + truth(EXACT["bowl"])[right]
    asked = problem(EXACT["bowl"], mask=mask, known_heights=heights)
    found = integrated(asked, device)
    assert not found.offset_unknown[found.component[24, 46]]
    assert found.offset_unknown[found.component[24, 15]]
    np.testing.assert_allclose(found.height[right], heights[right], atol=1e-4)
    assert np.nanmean(found.height[mask & ~right]) == pytest.approx(0, abs=1e-5)


def test_a_known_height_without_a_slope_stands_alone(device):
    mask = np.ones(SHAPE, bool)
    dz_dx, dz_dy, _ = problem(EXACT["bowl"]).arguments
    dz_dx[10, 10] = np.nan
    heights = np.full(SHAPE, np.nan)
    heights[10, 10] = 7.0
    asked = Problem(dz_dx, dz_dy, PIXEL, mask=mask, known_heights=heights)
    found = integrated(asked, device)
    assert found.height[10, 10] == pytest.approx(7, abs=1e-5)
    assert found.offset_unknown.astype(bool).tolist() == [True, False]
    assert apart(found, asked) <= 1e-4


@pytest.mark.parametrize("region", ["rectangle", "disc"])
def test_refinement_is_of_second_order(device, region):
    errors = []
    for size in (32, 64, 128):
        shape = size, size
        mask = surfaces.disc(shape, 0.99) if region == "disc" else np.ones(shape, bool)
        surface, pixel = surfaces.cosines(size / 3.3, size / 12), 3.0 / size
        found = integrated(problem(surface, pixel_size=(pixel, pixel), shape=shape, mask=mask), device)
        errors.append(worst(found, truth(surface, (pixel, pixel), shape), mask))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[0] < 0.05
    assert (orders >= 1.9).all() or errors[-1] < 1e-5, (errors, orders)


NOISY = (24, 27)
REGIONS = {
    "rectangle": np.ones(NOISY, bool),
    "disc": surfaces.disc(NOISY),
    "20 % holes": surfaces.holes(NOISY),
}


@cache
def spread(region, weighing):
    """Return a problem, and how its noise goes through the best linear unbiased estimate."""
    weights = {"even": None, "uneven": 400 * uneven(NOISY)}[weighing]
    asked = Problem(np.zeros(NOISY), np.zeros(NOISY), PIXEL, mask=REGIONS[region], slope_weights=weights)
    return asked, slope_oracle.propagation(asked, best=True), np.sqrt(slope_oracle.variance(asked))


@pytest.mark.parametrize("weighing", ["even", "uneven"])
@pytest.mark.parametrize("region", REGIONS)
def test_noise_spreads_as_in_the_best_linear_estimate(device, region, weighing):
    """What the best estimate errs by has nothing in common with what another errs by beyond it."""
    asked, best, sigma = spread(region, weighing)
    generator = np.random.default_rng(8)
    beyond = []
    for _ in range(6):
        noise = sigma * generator.normal(size=sigma.shape)
        dz_dx, dz_dy = noise.reshape(2, *NOISY)
        found = integrated(Problem(dz_dx, dz_dy, PIXEL, **asked.options), device)
        beyond.append(found.height[REGIONS[region]] - best @ noise)
    assert np.any(beyond)
    assert np.sqrt(1 + np.mean(np.square(beyond)) / np.mean(best**2 @ sigma**2)) <= 1.05


@pytest.mark.parametrize("weighing", ["even", "uneven"])
@pytest.mark.parametrize("region", REGIONS)
def test_the_energy_loses_little_to_the_best_linear_estimate(region, weighing):
    asked, best, sigma = spread(region, weighing)
    energy = slope_oracle.height_variance(asked)
    assert 1 <= np.sqrt(energy.mean() / np.mean(best**2 @ sigma**2)) <= 1.05


def tiles(values, mask, size=8):
    """Return means over tiles of so many pixels that are at least half in the mask."""
    found = []
    for row in range(0, mask.shape[0], size):
        for column in range(0, mask.shape[1], size):
            tile = np.s_[row : row + size, column : column + size]
            if mask[tile].sum() >= size * size / 2:
                found.append(values[tile][mask[tile]].mean())
    return np.array(found)


@pytest.mark.parametrize(
    ("region", "weighing"), [("rectangle", "even"), ("disc", "uneven"), ("20 % holes", "even")]
)
def test_sigma_is_honest(region, weighing):
    asked, _, sigma = spread(region, weighing)
    mask = REGIONS[region]
    told = 0.05 if weighing == "even" else 1.0  # without weights the noise is told from the misfit
    expected = np.full(NOISY, np.nan)
    expected[mask] = told**2 * slope_oracle.height_variance(asked)
    dz_dx, dz_dy = (told * sigma * np.random.default_rng(9).normal(size=sigma.shape)).reshape(2, *NOISY)
    found = integrated(Problem(dz_dx, dz_dy, PIXEL, **asked.options), None, sigma=True)
    np.testing.assert_array_equal(np.isfinite(found.sigma), mask)
    large = mask & (expected > 0.05 * np.nanmean(expected))  # no lonely pixel, which has no error
    share = expected / np.where(large, found.sigma.astype(float), np.inf) ** 2
    assert share[large].mean() == pytest.approx(1, abs=0.15)
    np.testing.assert_allclose(tiles(share, large), 1, atol=0.4)


def test_sigma_knows_of_known_heights():
    mask, heights = surfaces.disc(NOISY), np.full(NOISY, np.nan)
    heights[10:14, 3:6] = 0.0
    asked = Problem(np.zeros(NOISY), np.zeros(NOISY), PIXEL, mask, np.full(NOISY, 400.0), None, heights, 1e5)
    found = integrated(asked, None, sigma=True)
    moves = slope_oracle.propagation(asked)
    graph = slope_oracle.build(asked)
    held = np.linalg.inv(
        (graph.difference.T * graph.weight @ graph.difference).toarray() + np.diag(graph.pull)
    )
    expected = moves**2 @ slope_oracle.variance(asked) + (held * graph.pull) ** 2 @ np.where(
        graph.pull > 0, 1 / np.maximum(graph.pull, 1e-300), 0
    )
    share = expected / found.sigma[mask].astype(float) ** 2
    assert share.mean() == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("shape", [(1, 2), (2, 1), (1, 57), (43, 1), (2, 2), (3, 2), (5, 5)])
@pytest.mark.parametrize("masked", [False, True])
def test_thin_and_tiny_pictures(device, shape, masked):
    mask = np.ones(shape, bool)
    if masked:
        mask.flat[0] = False
    surface = EXACT["bowl"]
    found = integrated(problem(surface, shape=shape, mask=mask), device)
    expected = truth(surface, shape=shape)
    expected = expected - expected[mask].mean()
    np.testing.assert_allclose(
        found.height[mask], expected[mask], atol=1e-4 * max(np.ptp(expected[mask]), 1e-3)
    )
    np.testing.assert_array_equal(np.isnan(found.height), ~mask)


def test_a_picture_of_one_pixel(device):
    one = np.array([[0.3]])
    found = engine.integrate(one, one, 0.1, device=device)
    assert found.height.tolist() == [[0.0]]
    assert found.offset_unknown.astype(bool).tolist() == [True]
    known = engine.integrate(one, one, 0.1, known_heights=np.array([[4.25]]), device=device)
    assert known.height.tolist() == [[4.25]]
    assert known.offset_unknown.astype(bool).tolist() == [False]


def test_nothing_but_single_pixels(device):
    mask = np.indices((9, 12)).sum(axis=0) % 2 == 0
    found = integrated(problem(EXACT["bowl"], shape=(9, 12), mask=mask), device)
    np.testing.assert_array_equal(found.height[mask], 0)
    np.testing.assert_array_equal(found.component[mask], np.arange(mask.sum()))
    assert found.offset_unknown.all()


@pytest.mark.parametrize("why", ["all masked", "all NaN", "all weights 0"])
def test_nothing_to_answer_is_refused(device, why):
    dz_dx, dz_dy, _ = problem(EXACT["bowl"]).arguments
    options = {}
    if why == "all masked":
        options["mask"] = np.zeros(SHAPE, np.uint8)
    elif why == "all NaN":
        dz_dx = np.full(SHAPE, np.nan)
    else:
        options["slope_weights"] = 0.0
    with pytest.raises(io.InputError) as told:
        engine.integrate(dz_dx, dz_dy, PIXEL, **options, device=device)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_slopes_that_are_no_numbers_are_left_out_and_counted(device, bad):
    mask = surfaces.disc(SHAPE)
    spots = np.random.default_rng(10).random((2, *SHAPE)) < 0.03
    asked = problem(CURVED["bump"], 0.1, mask=mask)
    asked.dz_dx[spots[0]], asked.dz_dy[spots[1]] = bad, np.nan
    found = integrated(asked, device)
    assert found.invalid == (spots.any(axis=0) & mask).sum() > 50
    assert apart(found, asked) <= 1e-4


def test_y_runs_up_the_picture(device):
    level, rising = np.zeros((6, 4)), np.ones((6, 4))
    up = engine.integrate(level, rising, (2.0, 0.5), device=device).height
    np.testing.assert_allclose(np.diff(up, axis=0), -0.5, atol=1e-6)
    right = engine.integrate(rising, level, (2.0, 0.5), device=device).height
    np.testing.assert_allclose(np.diff(right, axis=1), 2.0, atol=1e-6)


@pytest.mark.parametrize("pixel", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("mask", ["rectangle", "disc"])
def test_pixels_of_any_size(device, pixel, mask):
    size = pixel, 1.6 * pixel
    heights = truth(CURVED["bump"], size)
    heights[np.random.default_rng(11).random(SHAPE) > 0.02] = np.nan
    for options in ({}, {"known_heights": heights, "known_height_weights": 100 / pixel**2}):
        asked = problem(CURVED["bump"], 0.1, pixel_size=size, mask=MASKS[mask], **options)
        assert apart(integrated(asked, device), asked) <= 1e-4


@pytest.mark.parametrize("mask", ["rectangle", "disc"])
def test_any_array_will_do(device, mask):
    asked = problem(CURVED["bump"], 0.1, mask=MASKS[mask])
    rounded = [part.astype(np.float32) for part in (asked.dz_dx, asked.dz_dy)]
    expected = integrated(Problem(*rounded, PIXEL, MASKS[mask]), device).height
    for parts in (
        [part.astype(np.float64) for part in rounded],
        [np.asfortranarray(part) for part in rounded],
        [np.repeat(part, 2, axis=1)[:, ::2] for part in rounded],
        [part.tolist() for part in rounded],
    ):
        found = engine.integrate(
            *parts, PIXEL, mask=7 * MASKS[mask].astype(np.int16), sigma=False, device=device
        )
        np.testing.assert_array_equal(found.height, expected)


def test_the_same_call_gives_the_same_bits(device):
    edges = surfaces.random_cuts(SHAPE, 8)
    asked = problem(CURVED["waves"], 0.2, mask=MASKS["20 % holes"], edges=edges, slope_weights=uneven())
    first, second = (integrated(asked, device) for _ in range(2))
    for name in ("height", "component", "offset_unknown"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    assert (first.iterations, first.residual) == (second.iterations, second.residual)


def test_the_same_call_gives_the_same_sigma():
    asked = problem(CURVED["bump"], 0.2, mask=MASKS["two contacts"])
    first, second = (integrated(asked, None, sigma=True).sigma for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("mask", ["rectangle", "20 % holes", "single pixels"])
def test_a_floating_component_has_the_mean_0(device, mask):
    found = integrated(problem(CURVED["bump"], 0.2, mask=MASKS[mask]), device)
    assert found.offset_unknown.all()
    for label in range(len(found.offset_unknown)):
        own = found.height[found.component == label].astype(float)
        assert abs(own.mean()) <= 1e-5 * np.ptp(found.height[MASKS[mask]])
