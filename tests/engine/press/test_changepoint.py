"""The change-point: better than any threshold, the kernels against their references, and what is refused."""

import dataclasses

import numpy as np
import pytest
from changes import assert_near, numpy_change, numpy_split
from presses import LEVELS, SPEC, assert_equal, random_press
from ramps import NOISES, WIDTHS, compare, errors, ramps, rms
from stacks import MadeUp, ball

from mirrorskin import engine, io
from mirrorskin.engine import ChangePointSearch, find_change_point, find_onset
from mirrorskin.io import InputError

DTYPES = sorted(SPEC)


def uneven_travel(count, start=0.0):
    return start + np.cumsum(np.random.default_rng(5).uniform(0.001, 0.2, count))


def push_all(search, frames, travel, cuts):
    for part in np.split(np.arange(len(frames)), cuts):
        if len(part):
            search.push(frames[part], travel=travel[part])


def search_in_blocks(frames, travel, cuts, device, **options):
    search = ChangePointSearch(frames.shape[1:], frames.dtype, device=device, **options)
    push_all(search, frames, travel, cuts)
    if search.passes == 2:
        search.start_second_pass()
        push_all(search, frames, travel, cuts)
    return search.result()


@pytest.mark.parametrize("noise", NOISES)
def test_no_fixed_threshold_is_better_on_noisy_ramps(noise):
    best, change, each = compare(noise, pixels=1000)
    assert rms(change) <= 0.95 * rms(best)
    assert np.median(np.abs(change)) <= 0.75 * np.median(np.abs(best))
    # Against the best threshold of each width alone: a step is a draw, and at 1.5 frames the samples do not
    # tell one frame from two, which a threshold chosen for 1.5 need not know.
    ratio = rms(change, axis=1) / each
    fair = np.array(WIDTHS) != 1.5
    assert np.all(ratio[fair] <= 1.03)
    assert np.all(ratio[np.array(WIDTHS) >= 3] <= 0.85)


@pytest.mark.parametrize(
    ("noise", "dark", "bright"), [(1, 100, 140), (4, 100, 140), (2, 3, 253), (20, 3, 253)]
)
def test_no_fixed_threshold_is_better_at_other_levels(noise, dark, bright):
    best, change, _ = compare(noise, pixels=600, dark=dark, bright=bright)
    assert rms(change) <= 0.95 * rms(best)


@pytest.mark.parametrize("noise", NOISES)
def test_sigma_is_honest(device, noise):
    frames, middle = ramps(noise, pixels=500, seed=2)
    known = {"noise": float(np.hypot(noise, 1 / np.sqrt(12))), "device": device}
    found = find_change_point(frames, np.arange(64.0), dark=20, bright=220, **known)
    square = (errors(found.height, found.status, middle) / found.sigma) ** 2
    assert 0.75 < np.mean(square) < 1.1
    each = np.mean(square, axis=1)
    assert each[0] == pytest.approx(1, abs=0.3)
    assert np.all((each > 0.25) & (each < 1.3))
    assert np.all(each[np.array(WIDTHS) >= 4] > 0.7)


@pytest.mark.parametrize("noise", [1, 5, 20])
def test_unknown_levels_cost_little(device, noise):
    frames, middle = ramps(noise, pixels=300, seed=3)
    known = {"noise": float(np.hypot(noise, 1 / np.sqrt(12))), "device": device}
    given = find_change_point(frames, np.arange(64.0), dark=20, bright=220, **known)
    told = find_change_point(frames, np.arange(64.0), **known)
    assert np.all(told.status == 1)
    error = errors(told.height, told.status, middle)
    assert rms(error) < 1.35 * rms(errors(given.height, given.status, middle))
    assert 0.75 < np.mean((error / told.sigma) ** 2) < 1.1


@pytest.mark.parametrize("threshold", [0.5, 0.3, 0.8])
@pytest.mark.parametrize("hold", [1, 2, 12])
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference(device, dtype, hold, threshold):
    frames = random_press(dtype, 40, (17, 61), seed=3, noise=0.05)
    dark, bright = SPEC[dtype]
    options = {"threshold": threshold, "hold": hold, "noise": 0.05 * (bright - dark)}
    travel = uneven_travel(40, start=-1.7)
    found = find_change_point(frames, travel, dark=dark, bright=bright, device=device, **options)
    assert {1, 2, 3} <= set(found.status.flat)
    assert_near(found, numpy_change(frames, travel, dark, bright, **options), travel)


