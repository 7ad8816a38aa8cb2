"""The change-point: better than any threshold, kernels equal to their references, and refusals."""

import numpy as np
import pytest
from bare import bare, find_change_point
from changes import assert_near, numpy_change, numpy_split
from presses import LEVELS, SPEC, assert_equal, random_press

from mirrorskin.engine import ChangePoint, Run
from mirrorskin.evaluation.ramps import NOISES, WIDTHS, compare, errors, ramps, rms
from mirrorskin.io import InputError

DTYPES = sorted(SPEC)
EVENTS = ["onset", "release"]
RELEASE = {"event": "release"}
SLOW = pytest.mark.slow


def stroke(dtype, count, shape, event="onset", **options):
    """Frames and uneven travel of a press, or of one that is played backwards."""
    frames = random_press(dtype, count, shape, **options)
    travel = np.cumsum(np.random.default_rng(5).uniform(0.001, 0.2, count)) - 1.7
    return (frames, travel) if event == "onset" else (frames[::-1].copy(), travel[::-1].copy())


def search_in_blocks(search, frames, travel, cuts=()):
    return bare(search, frames, cuts, travel=travel)


@pytest.mark.parametrize("noise", [pytest.param(n, marks=[SLOW] if n != 5 else []) for n in NOISES])
def test_no_fixed_threshold_is_better_on_noisy_ramps(noise):
    best, change, each = compare(noise, pixels=1000)
    assert rms(change) <= 0.95 * rms(best)
    assert np.median(np.abs(change)) <= 0.75 * np.median(np.abs(best))
    # Against the best threshold of each width alone: a step is a draw, and at 1.5 frames the samples do not
    # tell one frame from two, which a threshold chosen for 1.5 need not know.
    ratio = rms(change, axis=1) / each
    assert np.all(ratio[np.array(WIDTHS) != 1.5] <= 1.03)
    assert np.all(ratio[np.array(WIDTHS) >= 3] <= 0.85)


@SLOW
@pytest.mark.parametrize(
    ("noise", "dark", "bright"), [(1, 100, 140), (4, 100, 140), (2, 3, 253), (20, 3, 253)]
)
def test_no_fixed_threshold_is_better_at_other_levels(noise, dark, bright):
    best, change, _ = compare(noise, pixels=600, dark=dark, bright=bright)
    assert rms(change) <= 0.95 * rms(best)


@pytest.mark.parametrize("noise", [pytest.param(n, marks=[SLOW] if n not in (1, 8) else []) for n in NOISES])
def test_sigma_is_true_unknown_levels_cost_little_and_a_release_is_as_good(device, noise):
    frames, middle = ramps(noise, pixels=500, seed=2)
    travel = np.arange(64.0)
    options = {"noise": float(np.hypot(noise, 1 / np.sqrt(12))), "device": device}
    result = find_change_point(frames, travel, **LEVELS["uint8"], **options)
    error = errors(result, middle)
    square = (error / result.height_sigma) ** 2
    assert 0.65 < np.mean(square) < 1.1  # ramps are straight, and sigma allows for a blur where noise is low
    each = np.mean(square, axis=1)
    assert each[0] == pytest.approx(1, abs=0.3)
    assert np.all((each > 0.25) & (each < 1.3))
    assert np.all(each[np.array(WIDTHS) >= 4] > 0.7)

    split = find_change_point(frames, travel, **options)
    assert rms(errors(split, middle)) < 1.35 * rms(error)
    back, up = frames[::-1].copy(), travel[::-1].copy()
    for levels, press in ((LEVELS["uint8"], result), ({}, split)):
        release = find_change_point(back, up, **levels, **options, **RELEASE)
        assert np.all((press.status == 1) & (release.status == 1))
        wrong = -release.height - middle
        assert rms(wrong) < 1.06 * rms(-press.height - middle) + 0.002
        assert 0.55 < np.mean((wrong / release.height_sigma) ** 2) < 1.15


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference_however_the_stack_is_cut(device, dtype, event):
    levels, generator = SPEC[dtype], np.random.default_rng(6)
    frames, travel = stroke(dtype, 40, (17, 61), event, seed=3, noise=0.05)
    for hold, threshold, maps in ((1, 0.5, False), (2, 0.3, True), (12, 0.8, False)):
        dark, bright = (part * generator.uniform(0.8, 1.2, (17, 61)) for part in levels) if maps else levels
        options = {"threshold": threshold, "hold": hold, "noise": 0.05 * (levels[1] - levels[0])}
        options["event"] = event
        result = find_change_point(frames, travel, dark=dark, bright=bright, device=device, **options)
        assert {1, 2, 3} <= set(result.status.flat)
        assert_near(result, numpy_change(frames, travel, dark, bright, **options), travel)
        arguments = {"dark": dark, "bright": bright, "device": device, **options}
        search = ChangePoint(**arguments)
        for cuts in (range(1, 40), [1, 2, 39]):
            assert_equal(search_in_blocks(search, frames, travel, list(cuts)), result)


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference_on_unknown_levels(device, dtype, event):
    for noise in (0.008, 0.15):
        frames, travel = stroke(dtype, 40, (17, 61), event, seed=4, noise=noise)
        options = {"noise": noise * (SPEC[dtype][1] - SPEC[dtype][0]), "threshold": 0.4, "event": event}
        result = find_change_point(frames, travel, device=device, **options)
        assert {1, 2 if event == "onset" else 3} <= set(result.status.flat)
        assert_near(result, numpy_split(frames, travel, **options), travel)
        search = ChangePoint(device=device, **options)
        for cuts in (range(1, 40), range(7, 40, 7)):
            assert_equal(search_in_blocks(search, frames, travel, list(cuts)), result)


