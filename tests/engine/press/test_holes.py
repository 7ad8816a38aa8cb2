"""Filled holes, on terraces of bodies in closed form, and on the twin."""

import geometry
import numpy as np
import pytest
from stacks import ball

from mirrorskin import engine
from mirrorskin.engine.press import fill_holes
from mirrorskin.engine.press.membrane import stretch
from mirrorskin.io import InputError

PIXEL = 0.05
DARK_SLOPE = np.tan(np.radians(11.8))


def terraces(height, slope, step, start=0.0):
    """What a press tells of a surface: the middles of its steps, where it is lit; NaN elsewhere."""
    middle = -(np.floor(-height / step) + 0.5) * step
    lit = (slope > DARK_SLOPE) & (slope < 1) & (-height > start)
    return np.where(lit, middle, np.nan), np.full(height.shape, step / 2 / np.sqrt(3))


def cap(shape, radius, centre=(0.0, 0.0), pixel=PIXEL):
    """Height and slope of a ball whose top is at z = 0; nothing beyond its equator."""
    x, y = geometry.pixel_centres(shape, pixel)
    distance = np.hypot(x - centre[0], y - centre[1])
    rise = np.sqrt(np.where(distance < radius, radius**2 - distance**2, np.nan))
    return rise - radius, distance / rise


def frustum(shape, flat=1.5, slope=0.6, base=4.0):
    """Height and slope of a cone that is cut off level; a cone where `flat` is 0."""
    distance = np.hypot(*geometry.pixel_centres(shape, PIXEL))
    height = np.where(distance < base, -slope * np.maximum(distance - flat, 0), np.nan)
    return height, np.where(distance > flat, slope, 0.0)


def inside(height, slope):
    """The dark pixels of a cap."""
    return np.isfinite(height) & (slope <= DARK_SLOPE)


def test_a_fill_does_not_depend_on_where_arrays_are_in_memory():
    height, slope = cap((161, 161), 5, (0.37, 0.2), pixel=0.045)
    holed, sigma = terraces(height, slope, 0.1)
    filled, kept = set(), []
    for size in range(40):
        kept.append(np.empty(1000 + 2 * size))
        filled.add(fill_holes(holed, sigma, 0.045)[0].tobytes())
    assert len(filled) == 1


@pytest.mark.parametrize(
    ("radius", "step", "error"), [(3, 0.01, 0.005), (10, 0.01, 0.008), (5, 0.1, 0.012), (10, 0.1, 0.020)]
)
def test_a_balls_cap_goes_on_over_its_hole(radius, step, error):
    height, slope = cap((161, 161), radius, pixel=0.012 * radius)
    holed, sigma = terraces(height, slope, step)
    filled_heights, filled = fill_holes(holed, sigma, 0.012 * radius)
    hole = inside(height, slope)
    assert hole.sum() > 500
    np.testing.assert_array_equal(filled, hole)
    assert np.max(np.abs(filled_heights - height)[hole]) <= error
    # What was measured stays, and what is outside stays open.
    np.testing.assert_array_equal(filled_heights[~hole], holed[~hole].astype(np.float32))
    assert filled_heights.dtype == np.float32
    assert filled.dtype == np.uint8


@pytest.mark.parametrize(("step", "count", "noise"), [(0.01, 100, 3.0), (0.1, 16, 0.0)])
def test_the_twins_ball_is_closed_to_its_apex(step, count, noise):
    apex = 0.020
    travel = step * np.arange(1, count + 1)
    result = engine.reconstruct(ball((121, 121), PIXEL, travel, noise=noise, seed=4), fill=False)
    filled_heights, filled = fill_holes(result.height, result.height_sigma, PIXEL, deepest=-travel[-1])
    exact = geometry.sphere((121, 121), PIXEL).height
    assert np.isnan(result.height[60, 60])
    assert filled[60, 60] == 1
    assert abs(filled_heights[60, 60] - exact[60, 60]) <= apex
    assert np.max(np.abs(filled_heights - exact)[filled > 0]) <= 1.5 * apex
    assert not np.any(filled.astype(bool) & np.isfinite(result.height))