@pytest.mark.parametrize("noise", [0.008, 0.15])
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference_on_unknown_levels(device, dtype, noise):
    frames = random_press(dtype, 40, (17, 61), seed=4, noise=noise)
    counts = noise * (SPEC[dtype][1] - SPEC[dtype][0])
    travel = uneven_travel(40)
    found = find_change_point(frames, travel, noise=counts, device=device)
    assert {1, 2} <= set(found.status.flat)
    assert_near(found, numpy_split(frames, travel, counts), travel)


@pytest.mark.parametrize("dtype", DTYPES)
def test_references_of_each_pixel_are_obeyed(device, dtype):
    frames = random_press(dtype, 30, (17, 23), seed=4)
    generator = np.random.default_rng(6)
    dark, bright = (level * generator.uniform(0.8, 1.2, (17, 23)) for level in SPEC[dtype])
    travel = uneven_travel(30)
    found = find_change_point(frames, travel, dark=dark, bright=bright, noise=0.01, device=device)
    assert_near(found, numpy_change(frames, travel, dark, bright, noise=0.01), travel)


@pytest.mark.parametrize("cuts", [range(1, 40), range(7, 40, 7), [1, 2, 39], [20]])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("dtype", DTYPES)
def test_blocks_make_no_difference(device, dtype, cuts, known):
    frames = random_press(dtype, 40, (9, 29), seed=1, noise=0.15)
    travel = uneven_travel(40)
    options = dict(zip(("dark", "bright"), SPEC[dtype], strict=True)) if known else {}
    whole = search_in_blocks(frames, travel, [], device, **options)
    assert_equal(search_in_blocks(frames, travel, list(cuts), device, **options), whole)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (3, 1024), (5, 411)])
def test_odd_sizes(device, shape):
    frames = random_press("uint8", 12, shape, seed=9)
    travel = np.arange(12) * 0.1
    found = find_change_point(frames, travel, **LEVELS["uint8"], noise=1.5, device=device)
    assert_near(found, numpy_change(frames, travel, *SPEC["uint8"], noise=1.5), travel)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("limit", [40_000, 23 * 31 * 25 - 1, 31 * 25])
def test_less_room_gives_the_same_answer(small_device, limit, known):
    frames, travel = random_press("uint8", 30, (23, 31), seed=5), np.arange(30) * 0.1
    options = {"dark": 20, "bright": 220} if known else {}
    whole = find_change_point(frames, travel, device=small_device, **options)
    small_device.max_allocation = limit
    search = ChangePointSearch((23, 31), frames.dtype, device=small_device, **options)
    assert (len(search._bands) > 1) == (limit < 23 * 31 * 25)
    push_all(search, frames, travel, range(4, 30, 4))
    if not known:
        search.start_second_pass()
        push_all(search, frames, travel, range(5, 30, 5))
    assert_equal(search.result(), whole)
    assert_equal(search.result(), whole)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("dtype", DTYPES)
def test_long_stacks(device, dtype, known):
    """70 000 noisy frames: nothing drifts, whatever the levels."""
    count = 70_000
    dark, bright = SPEC[dtype]
    step = bright - dark
    change = np.array([[30, 255, 256, 35_000, 65_536, count - 30]])
    noise = np.random.default_rng(0).normal(0, 0.1 * step, (count, *change.shape))
    counts = np.where(np.arange(count)[:, None, None] >= change, bright, dark) + noise
    limits = (-np.inf, np.inf) if dtype == "float32" else (0, np.iinfo(dtype).max)
    frames = np.clip(counts if dtype == "float32" else np.rint(counts), *limits).astype(dtype)
    options = {"dark": dark, "bright": bright} if known else {}
    found = find_change_point(frames, np.arange(count) * 1e-3, noise=0.1 * step, device=device, **options)
    np.testing.assert_array_equal(found.frame, change)
    np.testing.assert_allclose(found.height, 5e-4 - change * 1e-3, atol=3e-4)


