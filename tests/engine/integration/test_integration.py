"""Heights from slopes, compared with formulas and a float64 solution (tests/support/slope_oracle.py)."""

from __future__ import annotations

import contextlib
import itertools
import pickle
from functools import cache

import numpy as np
import pytest
import slope_oracle
from slope_oracle import Problem

from mirrorskin import engine, io
from mirrorskin.engine.integration.multigrid import Multigrid
from mirrorskin.evaluation.scenes import surfaces
from mirrorskin.kernels.device import open_device

SHAPE, PIXEL = (49, 62), (0.03, 0.05)
ROW, COLUMN = np.indices(SHAPE)
DISC = surfaces.disc(SHAPE)
MASKS = {
    "rectangle": np.ones(SHAPE, bool),
    "disc": DISC,
    "blobs": surfaces.blobs(SHAPE),
    "two contacts": surfaces.two_contacts(SHAPE),
    "one-pixel bridge": surfaces.two_contacts(SHAPE, bridge=True),
    "single pixels": surfaces.specks(SHAPE),
    "20 % holes": surfaces.holes(SHAPE),
    "comb": surfaces.comb(SHAPE),
    "spiral": surfaces.spiral(SHAPE),
}
STEEP, BOWL = surfaces.plane(*surfaces.STEEP), surfaces.quadratic(0.02, 0.004, 0.015, 0.1, -0.2)
BUMP, WAVES = surfaces.bump(9, 12, 3, -2), surfaces.cosines(17, 2.5)


def problem(surface, noise=0.0, pixel_size=PIXEL, shape=SHAPE, **options):
    """Sample a surface, with noise of the slopes."""
    sampled = surfaces.sample(surface, shape, pixel_size)
    added = np.random.default_rng([0, 11]).normal(0, noise, (2, *shape))
    return Problem(sampled.dz_dx + added[0], sampled.dz_dy + added[1], pixel_size, **options)


def truth(surface, pixel_size=PIXEL, shape=SHAPE):
    return surfaces.sample(surface, shape, pixel_size).height


def integrated(asked, device=None, **more):
    return engine.integrate(*asked.arguments, **asked.options, **{"sigma": False, **more}, device=device)


def worst(actual, expected, mask):
    """Return the largest error as a share of the range, each component about its own mean."""
    assert np.array_equal(np.isfinite(actual.height), mask)
    assert np.array_equal(actual.component >= 0, mask)
    error = np.where(mask, actual.height - expected, np.nan)
    for label in range(len(actual.offset_unknown)):
        within = actual.component == label
        error[within] -= error[within].mean()
    return np.abs(error[mask]).max() / np.ptp(expected[mask])


@cache
def _solved(pickled):
    return slope_oracle.solve(pickle.loads(pickled))


def apart(solved, asked):
    """Return how far heights are from the direct solution's, as a share of their range."""
    expected = _solved(pickle.dumps(asked))  # once for all devices
    np.testing.assert_array_equal(solved.component, expected.component)
    np.testing.assert_array_equal(solved.offset_unknown, expected.offset_unknown)
    np.testing.assert_array_equal(np.isfinite(solved.height), np.isfinite(expected.height))
    return np.nanmax(np.abs(solved.height - expected.height)) / np.ptp(
        expected.height[expected.component >= 0]
    )


def uneven(shape=SHAPE):
    """Return weights (2, H, W) as normals have them: other on other flanks, and from pixel to pixel."""
    x, y = surfaces.places(shape)
    smooth = np.exp(np.stack([np.sin(x / 9 + y / 14), np.cos(y / 8 - x / 21)]))
    return smooth * np.exp(np.random.default_rng([0, 12]).normal(0, 0.3, smooth.shape))


def some(level=0.0, density=0.05):
    """Return known heights of a few pixels."""
    selected = np.random.default_rng(7).random(SHAPE) < density
    return np.where(selected, level + truth(BUMP), np.nan)


@pytest.mark.parametrize("mask", MASKS)
def test_planes_and_quadratics_are_exact_on_any_mask(device, mask):
    for surface in (STEEP, BOWL):
        solved = integrated(problem(surface, mask=MASKS[mask]), device)
        assert solved.process["integration_converged"]
        assert solved.process["integration_invalid"] == 0
        assert worst(solved, truth(surface), MASKS[mask]) <= 1e-4


