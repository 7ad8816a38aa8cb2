"""The onset: the kernels against their references, the references against a loop over pixels."""

import numpy as np
import pytest
from presses import (
    LEVELS,
    SPEC,
    assert_equal,
    assert_within_an_ulp,
    first_run,
    looks_between,
    numpy_onset,
    random_press,
)

from mirrorskin.engine import OnsetSearch, find_onset
from mirrorskin.io import InputError
from mirrorskin.kernels.layout import CPU_LAYOUT

DTYPES = sorted(SPEC)
ODD, EVEN = (33, 61), (32, 64)  # pixels: a frame of the latter is whole words
# Three frames from an onset on are looked at in any case, and 32 at once.
BY_HOLD = pytest.mark.parametrize(("hold", "size"), [(1, ODD), (2, ODD), (3, EVEN), (5, ODD), (300, EVEN)])


def uneven_travel(count, start=0.0):
    return start + np.cumsum(np.random.default_rng(5).uniform(0.001, 0.2, count))


def search_in_blocks(frames, travel, cuts, device, **options):
    search = OnsetSearch(frames.shape[1:], frames.dtype, device=device, **options)
    for part in np.split(np.arange(len(frames)), cuts):
        if len(part):
            search.push(frames[part], travel=travel[part])
    return search.result()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("hold", [1, 2, 3, 7, 300])
def test_the_reference_finds_the_first_run_that_holds(dtype, hold):
    dark, bright = SPEC[dtype]
    frames = random_press(dtype, 25, (9, 11), seed=hold, noise=0.2)
    found = numpy_onset(frames, np.arange(25.0), dark, bright, noise=1.0, hold=hold)
    light = frames.astype(float) >= (dark + bright) / 2
    expected = np.array([first_run(series, hold) for series in light.reshape(25, -1).T]).reshape(9, 11)
    np.testing.assert_array_equal(found.frame, expected)
    np.testing.assert_array_equal(found.status, np.select([expected == -1, expected == 0], [2, 3], 1))


@BY_HOLD
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference(device, dtype, hold, size):
    frames = random_press(dtype, 40, size, seed=3)
    dark, bright = SPEC[dtype]
    noise = 0.008 * (bright - dark)
    travel = uneven_travel(40, start=-1.7)
    subframe = looks_between(device, dtype, hold)
    options = {"threshold": 0.4, "hold": hold, "subframe": subframe, "noise": noise}
    found = find_onset(frames, travel, dark=dark, bright=bright, device=device, **options)
    assert {1, 2, 3} <= set(found.status.flat)
    assert_within_an_ulp(found, numpy_onset(frames, travel, dark, bright, **options), travel)


def test_a_device_agrees_without_references(device):
    frames = random_press("uint8", 40, (33, 61), seed=8)
    travel = uneven_travel(40)
    found = find_onset(frames, travel, noise=1.5, device=device)
    expected = numpy_onset(frames, travel, None, None, noise=1.5, own_dark=True)
    assert_within_an_ulp(found, expected, travel)


@pytest.mark.parametrize("dtype", DTYPES)
def test_references_of_each_pixel_are_obeyed(device, dtype):
    frames = random_press(dtype, 30, (17, 23), seed=4)
    generator = np.random.default_rng(6)
    dark, bright = (level * generator.uniform(0.8, 1.2, (17, 23)) for level in SPEC[dtype])
    travel = uneven_travel(30)
    found = find_onset(frames, travel, dark=dark, bright=bright, noise=0.01, device=device)
    assert_within_an_ulp(found, numpy_onset(frames, travel, dark, bright, noise=0.01), travel)


@pytest.mark.parametrize("cuts", [range(1, 40), range(7, 40, 7), [1, 2, 39], [20]])
@pytest.mark.parametrize("dtype", DTYPES)
@BY_HOLD
def test_blocks_make_no_difference(device, dtype, cuts, hold, size):
    frames = random_press(dtype, 40, size, seed=1, noise=0.15)
    travel = uneven_travel(40)
    dark, bright = SPEC[dtype]
    subframe = looks_between(device, dtype, hold)
    options = {"dark": dark, "bright": bright, "hold": hold, "subframe": subframe, "device": device}
    whole = search_in_blocks(frames, travel, [], **options)
    assert_equal(search_in_blocks(frames, travel, list(cuts), **options), whole)