@pytest.mark.parametrize("known", [True, False])
def test_a_sudden_step_lies_in_the_middle_of_its_interval(device, known):
    frames = np.full((4, 1, 1), 20, np.uint8)
    frames[2:] = 220
    options = {"dark": 20, "bright": 220} if known else {}
    found = find_change_point(frames, [0.0, 0.1, 0.4, 0.5], noise=1.0, device=device, **options)
    assert found.height[0, 0] == pytest.approx(-0.25, abs=1e-3)
    assert found.sigma[0, 0] == pytest.approx(0.15 / np.sqrt(3), rel=0.03)
    assert found.frame[0, 0] == 2


def test_a_ramp_is_measured_exactly_on_uneven_travel(device):
    """A ramp of 16 counts a frame crosses 120 at a quarter after frame 16, and each share where it must."""
    frames = np.clip((np.arange(40) - 10) * 16 + 20, 20, 220).astype(np.uint8)[:, None, None]
    travel = uneven_travel(40)
    for threshold in (0.3, 0.5, 0.7):
        found = find_change_point(
            frames, travel, dark=20, bright=220, threshold=threshold, noise=0.3, device=device
        )
        crossing = 10 + threshold * 200 / 16
        assert found.height[0, 0] == pytest.approx(-np.interp(crossing, np.arange(40), travel), abs=1e-3)


@pytest.mark.parametrize(("width", "noise"), [(24, 12), (32, 8), (64, 2)])
def test_ramps_longer_than_the_samples_kept_are_measured_on_those(device, width, noise):
    generator = np.random.default_rng(1)
    middle = generator.uniform(90, 110, (1, 4000))
    share = np.clip((np.arange(200)[:, None, None] - middle) / width + 0.5, 0, 1)
    frames = np.clip(np.rint(20 + 200 * share + generator.normal(0, noise, share.shape)), 0, 255)
    found = find_change_point(
        frames.astype(np.uint8), np.arange(200.0), dark=20, bright=220, noise=float(noise), device=device
    )
    error = -found.height - middle
    assert np.all(found.status == 1)
    line = noise * width / 200 / 5  # of a straight line through 25 samples
    assert rms(error) < 1.3 * line + 0.1
    assert np.mean((error / found.sigma) ** 2) == pytest.approx(1, abs=0.2)


def test_a_pixel_that_never_gets_as_bright_as_it_should_is_not_biased(device):
    generator = np.random.default_rng(4)
    change = generator.uniform(20, 40, (3, 4000))
    plateau = np.array([[0.6], [0.8], [1.15]])
    share = plateau * (np.arange(60)[:, None, None] >= change)
    counts = 20 + 200 * share + generator.normal(0, 3, share.shape)
    frames = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
    found = find_change_point(frames, np.arange(60.0), dark=20, bright=220, noise=3.0, device=device)
    error = -found.height - change
    assert np.all(found.status == 1)
    assert np.all(np.abs(error.mean(axis=1)) < 0.02)
    assert np.all(rms(error, axis=1) < 0.31)


def test_a_pixel_that_hovers_about_its_level_does_not_claim_to_know_when(device):
    """Light since frame 3, but so faintly that noise decides when it passes for light."""
    generator = np.random.default_rng(3)
    counts = np.where(np.arange(120)[:, None, None] >= 3, 119.5, 20) + generator.normal(0, 1.5, (120, 50, 60))
    frames = np.rint(counts).astype(np.uint8)
    found = find_change_point(frames, np.arange(120) * 0.1, dark=20, bright=220, noise=1.5, device=device)
    expected = numpy_change(frames, np.arange(120) * 0.1, 20, 220, noise=1.5)
    assert_near(found, expected, np.arange(120) * 0.1)
    late = (found.status == 1) & (found.frame > 20)
    assert late.sum() > 100
    assert np.max(np.abs((found.height + 0.25) / found.sigma)[late]) < 4


def test_a_spike_is_no_change_unless_the_stack_ends_on_it(device):
    frames = np.full((9, 1, 4), 20, np.uint8)
    frames[3, 0, 0] = frames[8, 0, 1] = 255
    frames[[3, 4], 0, 2] = 255
    found = find_change_point(frames, np.arange(9.0), dark=20, bright=220, noise=1.0, device=device)
    np.testing.assert_array_equal(found.frame, [[-1, 8, 3, -1]])