@pytest.mark.parametrize(("sigma", "region"), [(3, "rectangle"), (40, "disc")])
def test_a_bump_of_any_size_has_its_height(device, sigma, region):
    shape, square = (240, 320), (0.03, 0.03)
    mask = surfaces.disc(shape) if region == "disc" else np.ones(shape, bool)
    bump = surfaces.bump(sigma, 0.6 * sigma)
    solved = integrated(problem(bump, pixel_size=square, shape=shape, mask=mask), device)
    expected = np.ptp(truth(bump, square, shape)[mask])
    assert np.nanmax(solved.height) - np.nanmin(solved.height) == pytest.approx(expected, rel=0.002)


GIVEN = {
    "noise": {},
    "weights of each axis": {"slope_weights": uneven() * np.where((ROW > 20) & (ROW < 23), 0, 1e5)},
    "weights": {"slope_weights": uneven()[0] * 1e-9},
    "edges": {"edges": surfaces.random_cuts(SHAPE, 8)},
    "heights": {"known_heights": some(-20.0)},
    "light heights": {"known_heights": some(), "known_height_weights": 1e-3},
    "all at once": {
        "slope_weights": uneven(),
        "edges": surfaces.random_cuts(SHAPE, 8),
        "known_heights": some(-20.0),
        "known_height_weights": uneven()[1] * 1e3,
    },
}


@pytest.mark.parametrize(
    ("mask", "inputs"),
    [*(("disc", inputs) for inputs in GIVEN), ("rectangle", "noise"), ("20 % holes", "all at once")],
)
def test_heights_are_those_of_a_direct_solution_in_float64(device, mask, inputs):
    asked = problem(WAVES, 0.2, mask=MASKS[mask], **GIVEN[inputs])
    solved = integrated(asked, device)
    assert apart(solved, asked) <= 1e-4
    assert solved.height.dtype == np.float32
    assert solved.process["integration_residual"] <= 1e-5
    assert solved.process["integration"] == (
        "direct" if (mask, inputs) == ("rectangle", "noise") else "multigrid"
    )


def test_a_full_rectangle_with_heights_known_everywhere_is_solved_directly(device):
    asked = problem(WAVES, 0.2, known_heights=truth(BUMP), known_height_weights=300.0)
    solved = integrated(asked, device)
    assert solved.process["integration"] == "direct"
    assert apart(solved, asked) <= 1e-4


@pytest.mark.parametrize("region", ["rectangle", "disc"])
def test_refinement_is_of_second_order(region):
    errors = []
    for size in (32, 64, 128):
        shape = size, size
        mask = surfaces.disc(shape, 0.99) if region == "disc" else np.ones(shape, bool)
        surface, pixel = surfaces.cosines(size / 3.3, size / 12), 3.0 / size
        solved = integrated(problem(surface, pixel_size=(pixel, pixel), shape=shape, mask=mask))
        errors.append(worst(solved, truth(surface, (pixel, pixel), shape), mask))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[0] < 0.05
    assert (orders >= 1.9).all() or errors[-1] < 1e-5, (errors, orders)


@pytest.mark.parametrize(("pixel", "mask"), [(1e-3, "rectangle"), (1e3, "disc")])
def test_pixels_of_any_size(pixel, mask):
    size = pixel, 1.6 * pixel
    heights = np.where(np.random.default_rng(11).random(SHAPE) < 0.02, truth(BUMP, size), np.nan)
    for options in ({}, {"known_heights": heights, "known_height_weights": 100 / pixel**2}):
        asked = problem(BUMP, 0.1, pixel_size=size, mask=MASKS[mask], **options)
        assert apart(integrated(asked), asked) <= 1e-4


def test_y_runs_up_the_picture(device):
    level, rising = np.zeros((6, 4)), np.ones((6, 4))
    up = engine.integrate(level, rising, (2.0, 0.5), device=device).height
    np.testing.assert_allclose(np.diff(up, axis=0), -0.5, atol=1e-6)
    right = engine.integrate(rising, level, (2.0, 0.5), device=device).height
    np.testing.assert_allclose(np.diff(right, axis=1), 2.0, atol=1e-6)