def test_blocks_make_no_difference_to_a_dark_of_its_own(device):
    frames = random_press("uint8", 40, (19, 29), seed=2)
    travel = uneven_travel(40)
    whole = search_in_blocks(frames, travel, [], device)
    assert_equal(search_in_blocks(frames, travel, list(range(1, 40)), device), whole)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (37, 53), (3, 1024), (5, 411)])
def test_odd_sizes(device, shape):
    frames = random_press("uint8", 12, shape, seed=9)
    travel = np.arange(12) * 0.1
    found = find_onset(frames, travel, **LEVELS["uint8"], noise=1.5, device=device)
    assert_within_an_ulp(found, numpy_onset(frames, travel, *SPEC["uint8"], noise=1.5), travel)


@pytest.mark.parametrize(("count", "dtype"), [(300, "uint8"), (70_000, "uint8"), (70_000, "uint16")])
def test_long_stacks(device, count, dtype):
    dark, bright = SPEC[dtype]
    onset = np.array([[1, 254, 255, 256], [count - 300, count - 2, count - 1, count + 1]])
    frames = np.where(np.arange(count)[:, None, None] >= onset, bright, dark).astype(dtype)
    found = find_onset(frames, np.arange(count) * 1e-3, dark=dark, bright=bright, device=device)
    np.testing.assert_array_equal(found.frame, np.where(onset < count, onset, -1))


def test_a_sudden_step_lies_in_the_middle_of_its_interval(device):
    frames = np.full((4, 1, 1), 20, np.uint8)
    frames[2:] = 180
    found = find_onset(frames, [0.0, 0.1, 0.4, 0.5], dark=20, bright=220, noise=1.0, device=device)
    assert found.height[0, 0] == np.float32(-0.25)
    assert found.sigma[0, 0] == pytest.approx(0.15 / np.sqrt(3))


def test_a_ramp_is_interpolated_exactly(device):
    """A ramp of 16 counts a frame crosses 120 at 1.25 frames after the fifth, whatever the references."""
    frames = (np.arange(12) * 16 + 20).astype(np.uint8)[:, None, None]
    found = find_onset(frames, np.arange(12) * 0.1, dark=20, bright=220, noise=1.0, device=device)
    assert found.height[0, 0] == pytest.approx(-0.625, abs=1e-7)
    share = 0.25
    assert found.sigma[0, 0] == pytest.approx(0.1 / 16 * np.hypot(share, 1 - share), rel=1e-5)


def test_without_subframe_the_height_is_equation_4_to_the_letter(device):
    frames = random_press("uint8", 30, (9, 9), seed=2)
    travel = np.arange(1, 31) * 0.1
    found = find_onset(frames, travel, **LEVELS["uint8"], subframe=False, device=device)
    answered = found.status == 1
    np.testing.assert_array_equal(found.height[answered], -travel[found.frame[answered]].astype(np.float32))
    np.testing.assert_allclose(found.sigma[answered], 0.1 / np.sqrt(3), rtol=1e-6)


def test_sigma_is_honest_on_ramps(device):
    """On a ramp whose steps stand well above the noise, the mean square of error over sigma is 1."""
    generator = np.random.default_rng(0)
    shape, count, slope = (200, 250), 24, 24.0
    crossing = generator.uniform(10, 14, shape)
    number = np.arange(count)[:, None, None]
    counts = 120 + slope * (number - crossing) + generator.normal(0, 1.5, (count, *shape))
    frames = counts.astype(np.float32)
    found = find_onset(frames, np.arange(count) * 0.1, dark=20, bright=220, noise=1.5, device=device)
    error = found.height + 0.1 * crossing
    assert np.all(found.status == 1)
    assert np.mean((error / found.sigma) ** 2) == pytest.approx(1, abs=0.05)


def test_sigma_is_honest_on_steps(device):
    generator = np.random.default_rng(0)
    crossing = generator.uniform(1, 28, (200, 250))
    frames = np.where(np.arange(30)[:, None, None] >= crossing, 200, 20) + generator.normal(
        0, 1.5, (30, 200, 250)
    )
    found = find_onset(
        np.rint(frames).astype(np.uint8), np.arange(30) * 0.1, dark=20, bright=220, device=device
    )
    error = found.height + 0.1 * crossing
    assert np.mean((error / found.sigma) ** 2) == pytest.approx(1, abs=0.05)
    assert abs(np.mean(error)) < 0.001


