"""Onsets and releases of an oscillating press, compared with known truth and the single search."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from bare import bare, find_onset

from mirrorskin import engine, io
from mirrorskin.twin import Camera, Twin, Vertical, oscillating_travel

DARK, BRIGHT, NOISE = 20.0, 220.0, 2.0


def made_press(travel, depth, hysteresis=0.0, rise=1e-9, jitter=0.0, seed=1, full=BRIGHT):
    """Frames of pixels that turn light at a travel and dark again at another; each pixel alone, no twin."""
    random = np.random.default_rng(seed)
    light, frames = np.zeros(depth.shape), []
    for place, step in zip(
        travel + random.normal(0, jitter, len(travel)), np.diff(travel, prepend=travel[0]), strict=True
    ):
        at = depth - (hysteresis if step < 0 else 0.0)
        light = np.clip((place - at) / rise + 0.5, 0, 1)
        frames.append(DARK + (full - DARK) * light + random.normal(0, NOISE, depth.shape))
    return np.clip(np.rint(frames), 0, 255).astype(np.uint8)


class Found(NamedTuple):
    """The maps of onsets, and those of releases."""

    onset: io.Result
    release: io.Result


def strokes_of(frames, travel, blocks=(), **options):
    results = []
    for event in ("onset", "release"):
        strokes = engine.press.Strokes(event=event, **({"dark": DARK, "bright": BRIGHT} | options))
        results.append(bare(strokes, frames, blocks, travel=travel))
    return Found(*results)


def chi_square(onset, truth):
    return float(np.nanmean(((onset.height - truth) / onset.height_sigma) ** 2))


DEPTH = np.random.default_rng(2).uniform(0.1, 1.1, (50, 60))
UNEVEN = 0.6 - 0.6 * np.cos(0.388 * np.arange(154))  # no two strokes pass the same places
EVEN = oscillating_travel(0.0, 1.2, 16, 161)


@pytest.mark.parametrize("travel", [UNEVEN, EVEN], ids=["uneven", "even"])
@pytest.mark.parametrize("hysteresis", [0.0, 0.07])
def test_onset_release_and_hysteresis_are_unbiased_and_have_true_errors(travel, hysteresis):
    strokes = strokes_of(made_press(travel, DEPTH, hysteresis), travel)
    lower = DEPTH - hysteresis
    for onset, truth in ((strokes.onset, -DEPTH), (strokes.release, -lower)):
        valid = (onset.status == 1) & (DEPTH > 0.2)
        error = (onset.height - truth)[valid]
        assert valid.sum() > 2500
        # Few of the errors are independent.
        assert abs(error.mean()) < 4 * np.sqrt(np.mean(onset.height_sigma[valid] ** 2) / 50)
        assert np.mean((error / onset.height_sigma[valid]) ** 2) == pytest.approx(1, abs=0.1)


def test_onsets_that_noise_hides_at_first_are_joined_by_the_steps_in_which_they_were():
    strokes = strokes_of(made_press(UNEVEN, DEPTH, full=122.0), UNEVEN, noise=NOISE)  # the level is 120
    valid = strokes.onset.status == 1
    error = (strokes.onset.height + DEPTH)[valid]
    assert valid.mean() > 0.95
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.mean((error / strokes.onset.height_sigma[valid]) ** 2) < 1.5


def test_hysteresis_is_the_difference_of_both():
    strokes = strokes_of(made_press(UNEVEN, DEPTH, 0.07), UNEVEN)
    miss = (strokes.onset.hysteresis - 0.07)[DEPTH > 0.2]
    assert abs(miss.mean()) < 1e-3
    assert np.mean((miss / strokes.onset.hysteresis_sigma[DEPTH > 0.2]) ** 2) == pytest.approx(1, abs=0.25)


def test_strokes_that_pass_other_places_contain_more_information_than_their_mean_would():
    """Intervals overlap in ever less: of n strokes the error falls as 1 / n, a mean's as 1 / sqrt(n)."""
    strokes = strokes_of(made_press(UNEVEN, DEPTH), UNEVEN)
    single = find_onset(made_press(UNEVEN, DEPTH)[:9], UNEVEN[:9], dark=DARK, bright=BRIGHT)
    rms = [np.sqrt(np.nanmean((map_.height + DEPTH) ** 2)) for map_ in (single, strokes.onset)]
    assert rms[1] < 0.7 * rms[0] / np.sqrt(np.median(strokes.onset.strokes))