def test_a_component_is_held_by_its_own_known_heights_and_has_the_mean_0_without(device):
    mask = MASKS["two contacts"]
    right = mask & (surfaces.places(SHAPE)[0] > 0)
    heights = np.where(right, 5 + truth(BOWL), np.nan)
    solved = integrated(problem(BOWL, mask=mask, known_heights=heights), device)
    assert not solved.offset_unknown[solved.component[24, 46]]
    assert solved.offset_unknown[solved.component[24, 15]]
    np.testing.assert_allclose(solved.height[right], heights[right], atol=1e-4)
    assert np.nanmean(solved.height[mask & ~right]) == pytest.approx(0, abs=1e-5)


def test_known_heights_need_no_slope_and_alone_are_taken_as_they_are(device):
    dz_dx, dz_dy, _ = problem(BOWL).arguments
    dz_dx[10, 10], heights = np.nan, np.full(SHAPE, np.nan)
    heights[10, 10] = 7.0
    solution = engine.integrate(dz_dx, dz_dy, PIXEL, known_heights=heights, sigma=False, device=device)
    assert solution.height[10, 10] == pytest.approx(7, abs=1e-5)
    assert solution.offset_unknown.tolist() == [1, 0]
    assert solution.process["integration_invalid"] == 1
    alone = engine.integrate(dz_dx, dz_dy, PIXEL, slope_weights=0, known_heights=some(), sigma=False)
    np.testing.assert_allclose(alone.height, some(), rtol=3e-7, atol=1e-6)
    assert not alone.offset_unknown.any()


def test_heights_without_weight_or_value_are_as_good_as_none():
    plain = integrated(problem(BUMP, 0.1))
    for options in (
        {"known_heights": np.full(SHAPE, np.nan)},
        {"known_heights": np.ones(SHAPE), "known_height_weights": 0},
    ):
        other = integrated(problem(BUMP, 0.1, **options))
        np.testing.assert_array_equal(other.height, plain.height)
        assert other.offset_unknown.tolist() == [1]
    masked = integrated(problem(BUMP, 0.1, known_heights=np.where(DISC, 1.0, np.nan))).height
    far = {"known_heights": np.where(DISC, 1.0, -1e5), "known_height_weights": 1.0 * DISC}
    np.testing.assert_allclose(integrated(problem(BUMP, 0.1, **far)).height, masked, atol=1e-3)


@pytest.mark.parametrize(
    ("shape", "masked"), [((1, 1), False), ((1, 2), True), ((2, 1), False), ((1, 57), True), ((43, 1), False)]
)
def test_thin_and_tiny_pictures(device, shape, masked):
    mask = np.ones(shape, bool)
    mask.flat[0] = not masked or shape == (1, 1)
    solved = integrated(problem(BOWL, shape=shape, mask=mask), device)
    expected = truth(BOWL, shape=shape)
    expected = expected - expected[mask].mean()
    atol = 1e-4 * max(np.ptp(expected[mask]), 1e-3)
    np.testing.assert_allclose(solved.height[mask], expected[mask], atol=atol)
    np.testing.assert_array_equal(np.isnan(solved.height), ~mask)


def test_components_of_one_pixel_have_their_known_height_or_none():
    random = np.random.default_rng(3)
    specks, specks_height = random.random(SHAPE) < 0.25, random.normal(size=SHAPE)
    weights = {"slope_weights": 60.0, "known_height_weights": 6.0}
    result = integrated(problem(WAVES, mask=specks, known_heights=specks_height, **weights))
    alone = specks & (np.bincount(result.component[specks])[result.component] == 1)
    np.testing.assert_allclose(result.height[alone], specks_height[alone], atol=1e-5)
    assert alone.sum() > 20
    chess = np.indices((9, 12)).sum(axis=0) % 2 == 0
    result = integrated(problem(BOWL, shape=(9, 12), mask=chess))
    np.testing.assert_array_equal(result.height[chess], 0)
    np.testing.assert_array_equal(result.component[chess], np.arange(chess.sum()))


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_slopes_that_are_no_numbers_are_left_out_and_counted(device, bad):
    spots = np.random.default_rng(10).random((2, *SHAPE)) < 0.03
    asked = problem(BUMP, 0.1, mask=DISC)
    asked.dz_dx[spots[0]], asked.dz_dy[spots[1]] = bad, np.nan
    solved = integrated(asked, device)
    assert solved.process["integration_invalid"] == (spots.any(axis=0) & DISC).sum() > 50
    assert apart(solved, asked) <= 1e-4