def test_noise_is_told_from_the_first_two_frames():
    generator = np.random.default_rng(1)
    for noise in (0.6, 1.5, 6.0):
        frames = np.rint(30 + generator.normal(0, noise, (5, 200, 200))).astype(np.uint8)
        frames[1, :, :40] = 200  # what changes in between is left out
        found = find_onset(frames, np.arange(5.0), dark=20, bright=220)
        assert found.noise == pytest.approx(np.hypot(noise, 1 / np.sqrt(12)), rel=0.03)


def test_a_spike_is_no_onset_unless_the_stack_ends_on_it(device):
    frames = np.full((9, 1, 4), 20, np.uint8)
    frames[3, 0, 0] = 255
    frames[8, 0, 1] = 255
    frames[[3, 4], 0, 2] = 255
    found = find_onset(frames, np.arange(9.0), dark=20, bright=220, device=device)
    np.testing.assert_array_equal(found.frame, [[-1, 8, 3, -1]])


def test_a_spike_on_the_plateau_moves_nothing(device):
    frames = np.full((9, 1, 4), 20, np.uint8)
    frames[4:] = 150
    frames[4, 0, 1] = frames[5, 0, 2] = frames[6, 0, 3] = 255
    found = find_onset(frames, np.arange(9) * 0.1, dark=20, bright=220, noise=1.5, device=device)
    np.testing.assert_allclose(found.height, np.full((1, 4), -0.35), rtol=1e-6)


@pytest.mark.parametrize(("value", "status"), [(20, 2), (200, 3)])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_all_equal_frames(device, dtype, value, status):
    frames = np.full((6, 5, 7), value, dtype)
    found = find_onset(frames, np.arange(6.0), dark=20, bright=220, device=device)
    assert np.all(found.status == status)
    assert np.all(np.isnan(found.height))
    assert np.all(np.isnan(found.sigma))


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_sample_that_is_no_number_spoils_a_pixel_until_its_onset(device, broken):
    frames = np.full((9, 1, 5), 0.1, np.float32)
    frames[4:] = 0.9
    frames[0, 0, 0] = frames[3, 0, 1] = frames[4, 0, 2] = frames[7, 0, 3] = broken
    frames[5, 0, 4] = broken  # the second frame of the run: not decided yet
    found = find_onset(frames, np.arange(9) * 0.1, dark=0, bright=1, noise=0.01, device=device)
    np.testing.assert_array_equal(found.status, [[0, 0, 0, 1, 0]])
    assert found.height[0, 3] == pytest.approx(-0.35)
    assert np.isnan(found.height[0, [0, 1, 2, 4]]).all()


def test_a_saturated_sample_is_light(device):
    frames = np.full((5, 1, 2), 20, np.uint8)
    frames[2:, 0, 0], frames[2:, 0, 1] = 255, 254
    found = find_onset(frames, np.arange(5.0), dark=20, bright=400, threshold=0.9, device=device)
    np.testing.assert_array_equal(found.status, [[1, 2]])


def test_pixels_without_references_are_invalid(device):
    frames = np.full((5, 2, 4), 20, np.uint8)
    frames[3:] = 200
    dark, bright = np.full((2, 4), 20.0), np.full((2, 4), 220.0)
    bright[0, 0], dark[0, 1], bright[1, 2] = 20, np.nan, np.inf
    found = find_onset(frames, np.arange(5.0), dark=dark, bright=bright, device=device)
    np.testing.assert_array_equal(found.status, [[0, 0, 1, 1], [1, 1, 0, 1]])
    assert found.frame[0, 0] == -1