@pytest.mark.parametrize("step", [0.01, 0.1])
def test_a_flat_top_becomes_flat(step):
    height, slope = frustum((161, 161))
    holed, sigma = terraces(height, slope, step)
    filled_heights, filled = fill_holes(holed, sigma, PIXEL)
    hole = slope == 0
    np.testing.assert_array_equal(filled, hole & np.isfinite(height))
    assert np.max(np.abs(filled_heights[hole])) <= step / 2 + 0.6 * PIXEL
    assert np.ptp(filled_heights[hole]) <= step + 0.6 * PIXEL


def test_a_tilted_flat_top_stays_tilted():
    x, y = geometry.pixel_centres((161, 161), PIXEL)
    tilt = -0.3 + 0.08 * x - 0.05 * y
    top = np.hypot(x, y) < 1.6
    height = np.where(np.hypot(x, y) < 4, tilt - 0.6 * np.maximum(np.hypot(x, y) - 1.6, 0), np.nan)
    holed, sigma = terraces(height, np.where(top, 0.0, 0.6), 0.01)
    filled_heights, filled = fill_holes(holed, sigma, PIXEL)
    assert np.all(filled[top])
    assert np.max(np.abs(filled_heights - height)[top]) <= 0.005 + 0.7 * PIXEL


@pytest.mark.parametrize("slope", [0.27, 0.6])
def test_the_tip_of_a_cone_is_cut_off_at_its_hole(slope):
    height, steep = frustum((121, 121), flat=0.0, slope=slope, base=2.5)
    holed, sigma = terraces(height, steep, 0.05, start=0.05)  # light from the start above that
    filled_heights, filled = fill_holes(holed, sigma, PIXEL, above=np.where(-height < 0.05, -0.05, np.nan))
    tip = filled > 0
    assert tip[60, 60]
    assert tip.sum() > 4
    assert np.max(filled_heights[tip]) <= 0
    assert np.min((filled_heights - height)[tip]) >= -0.1
    assert np.min(filled_heights[tip]) >= -0.05 - 1e-6


def test_holes_are_filled_each_by_its_own_ring():
    shape = (200, 300)
    parts = [cap(shape, 3.0, (-3.6, 0.4)), cap(shape, 2.5, (3.1, -1.3)), cap(shape, 2.0, (-1.0, -2.9))]
    highest = np.argmax([np.nan_to_num(height, nan=-np.inf) for height, _ in parts], axis=0)
    height, slope = (np.choose(highest, [part[k] for part in parts]) for k in (0, 1))
    filled_heights, filled = fill_holes(*terraces(height, slope, 0.02), PIXEL)
    np.testing.assert_array_equal(filled, inside(height, slope))
    assert np.max(np.abs(filled_heights - height)[filled > 0]) < 0.010


def test_pixels_need_not_be_square():
    height, slope = cap((161, 161), 4.0)
    holed, sigma = terraces(height, slope, 0.02)
    for rows, columns, pixel in ((2, 1, (PIXEL, 2 * PIXEL)), (1, 3, (3 * PIXEL, PIXEL))):
        part = np.s_[::rows, ::columns]
        filled_heights, filled = fill_holes(holed[part], sigma[part], pixel)
        assert filled.sum() > 100
        assert np.max(np.abs(filled_heights - height[part])[filled > 0]) < 0.010


def test_small_gaps_do_not_open_a_hole_and_wide_ones_do():
    height, slope = cap((161, 161), 4.0)
    holed, sigma = terraces(height, slope, 0.02)
    hole = inside(height, slope)
    for wide, closed in ((1, True), (2, True), (4, False)):
        broken = holed.copy()
        broken[80 : 80 + wide, 81:] = np.nan
        filled_heights, filled = fill_holes(broken, sigma, PIXEL)
        assert np.all(filled[hole] == closed)
        if closed:
            assert np.max(np.abs(filled_heights - height)[hole]) < 0.010
        assert not filled[:, 161 - 5 :].any()