def test_any_array_is_accepted_and_stays_as_it_was():
    dz_dx, dz_dy, _ = problem(BUMP, 0.1).arguments
    slopes = [dz_dx.astype(np.float32), dz_dy.astype(np.float32)]
    expected = engine.integrate(*slopes, PIXEL, mask=DISC, sigma=False).height
    for parts in (
        [part.astype(np.float64) for part in slopes],
        [np.asfortranarray(part) for part in slopes],
        [np.repeat(part, 2, axis=1)[:, ::2] for part in slopes],
        [part.tolist() for part in slopes],
    ):
        solution = engine.integrate(*parts, np.array(PIXEL), mask=7 * DISC.astype(np.int16), sigma=False)
        np.testing.assert_array_equal(solution.height, expected)
    np.testing.assert_array_equal(slopes[0], dz_dx.astype(np.float32))


INNER = np.s_[9:40, 21:58]  # what is left of the picture below


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("how", ["by a mask", "by slopes", "by known heights"])
def test_only_the_box_that_has_an_answer_is_integrated(how, robust):
    asked = problem(WAVES, 0.2, edges=surfaces.random_cuts(SHAPE, 8), slope_weights=uneven())
    inside = np.zeros(SHAPE, bool)
    inside[INNER] = surfaces.disc((31, 37), 0.99)
    maps = {"dz_dx": asked.dz_dx, "dz_dy": asked.dz_dy, **asked.options, "known_heights": some()}
    lost = 0
    if how == "by a mask":
        maps["mask"] = inside.copy()
        maps["mask"][0, :7] = maps["dz_dx"][0, :7] = True
        maps["dz_dx"][0, :7], maps["slope_weights"][:, 0, 0] = np.nan, 0  # wanted, but there is none
        maps["known_heights"][0, :7], lost = np.nan, 6
    else:
        maps["dz_dy"] = np.where(inside, maps["dz_dy"], np.nan)
        maps["known_heights"] = np.where(inside, maps["known_heights"], np.nan)
        lost = (~inside).sum() - (~inside[INNER]).sum()
    if how == "by known heights":
        maps["dz_dy"][9:12] = np.nan
        maps["known_heights"][9, 40] = 1.0
    cropped = {name: values[(..., *INNER)] for name, values in maps.items() if values is not None}
    whole = engine.integrate(pixel_size=PIXEL, robust=robust, **maps)
    part = engine.integrate(pixel_size=PIXEL, robust=robust, **cropped)
    assert part.height.shape == (31, 37)
    for name, rest in {
        "height": np.nan,
        "height_sigma": np.nan,
        "component": -1,
        "filled": 0,
        "edges": 0,
    }.items():
        actual, expected = getattr(whole, name), getattr(part, name)
        if expected is None:
            assert actual is None
            continue
        np.testing.assert_array_equal(actual[INNER], expected)
        around = actual.copy()
        around[INNER] = rest
        np.testing.assert_array_equal(around, np.full(SHAPE, rest, actual.dtype))
    np.testing.assert_array_equal(whole.offset_unknown, part.offset_unknown)
    assert whole.process["integration_invalid"] == part.process["integration_invalid"] + lost


@pytest.mark.parametrize("weight", [1e-30, 1e8, 1e30])
def test_one_weight_however_odd_changes_little(weight):
    asked = problem(WAVES, mask=DISC)
    plain, weights = integrated(asked).height, np.ones(SHAPE)
    weights[20, 20] = weight
    solved = integrated(problem(WAVES, mask=DISC, slope_weights=weights)).height
    np.testing.assert_allclose(solved, plain, atol=0.02 * np.ptp(plain[DISC]))
    pinned = np.full(SHAPE, np.nan)
    pinned[20, 20] = 5.0
    heights = {"known_heights": pinned, "known_height_weights": weight}
    if weight > 1:  # it only moves the surface
        solved = integrated(problem(WAVES, mask=DISC, **heights)).height
        np.testing.assert_allclose(solved, plain - plain[20, 20] + 5, atol=1e-4 * np.ptp(plain[DISC]))