@pytest.mark.parametrize("threshold", [0.0, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_level_is_the_smallest_light_sample(device, dtype, threshold):
    dark, bright = (10, 21) if dtype != "float32" else map(float, np.float32([0.1, 0.7]))
    exact = dark + threshold * (bright - dark)
    least = np.ceil(exact) if dtype != "float32" else np.float32(exact)
    if float(least) < exact:
        least = np.nextafter(np.float32(least), np.float32(np.inf))
    below = least - 1 if dtype != "float32" else np.nextafter(least, np.float32(-np.inf))
    frames = np.zeros((4, 1, 2), dtype)
    frames[2:, 0, 0], frames[2:, 0, 1] = least, below
    found = find_onset(
        frames, np.arange(4.0), dark=dark, bright=bright, threshold=threshold, noise=0.1, device=device
    )
    np.testing.assert_array_equal(found.status, [[1, 2]])


def test_results_on_the_way_change_nothing(device):
    frames = random_press("uint8", 30, (9, 13), seed=7)
    travel = uneven_travel(30)
    whole = find_onset(frames, travel, dark=20, bright=220, noise=1.5, device=device)
    search = OnsetSearch((9, 13), frames.dtype, dark=20, bright=220, noise=1.5, device=device)
    for number in range(30):
        search.push(frames[number : number + 1], travel=travel[number : number + 1])
        part = search.result()
        so_far = (
            find_onset(
                frames[: number + 1], travel[: number + 1], dark=20, bright=220, noise=1.5, device=device
            )
            if number
            else None
        )
        if so_far is not None:
            assert_equal(part, so_far)
    assert_equal(search.result(), whole)


def test_a_search_can_be_used_again(device):
    first, second = (random_press("uint8", 20, (9, 13), seed=seed) for seed in (1, 2))
    travel = uneven_travel(20)
    search = OnsetSearch((9, 13), first.dtype, device=device)
    search.push(first, travel=travel)
    search.reset()
    search.push(second, travel=travel)
    assert_equal(search.result(), find_onset(second, travel, device=device))


def test_frames_read_into_the_room_are_not_copied(device):
    frames = random_press("uint8", 20, (9, 13))
    travel = uneven_travel(20)
    search = OnsetSearch((9, 13), frames.dtype, device=device, memory_limit=2 * 6 * 9 * 13)
    assert search.room.shape == (6, 9, 13)
    for start in range(0, 20, 6):
        count = min(6, 20 - start)
        search.room[:count] = frames[start : start + count]
        search.push(search.room[:count], travel=travel[start : start + count])
    assert_equal(search.result(), find_onset(frames, travel, device=device))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": np.zeros((1, 3, 3), np.uint8), "travel": [0.0]}, "at least 2 frames"),
        ({"frames": np.zeros((5, 0, 3), np.uint8)}, "at least 2 frames"),
        ({"frames": np.zeros((5, 3), np.uint8)}, "at least 2 frames"),
        ({"frames": np.zeros((5, 3, 3), np.int32)}, "uint8, uint16 or float32"),
        ({"frames": np.zeros((5, 3, 3), np.complex64)}, "uint8, uint16 or float32"),
        ({"frames": np.zeros((5, 3, 3), np.float32), "dark": None}, "dark and bright"),
        ({"travel": [0.0, 1.0]}, "5 frames"),
        ({"travel": [0.0, 1.0, np.nan, 2.0, 3.0]}, "nan at frame 2"),
        ({"travel": [0.0, 1.0, 0.5, 2.0, 3.0]}, "runs back at frame 2"),
        ({"dark": np.zeros((2, 3))}, "the frames are 3 x 3"),
        ({"dark": 220, "bright": 20}, "bright is not above dark"),
        ({"bright": 20}, "bright is not above dark"),
        ({"threshold": 1.5}, "threshold 1.5"),
        ({"threshold": -0.1}, "threshold -0.1"),
        ({"threshold": np.nan}, "threshold nan"),
        ({"hold": 0}, "hold 0"),
        ({"hold": 2**31}, "hold 2147483648"),
        ({"noise": -1.0}, "noise -1.0"),
        ({"noise": np.inf}, "noise inf"),
    ],
)
def test_bad_input_is_refused(change, words):
    call = {"frames": np.zeros((5, 3, 3), np.uint8), "travel": np.arange(5.0), "dark": 20, "bright": 220}
    with pytest.raises(InputError, match=words) as caught:
        find_onset(**(call | change))
    assert "\n" not in str(caught.value)


def test_travel_must_not_run_back_between_blocks():
    search = OnsetSearch((3, 3), np.dtype(np.uint8))
    frames = np.zeros((2, 3, 3), np.uint8)
    search.push(frames, travel=np.array([0.0, 1.0]))
    with pytest.raises(InputError, match="runs back at frame 0"):
        search.push(frames, travel=np.array([0.5, 2.0]))