def test_a_scatter_beyond_what_is_predicted_counts():
    strokes = strokes_of(made_press(UNEVEN, DEPTH, jitter=0.05), UNEVEN)
    inner = (DEPTH > 0.3) & (DEPTH < 0.9)
    exact = strokes_of(made_press(UNEVEN, DEPTH), UNEVEN)
    assert np.median(strokes.onset.height_sigma[inner]) > 2 * np.median(exact.onset.height_sigma[inner])
    assert np.mean(((strokes.onset.height + DEPTH) / strokes.onset.height_sigma)[inner] ** 2) < 1.3


def test_samples_on_the_way_are_averaged_by_inverse_variance():
    strokes = strokes_of(made_press(UNEVEN, DEPTH, rise=0.5), UNEVEN, noise=NOISE)
    inner = (DEPTH > 0.35) & (DEPTH < 0.85)
    error = (strokes.onset.height + DEPTH)[inner]
    assert np.sqrt(np.mean(error**2)) < 0.003
    # These ramps are straight, and the standard deviation allows for a blur as well.
    assert 0.65 < np.mean((error / strokes.onset.height_sigma[inner]) ** 2) < 1.1


def test_one_stroke_is_the_press_bit_by_bit():
    travel = np.linspace(0, 1.2, 30)
    frames = made_press(travel, DEPTH)
    strokes, press = strokes_of(frames, travel), find_onset(frames, travel, dark=DARK, bright=BRIGHT)
    for field in ("height", "height_sigma", "status", "frame"):
        np.testing.assert_array_equal(getattr(strokes.onset, field), getattr(press, field))
    assert strokes.onset.process["noise"] == press.process["noise"]
    assert np.isnan(strokes.release.height).all()


def test_a_first_stroke_up_is_one_of_releases():
    travel = 1.2 - oscillating_travel(0.0, 1.2, 3, 46)
    strokes = strokes_of(made_press(travel, DEPTH), travel)
    valid = DEPTH > 0.2
    assert strokes.onset.process["strokes"] == 3
    assert np.all(strokes.release.strokes[valid] == 2)
    assert np.all(strokes.onset.strokes[valid] == 1)
    assert chi_square(strokes.onset, -DEPTH) < 1.5


def test_a_rest_before_a_stroke_up_is_not_a_stroke():
    travel = np.concatenate([np.full(5, 1.2), 1.2 - oscillating_travel(0.0, 1.2, 3, 46)])
    strokes = strokes_of(made_press(travel, DEPTH), travel)
    same = strokes_of(made_press(travel, DEPTH), travel, blocks=range(1, len(travel)))
    assert strokes.onset.process["strokes"] == 3
    assert np.all(strokes.onset.strokes[DEPTH > 0.2] == 1)
    assert chi_square(strokes.onset, -DEPTH) < 1.5
    np.testing.assert_array_equal(strokes.onset.height, same.onset.height)
    assert np.all(np.diff(travel)[strokes.onset.frame[DEPTH > 0.2] - 1] > 0)


@pytest.fixture(scope="module")
def dither():
    travel = oscillating_travel(0.0, 1.2, 9, 83)
    return Twin(
        object="sphere", shape=(48, 48), pixel_size=0.16, movement=Vertical(travel), camera=Camera(seed=4)
    )


def test_a_source_that_oscillates_is_reconstructed_from_all_its_strokes(dither):
    result = engine.reconstruct(dither, fill=False)
    error = result.height - dither.truth.height
    inner = result.strokes > 1
    assert result.process["strokes"] == 9
    assert inner.sum() > 900
    assert np.sqrt(np.mean(error[inner] ** 2)) < 0.02
    assert 0.4 < np.mean((error[inner] / result.height_sigma[inner]) ** 2) < 1.25
    up = engine.reconstruct(dither, fill=False, event="release")
    np.testing.assert_array_equal(up.hysteresis, result.hysteresis)
    np.testing.assert_allclose((up.height - result.height)[inner], result.hysteresis[inner], atol=1e-6)


def test_what_needs_one_press_is_refused():
    with pytest.raises(io.InputError, match="travel is nan at frame 1"):
        strokes_of(made_press(UNEVEN[:3], DEPTH), np.array([0, np.nan, 1]))
    with pytest.raises(io.InputError, match="at least 2 frames; 1 has been"):
        strokes_of(made_press(UNEVEN[:1], DEPTH), UNEVEN[:1])
