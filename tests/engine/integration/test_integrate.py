"""Heights from slopes: what comes out is what the equations say, and what cannot be used is told."""

from __future__ import annotations

import numpy as np
import pytest
from slope_oracle import Problem, solve

from mirrorskin import engine, io
from mirrorskin.engine.integration import integration as solver

SHAPE = 41, 53
SIZE = 0.03, 0.04


def disc(shape=SHAPE, radius=19.0):
    row, column = np.indices(shape)
    return np.hypot(row - shape[0] / 2, column - shape[1] / 2) < radius


def noise(number, shape=SHAPE):
    return np.random.default_rng(number).normal(0, 0.3, (2, *shape)).astype(np.float32)


def spots(number, share, shape=SHAPE):
    return np.random.default_rng(number).random(shape) < share


def known(level=1.0):
    return np.where(spots(3, 0.1), np.random.default_rng(4).normal(level, 1, SHAPE), np.nan)


def uneven(count=1):
    random = np.random.default_rng(5)
    return np.squeeze(random.uniform(0.01, 1, (count, *SHAPE)) * (random.random((count, *SHAPE)) > 0.1))


PROBLEMS = {
    "a full picture": {},
    "heights known everywhere": {
        "known_heights": np.ones(SHAPE) + noise(8)[0],
        "known_height_weights": 300.0,
    },
    "a mask with two parts": {"mask": disc() | (np.indices(SHAPE)[1] < 4)},
    "salt": {"mask": ~spots(1, 0.2)},
    "slope_weights": {"slope_weights": uneven() * 1e5},
    "weights of each axis": {"slope_weights": uneven(2) * 1e-5},
    "edges": {"mask": disc(), "edges": spots(2, 0.1)},
    "some heights": {"known_heights": known(), "known_height_weights": 1e3},
    "heights far below": {"known_heights": known(-300.0)},
    "all at once": {
        "mask": disc(),
        "slope_weights": uneven(2),
        "edges": spots(2, 0.1),
        "known_heights": known(-300.0),
        "known_height_weights": uneven() * 1e3,
    },
}


@pytest.mark.parametrize("options", PROBLEMS.values(), ids=PROBLEMS)
def test_heights_are_those_of_a_direct_solve_in_float64(device, options):
    slopes = noise(7)
    if "mask" in options or "slope_weights" in options:
        slopes[:, spots(9, 0.1)] = np.nan
    problem = Problem(*slopes, SIZE, **options)
    exact = solve(problem)
    found = engine.integrate(*problem.arguments, **options, sigma=False, tolerance=1e-5, device=device)
    np.testing.assert_array_equal(found.component, exact.component)
    np.testing.assert_array_equal(found.offset_unknown, exact.offset_unknown)
    span = np.nanmax(exact.height) - np.nanmin(exact.height)
    np.testing.assert_allclose(found.height, exact.height, rtol=3e-7, atol=4e-5 * span)
    assert found.height.dtype == np.float32
    assert found.converged
    assert found.residual <= 1e-5
    whole = (
        options.keys() <= {"known_heights", "known_height_weights"}
        and np.isfinite(options.get("known_heights", 0)).all()
    )
    assert found.method == ("direct" if whole else "multigrid")


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.2, -0.1), (3.0, 2.0)])
@pytest.mark.parametrize("mask", [None, disc(), ~spots(1, 0.2)], ids=["full", "disc", "salt"])
def test_planes_are_planes_whatever_their_tilt(tilt, mask):
    row, column = np.indices(SHAPE)
    plane = tilt[0] * SIZE[0] * column - tilt[1] * SIZE[1] * row
    found = engine.integrate(np.full(SHAPE, tilt[0]), np.full(SHAPE, tilt[1]), SIZE, mask=mask, sigma=False)
    for label in range(len(found.offset_unknown)):
        piece = found.component == label
        expected = plane[piece] - plane[piece].mean()
        np.testing.assert_allclose(found.height[piece], expected, atol=1e-6 * max(np.ptp(plane), 1e-9))