def test_travel_may_pause(device):
    frames = np.full((5, 1, 1), 20, np.uint8)
    frames[3:] = 200
    found = find_onset(frames, [0.0, 0.1, 0.1, 0.1, 0.2], dark=20, bright=220, noise=1.0, device=device)
    assert found.height[0, 0] == np.float32(-0.1)
    assert found.sigma[0, 0] == 0


def test_one_frame_is_no_press():
    search = OnsetSearch((3, 3), np.dtype(np.uint8))
    search.push(np.zeros((1, 3, 3), np.uint8), travel=np.array([0.0]))
    with pytest.raises(InputError, match="1 frames has no onset"):
        search.result()


def test_a_few_pixels_alone_are_not_taken_for_done(device):
    """A tile of dark pixels only, in blocks, once was."""
    frames = np.full((12, 1, 3), 20, np.uint8)
    frames[9:] = 200
    found = search_in_blocks(frames, np.arange(12) * 0.1, [4, 8], device, dark=20, bright=220)
    assert np.all(found.frame == 9)


@pytest.mark.parametrize("hold", [2**31 - 1, 2**31 - 2])
def test_a_hold_longer_than_any_stack_waits_for_the_end(device, hold):
    frames = np.full((9, 1, 1), 20, np.float32)
    frames[2:5] = 200
    options = {"dark": 20, "bright": 220, "hold": hold, "device": device}
    assert (
        search_in_blocks(frames, np.arange(9.0), [4], device=device, dark=20, bright=220, hold=hold).frame
        == -1
    )
    assert find_onset(frames[:5], np.arange(5.0), **options).frame == 2


def test_a_pixel_that_hovers_about_its_level_does_not_claim_to_know_when(device):
    """Light since frame 3, but so faintly that noise decides when it passes for light."""
    generator = np.random.default_rng(3)
    counts = np.where(np.arange(40)[:, None, None] >= 3, 119.5, 20) + generator.normal(0, 1.5, (40, 50, 60))
    found = find_onset(
        np.rint(counts).astype(np.uint8), np.arange(40) * 0.1, dark=20, bright=220, noise=1.5, device=device
    )
    error = found.height + 0.25
    late = (found.status == 1) & (found.frame > 10)
    assert late.sum() > 100
    assert np.max(np.abs(error[late] / found.sigma[late])) < 4


@pytest.mark.parametrize(
    "frames",
    [
        np.zeros((2, 9, 5), np.uint8),
        np.zeros((2, 1, 1), np.uint8),
        np.zeros((2, 4, 5), np.uint16),
        np.zeros((0, 4, 5), np.uint8),
    ],
)
def test_a_block_of_other_frames_is_refused(frames):
    search = OnsetSearch((4, 5), np.dtype(np.uint8))
    with pytest.raises(InputError, match="expected uint8"):
        search.push(frames, travel=np.arange(len(frames)) * 0.1)


def test_thresholds_that_binary_cannot_hold_are_met():
    """0.55 of the way from 0 to 100 is 55 counts, though 0.55 * 100 is a little more."""
    for percent in range(1, 100):
        frames = np.zeros((4, 1, 2), np.uint8)
        frames[2:, 0] = percent, percent - 1
        found = find_onset(frames, np.arange(4.0), dark=0, bright=100, threshold=percent / 100, noise=0.5)
        np.testing.assert_array_equal(found.status, [[1, 2]], err_msg=str(percent))


def test_types_may_be_given_as_numpy_knows_them():
    search = OnsetSearch((4, 5), np.uint16)
    search.push(np.zeros((2, 4, 5), np.uint16), travel=np.arange(2.0))
    assert np.all(search.result().status == 2)


def test_a_saturated_sample_below_its_level_is_not_taken_for_dark(device):
    """Bright is beyond the range: 255 is light there, though it misses the level by far."""
    frames = np.full((6, 1, 2), 20, np.uint8)
    frames[2:, 0, 0], frames[4:, 0, 1] = 255, 255
    frames[2, 0, 1] = 255
    options = {"threshold": 1.0, "noise": 0.3}
    found = find_onset(frames, np.arange(6) * 0.1, dark=20, bright=300, device=device, **options)
    assert_within_an_ulp(found, numpy_onset(frames, np.arange(6) * 0.1, 20, 300, **options), np.arange(6))
    np.testing.assert_array_equal(found.frame, [[2, 4]])
    assert np.all(found.sigma > 0)