@SLOW
@pytest.mark.parametrize("levels", [True, False])
@pytest.mark.parametrize("dtype", DTYPES)
def test_long_stacks(device, dtype, levels):
    """70 000 noisy frames: nothing drifts, whatever the levels."""
    count = 70_000
    dark, bright = SPEC[dtype]
    step = bright - dark
    change = np.array([[30, 255, 256, 35_000, 65_536, count - 30]])
    noise = np.random.default_rng(0).normal(0, 0.1 * step, (count, *change.shape))
    counts = np.where(np.arange(count)[:, None, None] >= change, bright, dark) + noise
    limits = (-np.inf, np.inf) if dtype == "float32" else (0, np.iinfo(dtype).max)
    frames = np.clip(counts if dtype == "float32" else np.rint(counts), *limits).astype(dtype)
    options = {"dark": dark, "bright": bright} if levels else {}
    result = find_change_point(frames, np.arange(count) * 1e-3, noise=0.1 * step, device=device, **options)
    np.testing.assert_array_equal(result.frame, change)
    np.testing.assert_allclose(result.height, 5e-4 - change * 1e-3, atol=3e-4)


@pytest.mark.parametrize("levels", [LEVELS["uint8"], {}], ids=["known", "unknown"])
def test_a_sudden_step_is_in_the_middle_of_its_interval(device, levels):
    frames = np.full((4, 1, 1), 20, np.uint8)
    frames[2:] = 220
    result = find_change_point(frames, [0.0, 0.1, 0.4, 0.5], noise=1.0, device=device, **levels)
    assert result.height[0, 0] == pytest.approx(-0.25, abs=1e-3)
    assert result.height_sigma[0, 0] == pytest.approx(0.15 / np.sqrt(3), rel=0.03)
    assert result.frame[0, 0] == 2


def test_a_ramp_is_measured_exactly_on_uneven_travel(device):
    """A ramp of 16 counts a frame crosses 120 at a quarter after frame 16, and each share where it must."""
    frames = np.clip((np.arange(40) - 10) * 16 + 20, 20, 220).astype(np.uint8)[:, None, None]
    travel = np.cumsum(np.random.default_rng(5).uniform(0.001, 0.2, 40))
    for threshold in (0.3, 0.5, 0.7):
        options = {"threshold": threshold, "noise": 0.3, "device": device, **LEVELS["uint8"]}
        crossing = np.interp(10 + threshold * 200 / 16, np.arange(40), travel)
        assert find_change_point(frames, travel, **options).height[0, 0] == pytest.approx(-crossing, abs=1e-3)


def test_ramps_longer_than_the_samples_kept_are_measured_on_those(device):
    for width, noise in ((24, 12), (64, 2)):
        generator = np.random.default_rng(1)
        middle = generator.uniform(90, 110, (1, 4000))
        fraction = np.clip((np.arange(200)[:, None, None] - middle) / width + 0.5, 0, 1)
        counts = np.rint(20 + 200 * fraction + generator.normal(0, noise, fraction.shape))
        frames = np.clip(counts, 0, 255).astype(np.uint8)
        options = {"noise": float(noise), "device": device, **LEVELS["uint8"]}
        result = find_change_point(frames, np.arange(200.0), **options)
        error = -result.height - middle
        line = noise * width / 200 / 5  # of a straight line through 25 samples
        assert rms(error) < 1.3 * line + 0.1
        assert np.mean((error / result.height_sigma) ** 2) == pytest.approx(1, abs=0.2)