def test_spikes_near_the_change_move_it_little(device):
    frames = np.full((40, 1, 24), 20, np.uint8)
    frames[20:] = 200
    for pixel in range(24):
        if not 18 <= pixel + 8 <= 21:  # where it passes for the change itself
            frames[pixel + 8, 0, pixel] = 255 if pixel + 8 < 20 else 20
    found = find_change_point(frames, np.arange(40.0), dark=20, bright=220, noise=1.5, device=device)
    assert np.all(np.abs(found.height + 19.5) < 0.6)
    assert np.all(np.abs(found.height + 19.5) < 3 * found.sigma)
    assert_near(found, numpy_change(frames, np.arange(40.0), 20, 220, noise=1.5), np.arange(40.0))


def test_a_change_of_another_shape_costs_precision_and_says_so(device):
    """A transition that levels off, which no straight ramp is."""
    generator = np.random.default_rng(5)
    start = generator.uniform(24, 36, (1, 4000))
    share = 1 - np.exp(-np.maximum(np.arange(64)[:, None, None] - start, 0) / 3)
    counts = 20 + 200 * share + generator.normal(0, 2, (64, *start.shape))
    frames = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
    found = find_change_point(frames, np.arange(64.0), dark=20, bright=220, noise=2.0, device=device)
    error = -found.height - (start + 3 * np.log(2))
    assert rms(error) < 0.5
    assert np.max(np.abs(error / found.sigma)) < 10
    assert_near(found, numpy_change(frames, np.arange(64.0), 20, 220, noise=2.0), np.arange(64.0))


def test_a_change_at_the_end_has_a_sigma(device):
    frames = random_press("uint8", 20, (60, 60), seed=3, noise=0.05)
    found = find_change_point(frames, np.arange(20.0), dark=20, bright=220, noise=10.0, device=device)
    late = (found.status == 1) & (found.frame >= 18)
    assert late.sum() > 50
    assert np.all(found.sigma[late] > 0.1)
    assert np.all((found.height[late] >= -19) & (found.height[late] <= 0))


def test_a_change_is_not_undone(device):
    """Released again, and pressed once more: the first contact counts."""
    frames = np.full((90, 1, 1), 20, np.uint8)
    frames[10:40] = frames[70:] = 220
    found = find_change_point(frames, np.arange(90.0), dark=20, bright=220, noise=1.0, device=device)
    assert found.frame[0, 0] == 10
    assert found.height[0, 0] == pytest.approx(-9.5, abs=0.01)