@pytest.mark.parametrize(("number", "hold"), list(enumerate([31, 32, 33, 64, 100])))
def test_long_runs_are_counted_over_spans_and_cuts(device, number, hold):
    """Runs of about `hold` light frames, broken now and then: where they begin and end is chance."""
    dtype = DTYPES[(number + (device.layout is CPU_LAYOUT)) % 3]  # not a kernel for each
    generator = np.random.default_rng([hold, DTYPES.index(dtype)])
    dark, bright = SPEC[dtype]
    share = 1 - 1 / generator.uniform(0.5 * hold, 3 * hold, (3, 64))
    light = generator.random((150, 3, 64)) < share
    light[:: hold - 1, :, ::8] = light[-1, :, ::4] = False  # or else there is a run in every pixel
    frames = np.where(light, bright, dark).astype(dtype)
    options = {"hold": hold, "noise": 0.01 * (bright - dark)}
    travel = uneven_travel(150)
    expected = numpy_onset(frames, travel, dark, bright, **options)
    assert {1, 2, 3} <= set(expected.status.flat)
    runs = np.array([first_run(series, hold) for series in light.reshape(150, -1).T]).reshape(3, 64)
    np.testing.assert_array_equal(expected.frame, runs)
    for cuts in ([], [1], [32, 64, 96, 128], *(np.unique(generator.integers(1, 150, n)) for n in (3, 9, 40))):
        found = search_in_blocks(
            frames, travel, list(cuts), device=device, dark=dark, bright=bright, **options
        )
        assert_within_an_ulp(found, expected, travel)


@pytest.mark.parametrize("dtype", DTYPES)
def test_pictures_of_any_width(device, dtype):
    """Frames that begin anywhere in a word, and words that only partly lie in the picture."""
    dark, bright = SPEC[dtype]
    travel = uneven_travel(40)
    for width in range(1, 131):
        noise = [1.5, None][width % 2]
        frames = random_press(dtype, 40, (1 + width % 3, width), seed=width)
        found = find_onset(frames, travel, dark=dark, bright=bright, noise=noise, device=device)
        expected = numpy_onset(frames, travel, dark, bright, noise=found.noise)
        assert noise in (None, found.noise)
        assert_within_an_ulp(found, expected, travel)


@pytest.mark.parametrize("hold", [1, 2])
@pytest.mark.parametrize("level", [1, 2, 128, 255, 256, 32768, 65535])
def test_the_whole_range_of_uint16(device, level, hold):
    edges = [0, 1, 2, 127, 128, 254, 255, 256, 257, 32767, 32768, 32769, 65279, 65280, 65534, 65535]
    frames = np.random.default_rng(level).choice(edges, (70, 7, 37)).astype(np.uint16)
    options = {"threshold": 1.0, "hold": hold, "noise": 0.5}
    travel = np.arange(70) / 64
    found = find_onset(frames, travel, dark=0, bright=level, device=device, **options)
    assert_within_an_ulp(found, numpy_onset(frames, travel, 0, level, **options), travel)


ODD_FLOATS = [0, -0.0, 1e-45, -1e-45, 1e-39, -1e-39, 1e-38, 0.5, 1, -1, 255, 65535, 3e38, -3e38]


@pytest.mark.parametrize("hold", [1, 2])
@pytest.mark.parametrize("level", [1e-39, 1e-38, 0.5, 65535.0, 1e30])
@pytest.mark.parametrize("broken", [False, True])
def test_the_whole_range_of_float32(device, level, hold, broken):
    """Which samples are light, at least: differences between the largest are beyond a float."""
    generator = np.random.default_rng(int(hold + broken))
    frames = generator.choice(np.float32(ODD_FLOATS), (70, 7, 37)).astype(np.float32)
    if broken:
        struck = generator.random(frames.shape) < 0.03
        frames[struck] = generator.choice(np.float32([np.nan, np.inf, -np.inf]), np.count_nonzero(struck))
    options = {"threshold": 1.0, "hold": hold, "noise": 0.0}
    travel = np.arange(70) / 64
    for subframe in (True, False):
        found = find_onset(frames, travel, dark=0, bright=level, device=device, subframe=subframe, **options)
        with np.errstate(all="ignore"):
            expected = numpy_onset(frames, travel, 0, level, subframe=subframe, **options)
        np.testing.assert_array_equal(found.status, expected.status)
        np.testing.assert_array_equal(found.frame, expected.frame)
    assert_within_an_ulp(found, expected, travel)