def test_what_is_wanted_but_has_no_slope_is_counted():
    slopes = noise(7)
    slopes[0, 3, 4:8], slopes[1, 20, 30] = np.nan, np.inf
    slopes[:, 0, 0] = np.nan
    found = engine.integrate(*slopes, 0.03, mask=disc() | (np.indices(SHAPE)[0] == 3), sigma=False)
    assert found.invalid == 5
    assert np.isnan(found.height[20, 30])
    assert found.component[20, 30] == -1


def test_a_height_that_is_known_needs_no_slope():
    slopes, heights = noise(7), np.full(SHAPE, np.nan)
    slopes[:, 5, 5], heights[5, 5] = np.nan, -2.0
    found = engine.integrate(*slopes, 0.03, known_heights=heights, sigma=False)
    assert found.height[5, 5] == -2.0
    assert found.component[5, 5] == 1
    assert found.offset_unknown.tolist() == [True, False]
    assert found.invalid == 1


def test_heights_alone_are_taken_as_they_are():
    heights = np.where(spots(3, 0.1), np.indices(SHAPE)[0], np.nan)
    found = engine.integrate(*noise(7), 0.03, slope_weights=0, known_heights=heights, sigma=False)
    np.testing.assert_allclose(found.height, heights, rtol=3e-7)
    assert not found.offset_unknown.any()
    whole = engine.integrate(
        [[1, 1, 1]], [[0, 0, 0]], 1, known_heights=[[2, 4, 5]], known_height_weights=1e6, sigma=False
    )
    np.testing.assert_allclose(whole.height, [[2, 4, 5]], atol=1e-4)


def test_heights_that_tell_nothing_are_as_good_as_none():
    plain = engine.integrate(*noise(7), 0.03, sigma=False)
    for options in (
        {"known_heights": np.full(SHAPE, np.nan)},
        {"known_heights": np.ones(SHAPE), "known_height_weights": 0},
    ):
        other = engine.integrate(*noise(7), 0.03, sigma=False, **options)
        np.testing.assert_array_equal(other.height, plain.height)
        assert other.offset_unknown.tolist() == [True]


def test_a_pixel_without_neighbours_is_a_piece():
    found = engine.integrate([[0.5]], [[0.1]], 0.03)
    assert found.height.tolist() == [[0.0]]
    assert found.component.tolist() == [[0]]
    assert found.offset_unknown.tolist() == [True]
    known_one = engine.integrate(
        [[0.5]], [[0.1]], 0.03, known_heights=[[7.0]], known_height_weights=4.0, slope_weights=1.0
    )
    assert known_one.height.tolist() == [[7.0]]
    assert known_one.sigma.tolist() == [[0.5]]


def test_types_of_all_kinds_are_taken():
    slopes = noise(7)
    first = engine.integrate(*slopes, 0.03, mask=disc(), sigma=False)
    kinds = [
        engine.integrate(*slopes.astype(float), 0.03, mask=disc() * 200, sigma=False),
        engine.integrate(*np.asfortranarray(slopes.T).T, [0.03, 0.03], mask=disc() * 0.5, sigma=False),
        engine.integrate(*slopes.tolist(), np.float32(0.03), mask=disc().astype(np.int64), sigma=False),
    ]
    for other in kinds:
        np.testing.assert_allclose(other.height, first.height, atol=1e-6)
    whole = engine.integrate(np.ones((5, 6), int), np.zeros((5, 6), int), 1, sigma=False)
    np.testing.assert_allclose(whole.height, np.broadcast_to(np.arange(6) - 2.5, (5, 6)), atol=1e-5)


def test_what_was_given_stays_as_it_was():
    slopes, heights, mask = noise(7), known(), disc()
    kept = slopes.copy(), heights.copy(), mask.copy()
    engine.integrate(*slopes, 0.03, known_heights=heights, mask=mask)
    for before, after in zip(kept, (slopes, heights, mask), strict=True):
        np.testing.assert_array_equal(before, after)


def test_a_start_does_not_change_the_answer():
    slopes = noise(7)
    plain = engine.integrate(*slopes, SIZE, mask=disc(), sigma=False, tolerance=1e-5)
    start = plain.height + 40
    again = engine.integrate(*slopes, SIZE, mask=disc(), sigma=False, tolerance=1e-5, initial_heights=start)
    np.testing.assert_allclose(again.height, plain.height, atol=2e-5)
    assert again.iterations <= plain.iterations