def test_a_comb_is_solved_by_plain_cycles():
    shape, square = (97, 130), (0.03, 0.03)
    mask, bowl = surfaces.comb(shape), surfaces.quadratic(0.004, 0.001, 0.003, 0.1, -0.2)
    solved = integrated(problem(bowl, pixel_size=square, shape=shape, mask=mask))
    assert worst(solved, truth(bowl, square, shape), mask) <= 1e-4


def test_initial_heights_do_not_change_the_answer():
    asked = problem(WAVES, 0.2, mask=DISC)
    plain = integrated(asked)
    again = integrated(asked, initial_heights=plain.height + 40)
    np.testing.assert_allclose(again.height, plain.height, atol=1e-4 * np.ptp(plain.height[DISC]))
    assert again.process["integration_iterations"] <= plain.process["integration_iterations"]


def test_without_tolerance_or_with_a_budget_nothing_is_raised():
    asked = problem(WAVES, 0.2, mask=DISC)
    for options in ({"tolerance": None}, {"budget": 1e-6}, {"budget": 10.0}):
        assert apart(integrated(asked, **options), asked) < 0.1


def test_a_surface_that_did_not_converge_is_not_returned(monkeypatch):
    solve = Multigrid.solve

    def stubborn(self, start=None, **options):
        return solve(self, start, **{**options, "limit": 1})

    monkeypatch.setattr(Multigrid, "solve", stubborn)
    expected = r"1 iteration.*residual of .*more than 1e-06.*tolerance"
    with pytest.raises(engine.NotConverged, match=expected) as error:
        integrated(problem(WAVES, 0.2, mask=MASKS["20 % holes"]), tolerance=1e-6)
    assert error.value.exit_code == 1
    assert "\n" not in str(error.value)