def test_a_hole_cut_by_the_border_is_filled_if_what_is_around_it_holds_it():
    height, slope = cap((161, 161), 4.0)
    holed, sigma = (part[:, :81] for part in terraces(height, slope, 0.02))
    filled_heights, filled = fill_holes(holed, sigma, PIXEL)
    np.testing.assert_array_equal(filled, inside(height, slope)[:, :81])
    assert np.max(np.abs(filled_heights - height[:, :81])[filled > 0]) < 0.015
    # Less than half of the ring is left: the cap lies outside its hull.
    assert not fill_holes(holed[:, :64], sigma[:, :64], PIXEL)[1].any()


def test_a_flat_top_cut_by_the_border_stays_open():
    height, slope = frustum((161, 161))
    holed, sigma = (part[:, :81] for part in terraces(height, slope, 0.02))
    filled_heights, filled = fill_holes(holed, sigma, PIXEL)
    assert not filled.any()
    np.testing.assert_array_equal(filled_heights, holed.astype(np.float32))


def test_stripes_between_lit_flanks_are_holes_and_those_next_to_them_are_not():
    x, _ = geometry.pixel_centres((60, 100), PIXEL)
    height, slope = -0.2 + 0.2 * np.cos(np.pi * x), np.abs(0.2 * np.pi * np.sin(np.pi * x))
    holed, sigma = terraces(height, slope, 0.02)
    holed[:, :13] = np.nan
    filled_heights, filled = fill_holes(holed, sigma, PIXEL)
    inner = (slope <= DARK_SLOPE) & (np.abs(x) < 1.7)
    assert np.all(filled[inner])
    assert not filled[:, :13].any()
    assert np.max(np.abs(filled_heights - height)[inner]) < 0.035


def test_what_was_never_reached_is_not_a_hole():
    height, slope = cap((161, 161), 4.0)
    holed, sigma = terraces(-0.6 - height, slope, 0.02)  # a bowl, pressed until its floor is not yet met
    holed = np.where(holed > -0.5, holed, np.nan)
    assert np.isfinite(holed).any()
    filled_heights, filled = fill_holes(holed, sigma, PIXEL, deepest=-0.5)
    assert not filled.any()
    assert fill_holes(holed, sigma, PIXEL)[1].any()
    np.testing.assert_array_equal(filled_heights, holed.astype(np.float32))


def test_a_fill_is_nowhere_below_what_is_known():
    height, slope = frustum((161, 161))
    holed, sigma = terraces(height, slope, 0.1, start=0.1)  # light from the start above that
    early = (slope > 0) & (-height <= 0.1)
    assert early.any()
    deep, _ = fill_holes(holed, sigma, PIXEL)
    result, filled = fill_holes(holed, sigma, PIXEL, above=np.where(early, -0.1, np.nan))
    assert np.min(result[filled > 0]) >= -0.1 - 1e-6
    assert np.max(np.abs(result - height)[filled > 0]) < np.max(np.abs(deep - height)[filled > 0]) - 0.03


def test_a_few_wrong_heights_and_dropouts_do_little():
    height, slope = cap((161, 161), 4.0)
    holed, sigma = terraces(height, slope, 0.02)
    generator = np.random.default_rng(7)
    wrong = generator.random(holed.shape) < 0.02
    holed[wrong] -= 0.5 * generator.random(np.count_nonzero(wrong))
    holed[generator.random(holed.shape) < 0.05] = np.nan
    filled_heights, filled = fill_holes(holed, sigma, PIXEL)
    hole = inside(height, slope)
    assert np.all(filled[hole])
    assert np.max(np.abs(filled_heights - height)[hole]) < 0.020
    assert filled.sum() > hole.sum()  # single pixels as well


