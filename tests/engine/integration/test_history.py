"""What was integrated before leaves no trace."""

import contextlib
import threading

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.engine.integration import integration as call

SHAPE = (40, 44)
RANDOM = np.random.default_rng(0)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]] / SHAPE[0]
SLOPES = np.cos(3 * COLUMN) + RANDOM.normal(0, 0.05, SHAPE), np.sin(2 * ROW) + RANDOM.normal(0, 0.05, SHAPE)
DISC = np.hypot(COLUMN - 0.5, ROW - 0.5) < 0.4
SOME = np.where(RANDOM.random(SHAPE) < 0.1, 1.0, np.nan)
CASES = [
    {},
    {"slope_weights": 4.0},
    {"slope_weights": 9.0},
    {"mask": DISC},
    {"mask": DISC, "slope_weights": 4.0},
    {"mask": DISC, "known_heights": SOME},
    {"mask": DISC, "known_heights": SOME, "known_height_weights": 5.0},
    {"mask": DISC, "robust": True},
    {"mask": DISC, "slope_weights": 1 + DISC},
    {"known_heights": np.ones(SHAPE), "known_height_weights": 2.0},
    {"edges": np.eye(*SHAPE)},
]


def heights(case):
    return engine.integrate(*SLOPES, 0.1, sigma=False, **CASES[case]).height


@pytest.fixture(scope="module")
def alone():
    found = []
    for case in range(len(CASES)):
        call._spare.clear()
        found.append(heights(case))
    return found


@pytest.mark.parametrize("order", [range(11), range(10, -1, -1), [8, 7, 3], [7, 4, 7, 5, 7, 6], [3, 10, 3]])
def test_the_order_of_calls_does_not_matter(alone, order):
    for case in order:
        np.testing.assert_array_equal(heights(case), alone[case])


def test_heights_do_not_change_with_the_next_call(alone):
    first = heights(3)
    heights(4), heights(8)
    np.testing.assert_array_equal(first, alone[3])


def test_threads_do_not_meet(alone):
    found = {}

    def work(case):
        found[case] = [heights(case) for _ in range(3)]

    threads = [threading.Thread(target=work, args=(case,)) for case in (3, 5, 10)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for case, answers in found.items():
        for answer in answers:
            np.testing.assert_array_equal(answer, alone[case])
    assert len(found) == 3


def test_a_picture_that_failed_leaves_nothing_behind(alone):
    with pytest.raises(engine.NotConverged):
        engine.integrate(SLOPES[0] * 1e20, SLOPES[1], 0.1, mask=DISC, sigma=False)
    np.testing.assert_array_equal(heights(3), alone[3])


def test_a_full_picture_in_between_is_not_taken_for_the_one_before():
    engine.integrate(*SLOPES, 0.1, mask=DISC, sigma=False)
    engine.integrate(*SLOPES, 0.1, sigma=False)
    full = engine.integrate(*SLOPES, 0.1, edges=np.zeros(SHAPE), sigma=False).height
    direct = engine.integrate(*SLOPES, 0.1, sigma=False).height
    np.testing.assert_allclose(full, direct, atol=1e-4 * np.ptp(direct))


@pytest.mark.parametrize("factor", [1e20, 1e3, np.nan])
def test_a_frame_that_is_wrong_does_not_spoil_the_next(factor):
    live = engine.Integrator(SHAPE, 0.1)
    live.push(*SLOPES, mask=DISC, tolerance=1e-5)
    first = live.result()
    wrong = SLOPES[0].copy()
    wrong[20, 20] *= factor
    with contextlib.suppress(engine.NotConverged):
        live.push(wrong, SLOPES[1], mask=DISC)
    live.push(*SLOPES, mask=DISC)
    again = live.result()
    assert again.converged
    np.testing.assert_allclose(again.height, first.height, atol=2e-3 * np.ptp(first.height[DISC]))


@pytest.mark.parametrize("weight", [1e6, 1e9, 1e20])
def test_one_height_however_sure_only_moves_the_surface(alone, weight):
    pinned = np.full(SHAPE, np.nan)
    pinned[20, 20] = 5.0
    found = engine.integrate(
        *SLOPES, 0.1, mask=DISC, known_heights=pinned, known_height_weights=weight, sigma=False
    ).height
    moved = alone[3] - alone[3][20, 20] + 5
    np.testing.assert_allclose(found, moved, atol=1e-4 * np.ptp(moved[DISC]))


@pytest.mark.parametrize("weight", [1e-30, 1e8, 1e30])
def test_one_weight_however_odd_changes_little(alone, weight):
    weights = np.ones(SHAPE)
    weights[20, 20] = weight
    found = engine.integrate(*SLOPES, 0.1, mask=DISC, slope_weights=weights, sigma=False).height
    np.testing.assert_allclose(found, alone[3], atol=0.02)


def test_weights_that_fade_away_are_solved():
    weights = np.exp(-((COLUMN - 0.5) ** 2 + (ROW - 0.5) ** 2) * 150)
    found = engine.integrate(*SLOPES, 0.1, slope_weights=weights, sigma=False)
    assert found.converged
    assert np.isfinite(found.height).all()


def test_heights_without_weight_do_not_matter():
    some = np.where(DISC, 1.0, -1e5)
    without = engine.integrate(*SLOPES, 0.1, known_heights=np.where(DISC, 1.0, np.nan), sigma=False).height
    found = engine.integrate(
        *SLOPES, 0.1, known_heights=some, known_height_weights=1.0 * DISC, sigma=False
    ).height
    np.testing.assert_allclose(found, without, atol=1e-4 * np.ptp(without))


def test_pieces_of_one_pixel_with_a_height_are_solved():
    random = np.random.default_rng(3)
    specks = random.random(SHAPE) < 0.25
    known = random.normal(size=SHAPE)
    found = engine.integrate(
        *SLOPES,
        0.1,
        mask=specks,
        slope_weights=60.0,
        known_heights=known,
        known_height_weights=6.0,
        sigma=False,
    )
    assert found.converged
    assert not found.offset_unknown.any()
    alone = np.bincount(found.component[specks])[found.component] == 1
    alone &= specks
    np.testing.assert_allclose(found.height[alone], known[alone], atol=1e-5)
    assert alone.sum() > 20


def test_a_comb_is_solved_by_plain_cycles():
    comb = np.ones((97, 130), bool)
    comb[1:, 1::2] = False
    row, column = np.mgrid[:97, :130] * 0.03
    found = engine.integrate(np.full(row.shape, 0.5), np.full(row.shape, 0.25), 0.03, mask=comb, sigma=False)
    expected = 0.5 * column - 0.25 * row
    expected -= expected[comb].mean()
    np.testing.assert_allclose(found.height[comb], expected[comb], atol=1e-4 * np.ptp(expected))
    assert engine.integrate(np.cos(column), np.sin(row), 0.03, mask=comb, sigma=False).converged
