"""The judge of calibration is judged: by answers of known quality, and by the twin's light."""

import math

import calibration_scorer as scorer
import numpy as np
import pytest
from calibration_scenes import Lab
from calibration_scorer import Judge, Rig

SHAPE, PIXEL, PRESS = (64, 66), 0.18, 0.9
EIGHTHS = tuple(np.arange(8) * np.pi / 4)
RIG = Rig(
    tilt=math.radians(2.5),
    phase=EIGHTHS,
    distance=150.0,
    scatter=math.radians(2.0),
    asymmetry=0.05,
    lamp_azimuth=0.7,
    dark_zenith=math.atan2(17.5, 40.0) / 2,
    spread=1.5,
)
CRATE = scorer.waves(0.22, 2.5, 0.3, 7.5)
THINGS = (
    scorer.ball(6.0, (1.0, -0.5)),
    scorer.cone(0.5, 3.0, (-1.0, 2.0)),
    scorer.facets(0.45, 1.5, 0.3, 0.6, 8.0),
    CRATE,
)


@pytest.fixture(scope="module")
def crate():
    x, y = scorer.pixel_grid(SHAPE, PIXEL)
    seen = scorer.see(RIG, CRATE, x, y, PRESS)
    return seen, scorer.bounds(RIG, seen, 0.1)


def drawn(bound, seed=1):
    generator = np.random.default_rng(seed)
    return (sigma * generator.normal(size=sigma.shape) for sigma in bound)


def judged(seen, bound, zenith, azimuth, cells=4):
    judge = Judge(cells)
    judge.add(zenith, azimuth, seen, bound)
    return judge.score()


def test_answers_as_noisy_as_the_bound_pass(crate):
    seen, bound = crate
    more, aside = drawn(bound)
    score = judged(seen, bound, seen.zenith + more, seen.azimuth + aside)
    assert score.zenith_share == score.azimuth_share == 1
    for part in (score.cells.zenith, score.cells.azimuth):
        np.testing.assert_allclose(part.ratio, 1, atol=0.25)
        assert np.nanmean(part.ratio) == pytest.approx(1, abs=0.03)
    assert score.zenith_bias == pytest.approx(0, abs=0.02)


def test_answers_once_and_a_half_as_noisy_fail(crate):
    seen, bound = crate
    more, aside = drawn(bound)
    score = judged(seen, bound, seen.zenith + 1.5 * more, seen.azimuth + aside)
    assert score.zenith_share < 0.1
    assert score.azimuth_share == 1


def test_a_known_bias_is_found_and_told_apart_from_noise(crate):
    seen, bound = crate
    more, aside = drawn(bound)
    score = judged(seen, bound, seen.zenith + more + math.radians(0.2), seen.azimuth + aside)
    assert score.zenith_bias == pytest.approx(0.2, abs=0.02)
    assert score.zenith_share < 0.1
    assert score.azimuth_share == 1