@pytest.mark.parametrize(
    "heights", [np.full((1, 1), np.nan), np.full((7, 5), np.nan), np.ones((4, 6)), np.ones((1, 1))]
)
def test_without_holes_nothing_changes(heights):
    filled_heights, filled = fill_holes(heights, 0.01, PIXEL)
    np.testing.assert_array_equal(filled_heights, heights.astype(np.float32))
    assert not filled.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": np.ones(5)}, "shape"),
        ({"height": np.ones((0, 5))}, "shape"),
        ({"sigma": np.ones((2, 2))}, "sigma has shape"),
        ({"sigma": -1.0}, "negative"),
        ({"above": np.ones((2, 2))}, "above has shape"),
        ({"pixel_size": 0.0}, "pixel size"),
        ({"pixel_size": (1.0, np.nan)}, "pixel size"),
        ({"steepest": 0.0}, "steepest"),
        ({"steepest": np.nan}, "steepest"),
        ({"deepest": np.nan}, "deepest"),
    ],
)
def test_what_cannot_be_used_is_reported(change, message):
    arguments = {"height": np.ones((4, 5)), "sigma": 0.01, "pixel_size": PIXEL} | change
    with pytest.raises(InputError, match=message):
        fill_holes(arguments.pop("height"), arguments.pop("sigma"), arguments.pop("pixel_size"), **arguments)


def a_hole(shape, radius):
    """A disc of unknown pixels amid known ones."""
    row, column = np.indices(shape, dtype=float)
    return np.hypot(row - shape[0] / 2, column - shape[1] / 2) < radius


@pytest.mark.parametrize(("shape", "radius"), [((31, 28), 12), ((170, 151), 70)])
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.1, 0.05)])
def test_planes_and_saddles_are_repeated(shape, radius, spacing):
    row, column = np.indices(shape, dtype=float)
    y, x = row * spacing[0], column * spacing[1]
    unknown = a_hole(shape, radius)
    for exact in (3 + 0.2 * x - 0.7 * y, x**2 - y**2 + x * y):
        holed = np.where(unknown, np.nan, exact)
        stretched = stretch(holed, ~unknown, unknown, spacing)
        assert np.max(np.abs(stretched - exact)) <= 1e-3 * np.ptp(exact)
        np.testing.assert_array_equal(stretched[~unknown], exact[~unknown].astype(np.float32))


def test_any_rim_is_met_as_a_dense_solver_meets_it():
    generator = np.random.default_rng(3)
    unknown = generator.random((14, 17)) < 0.4
    unknown[[0, -1]] = unknown[:, [0, -1]] = False
    height = generator.normal(size=unknown.shape)
    matrix, right = np.eye(unknown.size), np.where(unknown, 0.0, height).ravel()
    for row, column in np.argwhere(unknown):
        here = row * 17 + column
        for neighbour in (here - 17, here + 17, here - 1, here + 1):
            matrix[here, neighbour] -= 0.25
    exact = np.linalg.solve(matrix, right).reshape(unknown.shape)
    stretched = stretch(np.where(unknown, np.nan, height), ~unknown, unknown, (0.3, 0.3))
    np.testing.assert_allclose(stretched, exact, atol=1e-3 * np.ptp(height))


def test_what_is_neither_known_nor_wanted_leaves_it_free():
    # A strip that is known at its left end only lies level, whatever stands beside it.
    height = np.full((3, 6), np.nan)
    height[1, 0] = 2.0
    unknown = np.zeros((3, 6), bool)
    unknown[1, 1:] = True
    stretched = stretch(height, np.isfinite(height), unknown, (1.0, 1.0))
    np.testing.assert_allclose(stretched[1], 2.0)
    assert np.isnan(stretched[0]).all()