@pytest.mark.parametrize("level", [0.0, -0.0])
def test_a_negative_zero_is_a_zero(device, level):
    frames = np.full((4, 1, 2), -1, np.float32)
    frames[2:] = 0.0, -0.0
    found = find_onset(frames, np.arange(4.0), dark=-1, bright=level, threshold=1.0, noise=0.0, device=device)
    np.testing.assert_array_equal(found.frame, [[2, 2]])


# What kernels are built for: what other tests need as well, because building them takes the longest.
BUILDS = [
    ("uint8", 1, "onset"),
    ("uint8", 2, "release"),
    ("uint8", 33, "onset"),
    ("uint16", 2, "onset"),
    ("uint16", 5, "release"),
    ("float32", 2, "onset"),
    ("float32", 1, "release"),
]


@pytest.mark.parametrize(("dtype", "hold", "event"), BUILDS)
def test_tiny_stacks_of_all_kinds(device, dtype, hold, event):
    """Levels, references, noise, sizes, cuts and broken samples by chance, against the reference."""
    subframe = looks_between(device, dtype, hold)
    generator = np.random.default_rng([DTYPES.index(dtype), hold, subframe])
    for turn in range(24):
        count = int(generator.integers(2, 90))
        shape = tuple(generator.integers(1, [4, 40]))
        frames = random_press(dtype, count, shape, seed=turn, noise=generator.choice([0.0, 0.02, 0.3]))
        if dtype == "float32":
            frames[generator.random(frames.shape) < 0.002] = np.nan
        travel = np.sort(generator.choice(np.arange(99) / 32, count))
        if event == "release":
            frames, travel = frames[::-1].copy(), travel[::-1].copy()
        dark, bright = SPEC[dtype]
        if generator.random() < 0.5:
            dark, bright = (part * generator.uniform(0.7, 1.3, shape) for part in (dark, bright))
        if dtype != "float32":
            dark = None if generator.random() < 0.2 else dark
            bright = None if generator.random() < 0.2 else bright
        options = {
            "threshold": float(generator.choice([0, 0.2, 0.5, 0.9, 1])),
            "hold": hold,
            "subframe": subframe,
            "event": event,
            "noise": generator.choice([None, 0.0, 0.01, 1.5, 40.0]),
        }
        cuts = np.unique(generator.integers(1, count, generator.integers(0, 6)))
        found = search_in_blocks(
            frames, travel, list(cuts), device=device, dark=dark, bright=bright, **options
        )
        own = event == "release" or dark is None
        with np.errstate(invalid="ignore", divide="ignore"):
            expected = numpy_onset(
                frames, travel, dark, bright, **(options | {"noise": found.noise}), own_dark=own
            )
        assert_within_an_ulp(found, expected, travel)


def test_nothing_is_left_of_the_press_before(device):
    """A run that is open from the first frame on once took the last surely dark frame of another press."""
    before = np.full((40, 1, 1), 117, np.uint8)
    before[:30] = 20
    frames = np.full((12, 1, 1), 117, np.uint8)
    frames[[0, 1]], frames[6:] = 200, 124
    travel = np.arange(40) * 0.1
    search = OnsetSearch((1, 1), np.uint8, dark=20, bright=220, hold=5, noise=1.5, device=device)
    search.push(before, travel=travel)
    search.reset()
    for part in (slice(0, 2), slice(2, 12)):
        search.push(frames[part], travel=travel[part])
    expected = numpy_onset(frames, travel[:12], 20, 220, noise=1.5, hold=5)
    assert_within_an_ulp(search.result(), expected, travel[:12])


def test_a_hold_without_end_lets_no_broken_sample_pass(device):
    frames = np.full((9, 1, 1), 0.1, np.float32)
    frames[2:], frames[4] = 0.9, np.inf
    found = find_onset(frames, np.arange(9.0), dark=0, bright=1, noise=0.01, hold=2**31 - 1, device=device)
    assert found.status[0, 0] == 0