MAP = np.zeros(SHAPE)
NORMALS = io.Result(normals=np.tile(np.float32([0, 0, 1]), (3, 4, 1)), normals_sigma=np.ones((3, 4), "f4"))
OF_RESULT = {"dz_dx": NORMALS, "dz_dy": None}
BAD = {
    "shapes (49, 62) and (62, 49)": {"dz_dy": MAP.T},
    "shapes (49,) and": {"dz_dx": MAP[:, 0]},
    "shapes (0, 5) and": {"dz_dx": MAP[:0, :5], "dz_dy": MAP[:0, :5]},
    "pixel size 0": {"pixel_size": 0},
    "pixel size [1, 2, 3]": {"pixel_size": [1, 2, 3]},
    "pixel size (0.1, -1.0)": {"pixel_size": (0.1, -1)},
    "mask: shape (48, 62)": {"mask": MAP[1:]},
    "known_heights: shape (48, 62)": {"known_heights": MAP[1:]},
    "initial_heights: shape (48, 62)": {"initial_heights": MAP[1:]},
    "slope_weights: shape (3, 49, 62)": {"slope_weights": np.ones((3, *SHAPE))},
    "known_height_weights: shape (2, 49, 62)": {"known_height_weights": np.ones((2, *SHAPE))},
    "slope_weights: some are negative": {"slope_weights": np.where(DISC, np.nan, 1)},
    "slope_weights -1.0": {"slope_weights": -1},
    "known_height_weights nan": {"known_height_weights": np.nan},
    "bilateral_sharpness 0": {"robust": True, "bilateral_sharpness": 0},
    "tolerance -0.1": {"tolerance": -0.1},
    "budget 0": {"budget": 0},
    "nothing to integrate": {"mask": MAP},
    "nothing to integrate: no wanted pixel": {"dz_dx": MAP * np.nan},
    "nothing to integrate: no wanted pixel has": {"slope_weights": 0},
    "normals has no map normals_sigma: it has normals": {**OF_RESULT, "dz_dx": {"normals": NORMALS.normals}},
    "map normals_sigma of normals has size (2, 3)": {
        **OF_RESULT,
        "dz_dx": {**NORMALS, "normals_sigma": MAP[:2, :3]},
    },
    "mask is for arrays: leave it out": {**OF_RESULT, "mask": np.ones((3, 4))},
    "dz_dx is for arrays: leave it out": {"dz_dy": None, "normals": NORMALS},
    "sigma is for arrays: leave it out": {**OF_RESULT, "sigma": False},
    "no option robust_: did you mean robust?": {**OF_RESULT, "robust_": True},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_refused_in_one_line(message):
    options = {"dz_dx": MAP, "dz_dy": MAP, "pixel_size": 0.03} | BAD[message]
    with pytest.raises(io.InputError) as error:
        engine.integrate(**options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("arguments", [{"dz_dx": MAP, "dz_dy": MAP}, {"dz_dx": NORMALS}])
def test_heights_without_a_pixel_size_are_in_pixels(arguments, tmp_path):
    surface, scaled = (engine.integrate(**arguments, pixel_size=size) for size in (None, 0.1))
    assert surface.x is None
    io.save_result(surface, tmp_path / "surface.h5")
    for result in (surface, io.open_result(tmp_path / "surface.h5")):
        assert [result.declaration(name).unit for name in ("height", "height_sigma")] == ["px", "px"]
    np.testing.assert_allclose(0.1 * surface.height, scaled.height, atol=1e-6)


# One call after the other, and frame after frame.

SLOPES = problem(WAVES, 0.2).arguments[:2]
CASES = [
    {},
    {"slope_weights": 4.0},
    {"mask": DISC},
    {"mask": DISC, "slope_weights": 4.0},
    {"mask": DISC, "known_heights": some()},
    {"mask": DISC, "known_heights": some(), "known_height_weights": 5.0},
    {"mask": DISC, "slope_weights": 1 + DISC},
    {"edges": np.eye(*SHAPE)},
]


def heights(case):
    return engine.integrate(*SLOPES, 0.1, sigma=False, **CASES[case]).height


@pytest.fixture(scope="module")
def alone():
    solved = []
    for case in range(len(CASES)):
        open_device().cache.clear()
        solved.append(heights(case))
    return solved


@pytest.mark.parametrize("order", [range(8), range(7, -1, -1), [2, 3, 2, 4, 2, 5]])
def test_the_order_of_calls_does_not_matter(alone, order):
    for case in order:
        np.testing.assert_array_equal(heights(case), alone[case])
    first = heights(2)
    heights(3)
    np.testing.assert_array_equal(first, alone[2])


def test_a_picture_that_failed_leaves_nothing_behind(alone):
    with pytest.raises(engine.NotConverged):
        engine.integrate(SLOPES[0] * 1e20, SLOPES[1], 0.1, mask=DISC, sigma=False)
    np.testing.assert_array_equal(heights(2), alone[2])


def frame(number, **options):
    """Slopes that change by a hundredth from frame to frame."""
    random = np.random.default_rng(1)
    first, change = random.normal(0, 0.3, (2, 2, *SHAPE))
    return Problem(*(first + 0.01 * number * change).astype(np.float32), (0.03, 0.03), **options)


def surface(integrator, asked, **options):
    integrator.push(asked.dz_dx, asked.dz_dy, **asked.options, **options)
    return integrator.result()


FRAMES = [
    {"mask": DISC},
    {"mask": DISC},
    {"mask": DISC & (COLUMN > 15)},
    {},
    {"mask": DISC, "slope_weights": 1 + ROW / 9},
    {"mask": DISC, "slope_weights": np.stack([2 + COLUMN / 9, 1 + ROW / 9])},
    {"mask": DISC, "edges": COLUMN == 30},
    {"mask": DISC, "known_heights": np.where(COLUMN == 20, -3.0, np.nan)},
    {"mask": DISC, "known_heights": np.where(COLUMN == 20, -3.0, np.nan), "known_height_weights": 50.0},
    {"mask": DISC},
]


def test_from_frame_to_frame_everything_may_change(device):
    integrator = engine.Integrator(SHAPE, 0.03, device=device)
    kept = []
    for number, options in enumerate(FRAMES):
        asked = frame(number, **options)
        solved = surface(integrator, asked, tolerance=1e-5)
        assert apart(solved, asked) <= 1e-4
        assert solved.height_sigma is None
        assert integrator.result() is solved
        kept.append((solved.height, solved.height.copy()))
    for height, copy in kept:
        np.testing.assert_array_equal(height, copy)


def test_a_frame_starts_from_the_last():
    integrator, asked = engine.Integrator(SHAPE, 0.03), frame(0, mask=DISC)
    first = surface(integrator, asked, tolerance=1e-5).process["integration_iterations"]
    assert surface(integrator, asked, tolerance=1e-4).process["integration_iterations"] <= 1
    integrator.reset()
    with pytest.raises(io.InputError, match="push"):
        integrator.result()
    assert surface(integrator, asked, tolerance=1e-5).process["integration_iterations"] == first


def test_without_a_tolerance_frames_get_truer():
    integrator, asked = engine.Integrator(SHAPE, 0.03), frame(0, mask=DISC)
    errors = [apart(surface(integrator, asked), asked) for _ in range(3)]
    assert errors[0] < 0.05
    assert errors[2] < 1e-4


@pytest.mark.parametrize("factor", [1e20, np.nan])
def test_a_frame_that_is_wrong_does_not_spoil_the_next(factor):
    integrator, asked = engine.Integrator(SHAPE, 0.03), frame(0, mask=DISC)
    wrong = frame(0, mask=DISC)
    wrong.dz_dx[20, 20] *= factor
    surface(integrator, asked, tolerance=1e-5)
    with contextlib.suppress(engine.NotConverged):
        surface(integrator, wrong)
    assert apart(surface(integrator, asked), asked) < 2e-3


def test_a_budget_is_kept_and_a_tolerance_with_it_may_be_missed():
    integrator, asked = engine.Integrator(SHAPE, 0.03), frame(0, mask=MASKS["20 % holes"])
    assert surface(integrator, asked, budget=1e-6, tolerance=1e-5).process["integration_iterations"] == 1
    assert surface(integrator, asked, budget=10.0, tolerance=1e-5).process["integration_residual"] <= 1e-5


def test_frames_of_another_shape_are_refused():
    with pytest.raises(io.InputError, match="another Integrator"):
        engine.Integrator(SHAPE, 0.03).push(MAP[1:], MAP[1:])
    with pytest.raises(io.InputError, match="pixel size"):
        engine.Integrator(SHAPE, -1)


# Noise.

NOISY = (24, 27)


@pytest.mark.parametrize("region", ["rectangle", "disc"])
def test_noise_spreads_as_in_the_best_linear_estimate(region):
    """What the best estimate errs by is uncorrelated with what another errs by beyond it."""
    mask = surfaces.disc(NOISY) if region == "disc" else np.ones(NOISY, bool)
    weights = None if region == "rectangle" else 400 * uneven(NOISY)
    asked = Problem(np.zeros(NOISY), np.zeros(NOISY), PIXEL, mask=mask, slope_weights=weights)
    best, sigma = slope_oracle.propagation(asked, best=True), np.sqrt(slope_oracle.variance(asked))
    generator, beyond = np.random.default_rng(8), []
    for _ in range(6):
        noise = sigma * generator.normal(size=sigma.shape)
        solved = integrated(Problem(*noise.reshape(2, *NOISY), PIXEL, **asked.options))
        beyond.append(solved.height[mask] - best @ noise)
    assert np.any(beyond)
    assert np.sqrt(1 + np.mean(np.square(beyond)) / np.mean(best**2 @ sigma**2)) <= 1.05


def test_levels_halve_and_never_overlap():
    from mirrorskin.engine.integration.hierarchy import cut_levels

    for shape in [(480, 640), (1, 1), (5, 4), (1, 1000), (33, 17)]:
        levels = cut_levels(shape)
        assert (levels[0].rows, levels[0].columns) == shape
        assert levels[-1].nodes <= 64
        for fine, coarse in itertools.pairwise(levels):
            assert (coarse.rows, coarse.columns) == (-(-fine.rows // 2), -(-fine.columns // 2))
            assert coarse.base >= fine.end


def test_heights_of_several_turns_are_those_of_each():
    turns = NORMALS.assign({name: np.stack([NORMALS[name]] * 2) for name in NORMALS})
    alone = engine.integrate(NORMALS, pixel_size=0.1)
    for height in engine.integrate(turns, pixel_size=0.1).height:
        np.testing.assert_array_equal(height, alone.height)