@pytest.mark.parametrize(("value", "status"), [(20, 2), (200, 3)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_all_equal_frames(device, dtype, value, status):
    frames = np.full((6, 5, 7), value, dtype)
    given = find_change_point(frames, np.arange(6.0), dark=20, bright=220, device=device)
    told = find_change_point(frames, np.arange(6.0), device=device)
    for found, expected in ((given, status), (told, 2)):
        assert np.all(found.status == expected)
        assert np.all(np.isnan(found.height))
        assert np.all(np.isnan(found.sigma))
    assert np.all(given.frame == (0 if status == 3 else -1))


def test_noise_alone_is_no_change(device):
    counts = 100 + np.random.default_rng(7).normal(0, 5, (200, 100, 100))
    frames = np.rint(counts).astype(np.uint8)
    assert np.all(find_change_point(frames, np.arange(200.0), device=device).status == 2)
    assert np.all(
        find_change_point(frames, np.arange(200.0), dark=100, bright=140, device=device).status == 2
    )
    falling = np.where(np.arange(200)[:, None, None] < 100, frames + 50, frames)
    assert np.all(find_change_point(falling, np.arange(200.0), device=device).status == 2)


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_sample_that_is_no_number_spoils_a_pixel_until_its_change_is_seen(device, broken):
    frames = np.full((40, 1, 5), 0.1, np.float32)
    frames[10:] = 0.9
    frames[0, 0, 0] = frames[9, 0, 1] = frames[10, 0, 2] = frames[22, 0, 3] = frames[23, 0, 4] = broken
    travel = np.arange(40) * 0.1
    found = find_change_point(frames, travel, dark=0.1, bright=0.9, noise=0.01, device=device)
    np.testing.assert_array_equal(found.status, [[0, 0, 0, 0, 1]])
    assert_near(found, numpy_change(frames, travel, 0.1, 0.9, noise=0.01), travel)
    told = find_change_point(frames, travel, noise=0.01, device=device)
    np.testing.assert_array_equal(told.status, [[0] * 5])


def test_a_saturated_sample_is_light(device):
    frames = np.full((9, 1, 2), 20, np.uint8)
    frames[4:, 0, 0], frames[4:, 0, 1] = 255, 254
    found = find_change_point(
        frames, np.arange(9.0), dark=20, bright=400, threshold=0.9, noise=1.0, device=device
    )
    np.testing.assert_array_equal(found.status, [[1, 2]])
    assert found.height[0, 0] == pytest.approx(-3.5, abs=0.01)


def test_pixels_without_references_are_invalid(device):
    frames = np.full((5, 2, 4), 20, np.uint8)
    frames[3:] = 200
    dark, bright = np.full((2, 4), 20.0), np.full((2, 4), 220.0)
    bright[0, 0], dark[0, 1], bright[1, 2] = 20, np.nan, np.inf
    found = find_change_point(frames, np.arange(5.0), dark=dark, bright=bright, device=device)
    np.testing.assert_array_equal(found.status, [[0, 0, 1, 1], [1, 1, 0, 1]])
    assert found.frame[0, 0] == -1


def test_results_on_the_way_change_nothing(device):
    frames, travel = random_press("uint8", 30, (9, 13), seed=7), uneven_travel(30)
    search = ChangePointSearch((9, 13), frames.dtype, dark=20, bright=220, noise=1.5, device=device)
    for number in range(30):
        search.push(frames[number : number + 1], travel=travel[number : number + 1])
        if number:
            so_far = slice(0, number + 1)
            expected = find_change_point(
                frames[so_far], travel[so_far], dark=20, bright=220, noise=1.5, device=device
            )
            assert_equal(search.result(), expected)


@pytest.mark.parametrize("known", [True, False])
def test_a_search_can_be_used_again(device, known):
    first, second = (random_press("uint8", 20, (9, 13), seed=seed) for seed in (1, 2))
    options = {"dark": 20, "bright": 220, "device": device} if known else {"device": device}
    search = ChangePointSearch((9, 13), first.dtype, **options)
    for frames in (first, second):
        search.reset()
        push_all(search, frames, uneven_travel(20), [])
        if not known:
            search.start_second_pass()
            push_all(search, frames, uneven_travel(20), [])
    assert_equal(search.result(), find_change_point(second, uneven_travel(20), **options))


def test_frames_read_into_the_room_are_not_copied(device):
    frames = random_press("uint8", 20, (9, 13))
    search = ChangePointSearch(
        (9, 13), np.uint8, dark=20, bright=220, device=device, memory_limit=2 * 6 * 9 * 13
    )
    assert search.room.shape == (6, 9, 13)
    for start in range(0, 20, 6):
        count = min(6, 20 - start)
        search.room[:count] = frames[start : start + count]
        search.push(search.room[:count], travel=np.arange(20.0)[start : start + count])
    assert_equal(
        search.result(), find_change_point(frames, np.arange(20.0), dark=20, bright=220, device=device)
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": np.zeros((1, 3, 3), np.uint8), "travel": [0.0]}, "at least 2 frames"),
        ({"frames": np.zeros((5, 0, 3), np.uint8)}, "at least 2 frames"),
        ({"frames": np.zeros((5, 3), np.uint8)}, "at least 2 frames"),
        ({"frames": np.zeros((5, 3, 3), np.int32)}, "uint8, uint16 or float32"),
        ({"travel": [0.0, 1.0]}, "5 frames"),
        ({"travel": [0.0, 1.0, 0.5, 2.0, 3.0]}, "runs back at frame 2"),
        ({"dark": np.zeros((2, 3))}, "the frames are 3 x 3"),
        ({"dark": 220, "bright": 20}, "bright is not above dark"),
        ({"threshold": 0.0}, "threshold 0.0"),
        ({"threshold": 1.0}, "threshold 1.0"),
        ({"threshold": np.nan}, "threshold nan"),
        ({"hold": 0}, "hold 0"),
        ({"hold": 13}, "hold 13"),
        ({"noise": -1.0}, "noise -1.0"),
        ({"noise": np.inf}, "noise inf"),
    ],
)
def test_bad_input_is_refused(change, words):
    call = {"frames": np.zeros((5, 3, 3), np.uint8), "travel": np.arange(5.0), "dark": 20, "bright": 220}
    with pytest.raises(InputError, match=words) as caught:
        find_change_point(**(call | change))
    assert "\n" not in str(caught.value)


def test_a_block_of_other_frames_is_refused():
    search = ChangePointSearch((4, 5), np.uint8)
    for frames in (np.zeros((2, 4, 4), np.uint8), np.zeros((2, 4, 5), np.uint16), np.zeros((0, 4, 5), "u1")):
        with pytest.raises(InputError, match="expected uint8"):
            search.push(frames, travel=np.arange(len(frames)) * 0.1)


def test_passes_that_do_not_match_are_refused():
    frames = random_press("uint8", 8, (4, 5))
    search = ChangePointSearch((4, 5), np.uint8)
    with pytest.raises(InputError, match="0 frames has no change-point"):
        search.start_second_pass()
    push_all(search, frames, np.arange(8.0), [])
    with pytest.raises(InputError, match="needs all frames twice: give dark and bright"):
        search.result()
    search.start_second_pass()
    push_all(search, frames[:7], np.arange(7.0), [])
    with pytest.raises(InputError, match="needs all frames twice"):
        search.result()
    with pytest.raises(InputError, match="more frames in the second pass"):
        search.push(frames[:2], travel=np.array([7.0, 8.0]))


TRAVEL = 0.1 * np.arange(1, 31)


def twin(**changes):
    source = ball((120, 120), 0.1, TRAVEL, noise=6.0, seed=7)
    source.header = dataclasses.replace(source.header, **changes)
    return source


def frames_of(source):
    return source.read(np.empty(source.shape, source.dtype)).frames


def test_a_source_is_reconstructed_by_its_change_points():
    result = engine.reconstruct(twin(), method="change-point", fill=False, memory_limit=2 * 7 * 120 * 120)
    source = twin()
    given = find_change_point(frames_of(source), TRAVEL, dark=source.header.dark, bright=source.header.bright)
    np.testing.assert_array_equal(result.height, given.height)
    np.testing.assert_array_equal(result.height_sigma, given.sigma)
    assert result.process["method"] == "change-point"
    assert result.process["dark"] == "map of the recording"
    threshold = engine.reconstruct(twin())
    assert threshold.process["method"] == "threshold"
    truth = twin().truth
    assert engine.score(result, truth).height.rms < engine.score(threshold, truth).height.rms


@pytest.mark.parametrize("missing", [{"dark": None}, {"bright": None}, {"dark": None, "bright": None}])
def test_a_source_without_references_is_read_twice(missing):
    done = []
    source = twin(**missing)
    limit = 2 * 16 * 120 * 120
    options = {"method": "change-point", "fill": False}
    result = engine.reconstruct(source, **options, memory_limit=limit, progress=done.append)
    np.testing.assert_array_equal(result.height, find_change_point(frames_of(twin()), TRAVEL).height)
    assert done == [16, 30, 16, 30]
    assert result.process["dark"] == result.process["bright"] == "each pixel's own"


def test_a_live_source_needs_its_levels():
    source = MadeUp(random_press("uint8", 20, (6, 7)), io.Header("vertical"), travel=np.arange(20) * 0.1)
    with pytest.raises(InputError, match=r"made up cannot be read twice.*: give dark and bright") as caught:
        engine.reconstruct(source, method="change-point", dark=20)
    assert "\n" not in str(caught.value)
    assert source.frames_read == 0
    result = engine.reconstruct(source, method="change-point", dark=20, bright=220)
    assert result.process["frames"] == source.frames_read == 20


def test_a_change_point_has_no_equation_4():
    with pytest.raises(InputError, match="needs method 'threshold'"):
        engine.reconstruct(twin(), method="change-point", subframe=False)


def test_an_unknown_method_is_refused():
    with pytest.raises(
        InputError, match="is a press, which method 'guess' cannot do: take threshold, change-point"
    ):
        engine.reconstruct(twin(), method="guess")


def test_neither_method_depends_on_the_other():
    frames = random_press("uint8", 20, (9, 13))
    before = find_onset(frames, np.arange(20.0))
    find_change_point(frames, np.arange(20.0))
    assert_equal(find_onset(frames, np.arange(20.0)), before)