def test_a_pixel_that_never_gets_as_bright_as_it_should_is_not_biased(device):
    generator = np.random.default_rng(4)
    change = generator.uniform(20, 40, (3, 4000))
    fraction = np.array([[0.6], [0.8], [1.15]]) * (np.arange(60)[:, None, None] >= change)
    counts = 20 + 200 * fraction + generator.normal(0, 3, fraction.shape)
    frames = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
    result = find_change_point(frames, np.arange(60.0), **LEVELS["uint8"], noise=3.0, device=device)
    error = -result.height - change
    assert np.all(np.abs(error.mean(axis=1)) < 0.02)
    assert np.all(rms(error, axis=1) < 0.31)


def test_a_pixel_that_hovers_about_its_level_does_not_claim_to_know_when(device):
    """Light since frame 3, but so faintly that noise decides when it passes for light."""
    generator, travel = np.random.default_rng(3), np.arange(120) * 0.1
    counts = np.where(np.arange(120)[:, None, None] >= 3, 119.5, 20) + generator.normal(0, 1.5, (120, 50, 60))
    frames = np.rint(counts).astype(np.uint8)
    result = find_change_point(frames, travel, **LEVELS["uint8"], noise=1.5, device=device)
    assert_near(result, numpy_change(frames, travel, 20, 220, noise=1.5), travel)
    late = (result.status == 1) & (result.frame > 20)
    assert late.sum() > 100
    assert np.max(np.abs((result.height + 0.25) / result.height_sigma)[late]) < 4


def test_spikes_make_no_change_unless_the_stack_ends_on_one_and_move_it_little(device):
    frames = np.full((9, 1, 4), 20, np.uint8)
    frames[3, 0, 0] = frames[8, 0, 1] = 255
    frames[[3, 4], 0, 2] = 255
    result = find_change_point(frames, np.arange(9.0), **LEVELS["uint8"], noise=1.0, device=device)
    np.testing.assert_array_equal(result.frame, [[-1, 8, 3, -1]])
    frames = np.full((40, 1, 24), 20, np.uint8)
    frames[20:] = 200
    for pixel in range(24):
        if not 18 <= pixel + 8 <= 21:  # where it passes for the change itself
            frames[pixel + 8, 0, pixel] = 255 if pixel + 8 < 20 else 20
    result = find_change_point(frames, np.arange(40.0), **LEVELS["uint8"], noise=1.5, device=device)
    assert np.all(np.abs(result.height + 19.5) < np.minimum(0.6, 3 * result.height_sigma))
    assert_near(result, numpy_change(frames, np.arange(40.0), 20, 220, noise=1.5), np.arange(40.0))


def test_a_change_of_another_shape_costs_precision_and_reports_it(device):
    """A transition that levels off, which no straight ramp is."""
    generator = np.random.default_rng(5)
    start = generator.uniform(24, 36, (1, 4000))
    fraction = 1 - np.exp(-np.maximum(np.arange(64)[:, None, None] - start, 0) / 3)
    counts = 20 + 200 * fraction + generator.normal(0, 2, (64, *start.shape))
    frames = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
    result = find_change_point(frames, np.arange(64.0), **LEVELS["uint8"], noise=2.0, device=device)
    error = -result.height - (start + 3 * np.log(2))
    assert rms(error) < 0.5
    assert np.max(np.abs(error / result.height_sigma)) < 10
    assert_near(result, numpy_change(frames, np.arange(64.0), 20, 220, noise=2.0), np.arange(64.0))


def test_a_change_at_the_end_has_a_sigma_and_none_is_undone(device):
    frames = random_press("uint8", 20, (60, 60), seed=3, noise=0.05)
    result = find_change_point(frames, np.arange(20.0), **LEVELS["uint8"], noise=10.0, device=device)
    late = (result.status == 1) & (result.frame >= 18)
    assert late.sum() > 50
    assert np.all(result.height_sigma[late] > 0.1)
    frames = np.full((90, 1, 1), 20, np.uint8)  # released again, and pressed once more: the first counts
    frames[10:40] = frames[70:] = 220
    result = find_change_point(frames, np.arange(90.0), **LEVELS["uint8"], noise=1.0, device=device)
    assert result.height[0, 0] == pytest.approx(-9.5, abs=0.01)


