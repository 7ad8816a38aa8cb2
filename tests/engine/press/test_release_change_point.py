"""The change-point of a release: the kernels against their references, and a press played backwards."""

import numpy as np
import pytest
from changes import assert_near, numpy_change, numpy_split
from presses import SPEC, assert_equal, random_press
from ramps import NOISES, ramps, rms

from mirrorskin.engine import ChangePointSearch, find_change_point
from mirrorskin.io import InputError

DTYPES = sorted(SPEC)
RELEASE = {"event": "release"}


def random_release(dtype, frames, shape, **options):
    return random_press(dtype, frames, shape, **options)[::-1].copy()


def uneven_rise(count):
    return 3 - np.cumsum(np.random.default_rng(5).uniform(0.001, 0.2, count))


def search_in_blocks(frames, travel, cuts, device, **options):
    search = ChangePointSearch(frames.shape[1:], frames.dtype, device=device, **RELEASE, **options)
    for turn in range(search.passes):
        if turn:
            search.start_second_pass()
        for part in np.split(np.arange(len(frames)), cuts):
            search.push(frames[part], travel=travel[part])
    return search.result()


@pytest.mark.parametrize("threshold", [0.5, 0.3, 0.8])
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference(device, dtype, threshold):
    frames = random_release(dtype, 40, (17, 61), seed=3, noise=0.05)
    dark, bright = SPEC[dtype]
    options = {"threshold": threshold, "noise": 0.05 * (bright - dark), **RELEASE}
    travel = uneven_rise(40)
    found = find_change_point(frames, travel, dark=dark, bright=bright, device=device, **options)
    assert {1, 2, 3} <= set(found.status.flat)
    assert_near(found, numpy_change(frames, travel, dark, bright, **options), travel)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference_on_unknown_levels(device, dtype):
    frames = random_release(dtype, 40, (17, 61), seed=4, noise=0.05)
    options = {"noise": 0.05 * (SPEC[dtype][1] - SPEC[dtype][0]), "threshold": 0.4, **RELEASE}
    travel = uneven_rise(40)
    found = find_change_point(frames, travel, device=device, **options)
    assert {1, 3} <= set(found.status.flat)
    assert_near(found, numpy_split(frames, travel, **options), travel)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("dtype", DTYPES)
def test_blocks_make_no_difference(device, dtype, known):
    frames = random_release(dtype, 40, (9, 29), seed=1, noise=0.15)
    options = dict(zip(("dark", "bright"), SPEC[dtype], strict=True)) if known else {}
    whole = search_in_blocks(frames, uneven_rise(40), [], device, **options)
    for cuts in (range(1, 40), range(7, 40, 7), [20]):
        assert_equal(search_in_blocks(frames, uneven_rise(40), list(cuts), device, **options), whole)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("noise", NOISES)
def test_a_release_is_as_good_as_a_press(device, noise, known):
    frames, middle = ramps(noise, pixels=200, seed=5)
    travel = np.arange(64.0)
    levels = {"dark": 20, "bright": 220} if known else {}
    options = {"noise": float(np.hypot(noise, 1 / np.sqrt(12))), "device": device, **levels}
    press = find_change_point(frames, travel, **options)
    release = find_change_point(frames[::-1].copy(), travel[::-1].copy(), **options, **RELEASE)
    assert np.all(release.status == 1)
    error = -release.height - middle
    assert rms(error) < 1.06 * rms(-press.height - middle) + 0.002
    assert 0.7 < np.mean((error / release.sigma) ** 2) < 1.15
    assert np.all(release.sigma > 0)


def test_what_never_changes_is_dark_at_start_or_light_to_the_end(device):
    travel = 6 - np.arange(6.0)
    for value, status in ((20, 2), (200, 3)):
        frames = np.full((6, 5, 7), value, np.uint8)
        given = find_change_point(frames, travel, dark=20, bright=220, device=device, **RELEASE)
        told = find_change_point(frames, travel, device=device, **RELEASE)
        assert np.all(given.status == status)
        assert np.all(told.status == 3)  # no change, whatever the level
        assert np.all(given.frame == (0 if status == 2 else -1))
        assert np.all(np.isnan(given.height))


def test_a_press_is_no_release(device):
    frames = random_press("uint8", 40, (17, 61), seed=4)
    found = find_change_point(frames, uneven_rise(40), noise=1.5, device=device, **RELEASE)
    assert np.all(found.status == 3)


def test_a_saturated_sample_is_light(device):
    frames = np.full((9, 1, 3), 255, np.uint8)
    frames[4:, 0, 0], frames[4:, 0, 1] = 20, 254
    options = {"threshold": 0.9, "noise": 1.0, **RELEASE}
    found = find_change_point(frames, 9 - np.arange(9.0), dark=20, bright=400, device=device, **options)
    np.testing.assert_array_equal(found.status, [[1, 1, 3]])
    assert found.height[0, 0] == pytest.approx(-5.5, abs=0.01)
    assert_near(found, numpy_change(frames, 9 - np.arange(9.0), 20, 400, **options), np.arange(9.0))


def test_pixels_without_references_or_with_a_broken_sample_are_invalid(device):
    frames = np.full((9, 1, 4), 0.9, np.float32)
    frames[4:] = 0.1
    frames[2, 0, 1], frames[2, 0, 2] = np.nan, np.inf
    bright = np.array([[1.0, 1.0, 1.0, np.nan]])
    found = find_change_point(
        frames, 9 - np.arange(9.0), dark=0, bright=bright, noise=0.01, device=device, **RELEASE
    )
    np.testing.assert_array_equal(found.status, [[1, 0, 0, 0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"travel": np.arange(5.0)}, "runs back at frame 1: a release only goes up"),
        ({"travel": [1.0, 0.0]}, "5 frames"),
        ({"event": "slip"}, "unknown event 'slip'; known are onset, release"),
    ],
)
def test_bad_input_is_refused(change, words):
    call = {"frames": np.zeros((5, 3, 3), np.uint8), "travel": -np.arange(5.0), "dark": 20, "bright": 220}
    with pytest.raises(InputError, match=words):
        find_change_point(**(call | RELEASE | change))