def test_a_smooth_surface_stays_whole_where_discontinuities_are_looked_for():
    row, column = np.indices(SHAPE)
    x, y = (column - 26) * 0.03, (20 - row) * 0.03
    found = engine.integrate(0.3 * x, 0.2 - 0.5 * y, 0.03, mask=disc(), robust=True, sigma=False)
    exact = 0.15 * x**2 + 0.2 * y - 0.25 * y**2
    assert found.method == "robust"
    assert found.edges.dtype == np.uint8
    assert not found.edges.any()
    np.testing.assert_array_equal(found.component, np.where(disc(), 0, -1))
    np.testing.assert_allclose(found.height[disc()], exact[disc()] - exact[disc()].mean(), atol=2e-4)


def test_without_tolerance_or_with_a_budget_nothing_is_raised():
    slopes = noise(7)
    exact = solve(Problem(*slopes, SIZE, mask=disc())).height
    for options in ({"tolerance": None}, {"budget": 1e-6}, {"budget": 10.0}):
        found = engine.integrate(*slopes, SIZE, mask=disc(), sigma=False, **options)
        assert np.nanmax(np.abs(found.height - exact)) < 0.1 * np.nanmax(np.abs(exact))


def test_a_surface_that_did_not_converge_is_not_returned(monkeypatch):
    found = solver.Multigrid.solve

    def stubborn(self, start=None, **options):
        return found(self, start, **{**options, "limit": 1})

    monkeypatch.setattr(solver.Multigrid, "solve", stubborn)
    with pytest.raises(
        engine.NotConverged, match=r"1 iteration.*residual of .*more than 1e-06.*tolerance"
    ) as told:
        engine.integrate(*noise(7), SIZE, mask=~spots(1, 0.2), tolerance=1e-6)
    assert told.value.exit_code == 1
    assert "\n" not in str(told.value)


MAP = np.zeros(SHAPE)
BAD = {
    "shapes (41, 53) and (53, 41)": {"dz_dy": MAP.T},
    "shapes (41,) and": {"dz_dx": MAP[:, 0]},
    "shapes (0, 5) and": {"dz_dx": MAP[:0, :5], "dz_dy": MAP[:0, :5]},
    "pixel size 0": {"pixel_size": 0},
    "pixel size nan": {"pixel_size": np.nan},
    "pixel size [1, 2, 3]": {"pixel_size": [1, 2, 3]},
    "pixel size (0.1, -1)": {"pixel_size": (0.1, -1)},
    "mask: shape (40, 53)": {"mask": MAP[1:]},
    "edges: shape (40, 53)": {"edges": MAP[1:]},
    "heights: shape (40, 53)": {"known_heights": MAP[1:]},
    "initial_heights: shape (40, 53)": {"initial_heights": MAP[1:]},
    "weights: shape (3, 41, 53)": {"slope_weights": np.ones((3, *SHAPE))},
    "height_weights: shape (2, 41, 53)": {"known_heights": MAP, "known_height_weights": np.ones((2, *SHAPE))},
    "weights: some are negative": {"slope_weights": MAP - 1},
    "weights: some are negative or no": {"slope_weights": np.where(disc(), np.nan, 1)},
    "height_weights: some": {"known_heights": MAP, "known_height_weights": np.full(SHAPE, np.inf)},
    "weights -1.0": {"slope_weights": -1},
    "height_weights nan": {"known_heights": MAP, "known_height_weights": np.nan},
    "bilateral_sharpness 0": {"robust": True, "bilateral_sharpness": 0},
    "tolerance -0.1": {"tolerance": -0.1},
    "budget 0": {"budget": 0},
    "nothing to integrate": {"mask": MAP},
    "nothing to integrate: no pixel": {"dz_dx": MAP * np.nan},
    "nothing to integrate: no pixel that": {"slope_weights": 0},
}


@pytest.mark.parametrize(("message", "options"), BAD.items(), ids=BAD)
def test_what_cannot_be_used_is_told_in_a_line(message, options):
    given = {"dz_dx": MAP, "dz_dy": MAP, "pixel_size": 0.03, **options}
    with pytest.raises(io.InputError) as told:
        engine.integrate(**given)
    assert str(told.value).startswith(message) or message in str(told.value)
    assert "\n" not in str(told.value)