@pytest.mark.parametrize("event", EVENTS)
def test_what_never_changes_has_no_height(device, event):
    travel = np.arange(6.0) if event == "onset" else -np.arange(6.0)
    for value, status in ((20, 2), (200, 3)):
        frames = np.full((6, 5, 7), value, np.uint8)
        result = find_change_point(frames, travel, **LEVELS["uint8"], event=event, device=device)
        split = find_change_point(frames, travel, event=event, device=device)
        starts = status == (3 if event == "onset" else 2)
        assert np.all(result.status == status)
        assert np.all(result.frame == (0 if starts else -1))
        assert np.all(split.status == (2 if event == "onset" else 3))  # no change, whatever the level
        assert np.isnan([result.height, result.height_sigma, split.height, split.height_sigma]).all()


def test_noise_alone_and_a_change_the_other_way_are_no_change(device):
    counts = 100 + np.random.default_rng(7).normal(0, 5, (200, 100, 100))
    frames, travel = np.rint(counts).astype(np.uint8), np.arange(200.0)
    assert np.all(find_change_point(frames, travel, device=device).status == 2)
    assert np.all(find_change_point(frames, travel, dark=100, bright=140, device=device).status == 2)
    falling = np.where(np.arange(200)[:, None, None] < 100, frames + 50, frames)
    assert np.all(find_change_point(falling, travel, device=device).status == 2)
    assert np.all(find_change_point(falling[::-1].copy(), -travel, device=device, **RELEASE).status == 3)


def test_a_sample_that_is_not_a_number_spoils_a_pixel_until_its_change_is_seen(device):
    travel = np.arange(40) * 0.1
    for broken in (np.nan, np.inf, -np.inf):
        frames = np.full((40, 1, 5), 0.1, np.float32)
        frames[10:] = 0.9
        frames[0, 0, 0] = frames[9, 0, 1] = frames[10, 0, 2] = frames[22, 0, 3] = frames[23, 0, 4] = broken
        result = find_change_point(frames, travel, dark=0.1, bright=0.9, noise=0.01, device=device)
        np.testing.assert_array_equal(result.status, [[0, 0, 0, 0, 1]])
        assert_near(result, numpy_change(frames, travel, 0.1, 0.9, noise=0.01), travel)
        assert np.all(find_change_point(frames, travel, noise=0.01, device=device).status == 0)


@pytest.mark.parametrize("event", EVENTS)
def test_a_saturated_sample_is_light_and_pixels_without_references_are_invalid(device, event):
    frames, travel = np.full((9, 1, 4), 20, np.uint8), np.arange(9.0)
    frames[4:, 0, 0], frames[4:, 0, 1], frames[:, 0, 2] = 255, 254, 255
    bright = np.array([[400, 400, 400, np.nan]])
    if event == "release":
        frames, travel = frames[::-1].copy(), travel[::-1].copy()
    options = {"threshold": 0.9, "noise": 1.0, "event": event}
    result = find_change_point(frames, travel, dark=20, bright=bright, device=device, **options)
    np.testing.assert_array_equal(result.status, [[1, 2, 3, 0]])
    assert result.height[0, 0] == pytest.approx(-3.5, abs=0.01)
    assert_near(result, numpy_change(frames, travel, 20, bright, **options), travel)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": np.zeros((1, 3, 3), np.uint8), "travel": [0.0]}, "at least 2 frames"),
        ({"event": "release"}, "runs back at frame 1: a release only goes up"),
        ({"threshold": 0.0}, "threshold 0.0"),
        ({"hold": 13}, "hold 13"),
    ],
)
def test_bad_input_is_refused(change, words):
    call = {"frames": np.zeros((5, 3, 3), np.uint8), "travel": np.arange(5.0), **LEVELS["uint8"]}
    with pytest.raises(InputError, match=words) as caught:
        find_change_point(**(call | change))
    assert "\n" not in str(caught.value)


def test_frames_that_are_pushed_once_are_refused_without_levels():
    frames, travel = random_press("uint8", 8, (4, 5)), np.arange(8.0)
    run = Run(ChangePoint())
    with pytest.raises(InputError, match="ChangePoint needs all frames twice: give them"):
        run.push(frames, travel=travel)