def test_a_bias_in_one_quarter_of_the_field_shows_there(crate):
    seen, bound = crate
    more, aside = drawn(bound)
    aside[: SHAPE[0] // 2, : SHAPE[1] // 2] += math.radians(8)
    score = judged(seen, bound, seen.zenith + more, seen.azimuth + aside)
    assert score.azimuth_share == pytest.approx(0.75, abs=0.01)
    np.testing.assert_allclose(score.cells.azimuth.bias[:2, :2], 8, atol=1)
    assert score.zenith_share == 1


def test_a_y_that_points_down_is_caught(crate):
    seen, bound = crate
    more, _ = drawn(bound)
    score = judged(seen, bound, seen.zenith + more, -seen.azimuth)
    assert score.azimuth_share == 0
    assert score.zenith_share == 1


def test_an_azimuth_that_jumps_by_a_turn_is_the_same(crate):
    seen, bound = crate
    more, aside = drawn(bound)
    score = judged(seen, bound, seen.zenith + more, seen.azimuth + aside + 2 * np.pi)
    assert score.azimuth_share == 1


def test_no_answers_are_no_success(crate):
    seen, bound = crate
    nothing = np.full(SHAPE, np.nan)
    score = judged(seen, bound, nothing, nothing)
    assert score.zenith_share == score.azimuth_share == 0
    assert np.isnan(score.zenith_bias)


def test_leaving_out_a_fifth_is_no_success(crate):
    seen, bound = crate
    dropped = np.random.default_rng(3).random(SHAPE) < 0.2
    score = judged(seen, bound, np.where(dropped, np.nan, seen.zenith), seen.azimuth)
    assert score.zenith_share == score.azimuth_share == 0


def test_an_answer_that_says_it_is_poor_is_none(crate):
    seen, bound = crate
    poor = np.random.default_rng(4).random(SHAPE) < 0.05
    zenith, azimuth = np.where(poor, 1.0, seen.zenith), seen.azimuth
    hidden, told = Judge(4), Judge(4)
    hidden.add(zenith, azimuth, seen, bound)
    told.add(zenith, azimuth, seen, bound, np.where(poor, 0.5, 1e-3))
    assert hidden.score().zenith_share == 0
    assert told.score().zenith_share == 1
    assert told.score().cells.answered.mean() == pytest.approx(0.95, abs=0.02)


def test_a_point_that_leaves_the_picture_is_not_asked_for(crate):
    seen, bound = crate
    inside = scorer.bounds(RIG, seen, 0.1, (4.0, 3.0))
    known = np.isfinite(inside.zenith)
    assert 100 < known.sum() < 0.5 * np.isfinite(bound.zenith).sum()
    assert (np.abs(seen.x[known]) < 4).all()
    assert (np.abs(seen.y[known]) < 3).all()


def test_nothing_to_judge_is_refused(crate):
    seen, _ = crate
    nothing = scorer.Bound(*np.full((2, *SHAPE), np.nan))
    with pytest.raises(ValueError, match="no cell"):
        _ = judged(seen, nothing, seen.zenith, seen.azimuth).zenith_share
    with pytest.raises(ValueError, match="no height"):
        scorer.score_heights(seen.z, seen.z, np.zeros(SHAPE, bool))


def test_maps_of_another_size_are_refused(crate):
    seen, bound = crate
    with pytest.raises(ValueError, match="do not fit"):
        judged(seen, bound, seen.zenith[:-1], seen.azimuth[:-1])


def test_every_zenith_is_in_a_bin_and_every_pixel_in_a_cell(crate):
    seen, bound = crate
    score = judged(seen, bound, seen.zenith, seen.azimuth)
    known = np.isfinite(bound.zenith).sum()
    assert score.bins.expected.sum() == score.cells.expected.sum() == known > 1000
    assert (score.cells.expected >= scorer.FEWEST).all()


def test_heights_are_told_by_bias_and_rms():
    true = np.zeros((20, 20))
    found = np.full((20, 20), 0.3)
    found[::2] = 0.5
    found[0, 0] = np.nan
    told = scorer.score_heights(found, true, np.ones((20, 20), bool))
    assert told.bias == pytest.approx(0.4, abs=1e-3)
    assert told.rms == pytest.approx(math.hypot(0.4, 0.1), abs=1e-3)
    assert told.answered == pytest.approx(399 / 400)


@pytest.mark.parametrize("thing", THINGS, ids=lambda thing: thing.name)
def test_a_slope_is_the_height_s_difference(thing):
    generator = np.random.default_rng(5)
    x, y = generator.uniform(-2, 2, (2, 4000))
    step = 1e-6
    along_x = (thing.height(x + step, y) - thing.height(x - step, y)) / (2 * step)
    along_y = (thing.height(x, y + step) - thing.height(x, y - step)) / (2 * step)
    smooth = np.isfinite(along_x) & np.isfinite(along_y) & (thing.clearance(x, y) > 1e-3)
    assert smooth.sum() > 1000
    found = np.stack(thing.slope(x, y))[:, smooth]
    np.testing.assert_allclose(found, np.stack([along_x, along_y])[:, smooth], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("thing", THINGS, ids=lambda thing: thing.name)
def test_a_line_of_sight_ends_on_the_object(thing):
    x, y = scorer.pixel_grid(SHAPE, PIXEL)
    seen = scorer.see(RIG, thing, x, y, PRESS)
    left, up = scorer.sight(RIG, x, y)
    there = np.isfinite(seen.z)
    assert there.sum() > 50
    np.testing.assert_allclose(seen.x[there], (x + seen.z * left)[there], atol=1e-9)
    np.testing.assert_allclose(seen.y[there], (y + seen.z * up)[there], atol=1e-9)
    np.testing.assert_allclose(seen.z[there], PRESS + thing.height(seen.x, seen.y)[there], atol=1e-9)


def test_no_estimate_of_the_light_beats_the_bound():
    """The best linear estimate about the truth reaches the bound, and cannot do better."""
    x, y = (np.array([[value]]) for value in (3.0, -2.0))
    seen = scorer.Seen(x, y, np.array([[0.4]]), np.array([[0.5]]), np.array([[1.1]]), np.array([[9.0]]))
    bound = scorer.bounds(RIG, seen, 0.0)

    def samples(zenith, azimuth):
        there = seen._replace(zenith=np.array([[zenith]]), azimuth=np.array([[azimuth]]))
        return scorer.frames_of(RIG, there)[:, 0, 0] * RIG.span

    step = 1e-4
    slopes = np.stack(
        [
            (samples(0.5 + step, 1.1) - samples(0.5 - step, 1.1)) / (2 * step),
            (samples(0.5, 1.1 + step) - samples(0.5, 1.1 - step)) / (2 * step),
        ],
        axis=1,
    )
    noise = np.random.default_rng(2).normal(0, RIG.spread, (20_000, 8))
    spread = (noise @ np.linalg.pinv(slopes).T).std(axis=0)
    np.testing.assert_allclose(spread, [bound.zenith[0, 0], bound.azimuth[0, 0]], rtol=0.03)


@pytest.mark.parametrize("turned", [0.3, 2.0])
def test_the_twin_s_light_is_that_of_the_judge(turned):
    """Two programs that know nothing of each other agree, in every frame, on which way is up."""
    lab = Lab(shape=(60, 62), pixel_size=0.15, noise=0.0, gain_deviation=0.0)
    thing, press = scorer.facets(0.45, 3.0, turned, 0.6, 8.0), 1.4
    x, y = scorer.pixel_grid(lab.shape, lab.pixel_size)
    seen = scorer.see(lab.rig, thing, x, y, press)
    light = (lab.turned(thing, press, 0).frames - 16.0) / 208.0
    told = scorer.frames_of(lab.rig, seen)
    # In a pixel's place is the point that moves there: the light of a face changes little over that.
    known = np.isfinite(scorer.bounds(lab.rig, seen, 0.4).zenith)
    assert known.sum() > 500
    error = (light - told)[:, known]
    assert np.abs(error).max() < 0.02
    assert np.abs(error.mean(axis=1)).max() < 0.002
