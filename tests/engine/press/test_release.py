"""The release: the kernels against their references, both against the onset, and what is refused."""

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

DTYPES = sorted(SPEC)
ODD, EVEN = (33, 61), (32, 64)  # pixels: a frame of the latter is whole words
BY_HOLD = pytest.mark.parametrize(("hold", "size"), [(1, EVEN), (2, ODD), (5, ODD), (40, EVEN)])
RELEASE = {"event": "release"}


def random_release(dtype, frames, shape, **options):
    """A press played backwards: some pixels never turn dark."""
    return random_press(dtype, frames, shape, **options)[::-1].copy()


def numpy_release(*press, **options):
    """Run the references; the light plateau is each pixel's own, whatever its bright reference."""
    return numpy_onset(*press, **(options | {"own_dark": True, "event": "release"}))


def uneven_rise(count, start=3.0):
    return start - np.cumsum(np.random.default_rng(5).uniform(0.001, 0.2, count))


def search_in_blocks(frames, travel, cuts, device, **options):
    search = OnsetSearch(frames.shape[1:], frames.dtype, event="release", device=device, **options)
    for part in np.split(np.arange(len(frames)), cuts):
        if len(part):
            search.push(frames[part], travel=travel[part])
    return search.result()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("hold", [1, 2, 7, 300])
def test_the_reference_finds_the_first_dark_run_that_holds(dtype, hold):
    dark, bright = SPEC[dtype]
    frames = random_release(dtype, 25, (9, 11), seed=hold, noise=0.2)
    found = numpy_release(frames, 3 - np.arange(25.0), dark, bright, noise=1.0, hold=hold)
    is_dark = frames.astype(float) < (dark + bright) / 2
    expected = np.array([first_run(series, hold) for series in is_dark.reshape(25, -1).T]).reshape(9, 11)
    np.testing.assert_array_equal(found.frame, expected)
    np.testing.assert_array_equal(found.status, np.select([expected == -1, expected == 0], [3, 2], 1))


@BY_HOLD
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_device_agrees_with_the_reference(device, dtype, hold, size):
    frames = random_release(dtype, 60, size, seed=3)
    dark, bright = SPEC[dtype]
    noise = 0.008 * (bright - dark)
    travel = uneven_rise(60)
    subframe = looks_between(device, dtype, hold)
    options = {"threshold": 0.4, "hold": hold, "subframe": subframe, "noise": noise, **RELEASE}
    found = find_onset(frames, travel, dark=dark, bright=bright, device=device, **options)
    assert {1, 2, 3} <= set(found.status.flat)
    assert_within_an_ulp(found, numpy_release(frames, travel, dark, bright, **options), travel)


@pytest.mark.parametrize("dark", [None, 20])
def test_the_light_plateau_may_be_each_pixels_own(device, dark):
    frames = random_release("uint8", 40, (33, 61), seed=8)
    travel = uneven_rise(40)
    found = find_onset(frames, travel, dark=dark, noise=1.5, device=device, **RELEASE)
    expected = numpy_release(frames, travel, dark, None, noise=1.5)
    assert_within_an_ulp(found, expected, travel)


@pytest.mark.parametrize("dtype", DTYPES)
def test_references_of_each_pixel_are_obeyed(device, dtype):
    frames = random_release(dtype, 30, (17, 23), seed=4)
    generator = np.random.default_rng(6)
    dark, bright = (level * generator.uniform(0.8, 1.2, (17, 23)) for level in SPEC[dtype])
    travel = uneven_rise(30)
    found = find_onset(frames, travel, dark=dark, bright=bright, noise=0.01, device=device, **RELEASE)
    expected = numpy_release(frames, travel, dark, bright, noise=0.01)
    assert_within_an_ulp(found, expected, travel)


@pytest.mark.parametrize("cuts", [range(1, 40), range(7, 40, 7), [1, 2, 39], [20]])
@pytest.mark.parametrize("dtype", DTYPES)
@BY_HOLD
def test_blocks_make_no_difference(device, dtype, cuts, hold, size):
    frames = random_release(dtype, 40, size, seed=1, noise=0.15)
    travel = uneven_rise(40)
    dark, bright = SPEC[dtype]
    subframe = looks_between(device, dtype, hold)
    options = {"dark": dark, "bright": bright, "hold": hold, "subframe": subframe, "device": device}
    whole = search_in_blocks(frames, travel, [], **options)
    assert_equal(search_in_blocks(frames, travel, list(cuts), **options), whole)


def test_blocks_make_no_difference_to_a_plateau_of_its_own(device):
    frames = random_release("uint8", 40, (19, 29), seed=2)
    travel = uneven_rise(40)
    whole = search_in_blocks(frames, travel, [], device)
    assert_equal(search_in_blocks(frames, travel, list(range(1, 40)), device), whole)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (37, 53), (3, 1024), (5, 411)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_odd_sizes(device, dtype, shape):
    frames = random_release(dtype, 12, shape, seed=9)
    travel = 1.2 - np.arange(12) * 0.1
    dark, bright = SPEC[dtype]
    options = {"noise": 0.008 * (bright - dark), **RELEASE}
    found = find_onset(frames, travel, dark=dark, bright=bright, device=device, **options)
    assert_within_an_ulp(found, numpy_release(frames, travel, dark, bright, **options), travel)


def test_less_room_gives_the_same_answer(small_device):
    frames, travel = random_release("uint8", 30, (23, 31), seed=5), uneven_rise(30)
    whole = find_onset(frames, travel, device=small_device, **RELEASE)
    small_device.max_allocation = 4096
    search = OnsetSearch((23, 31), frames.dtype, device=small_device, **RELEASE)
    assert len(search._bands) > 1
    for start in range(0, 30, 4):
        part = slice(start, start + 4)
        search.push(frames[part], travel=travel[part])
    assert_equal(search.result(), whole)


def test_a_sudden_step_lies_in_the_middle_of_its_interval(device):
    frames = np.full((4, 1, 1), 180, np.uint8)
    frames[2:] = 20
    found = find_onset(frames, [0.5, 0.4, 0.1, 0.0], dark=20, bright=220, noise=1.0, device=device, **RELEASE)
    assert found.frame[0, 0] == 2
    assert found.height[0, 0] == np.float32(-0.25)
    assert found.sigma[0, 0] == pytest.approx(0.15 / np.sqrt(3))


def test_a_ramp_is_interpolated_exactly(device):
    """A ramp of -16 counts a frame crosses 120 at 3/4 after the fifth frame, whatever the references."""
    frames = (212 - np.arange(12) * 16).astype(np.uint8)[:, None, None]
    found = find_onset(
        frames, 1.2 - np.arange(12) * 0.1, dark=20, bright=220, noise=1.0, device=device, **RELEASE
    )
    assert found.height[0, 0] == pytest.approx(-0.625, abs=1e-7)
    assert found.sigma[0, 0] == pytest.approx(0.1 / 16 * np.hypot(0.75, 0.25), rel=1e-5)


def test_without_subframe_the_height_is_that_of_the_first_dark_frame(device):
    frames = random_release("uint8", 30, (9, 9), seed=2)
    travel = 3 - np.arange(30) * 0.1
    found = find_onset(frames, travel, **LEVELS["uint8"], subframe=False, device=device, **RELEASE)
    answered = found.status == 1
    assert answered.any()
    np.testing.assert_array_equal(found.height[answered], -travel[found.frame[answered]].astype(np.float32))
    np.testing.assert_allclose(found.sigma[answered], 0.1 / np.sqrt(3), rtol=1e-5)


def test_sigma_is_honest_on_steps(device):
    generator = np.random.default_rng(0)
    crossing = generator.uniform(1, 28, (200, 250))
    counts = np.where(np.arange(30)[:, None, None] >= crossing, 20, 200)
    frames = np.rint(counts + generator.normal(0, 1.5, counts.shape)).astype(np.uint8)
    found = find_onset(frames, 3 - np.arange(30) * 0.1, dark=20, bright=220, device=device, **RELEASE)
    error = found.height - (0.1 * crossing - 3)
    assert np.mean((error / found.sigma) ** 2) == pytest.approx(1, abs=0.05)
    assert abs(np.mean(error)) < 0.001


def test_a_dark_spike_is_no_release_unless_the_stack_ends_on_it(device):
    frames = np.full((9, 1, 4), 200, np.uint8)
    frames[3, 0, 0] = frames[8, 0, 1] = 0
    frames[[3, 4], 0, 2] = 0
    found = find_onset(frames, 9 - np.arange(9.0), dark=20, bright=220, device=device, **RELEASE)
    np.testing.assert_array_equal(found.frame, [[-1, 8, 3, -1]])


@pytest.mark.parametrize(("value", "status"), [(20, 2), (200, 3)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_what_never_changes_is_dark_at_start_or_light_to_the_end(device, dtype, value, status):
    frames = np.full((6, 5, 7), value, dtype)
    found = find_onset(frames, 6 - np.arange(6.0), dark=20, bright=220, device=device, **RELEASE)
    assert np.all(found.status == status)
    assert np.all(found.frame == (0 if status == 2 else -1))
    assert np.all(np.isnan(found.height))
    assert np.all(np.isnan(found.sigma))


def test_a_pixel_that_is_dark_at_start_stays_so_though_it_turns_light(device):
    frames = np.full((9, 1, 2), 20, np.uint8)
    frames[3:6] = 200
    frames[1, 0, 1] = 200  # its dark first frame was a spike
    found = find_onset(frames, 9 - np.arange(9.0), dark=20, bright=220, device=device, **RELEASE)
    np.testing.assert_array_equal(found.status, [[2, 1]])
    np.testing.assert_array_equal(found.frame, [[0, 6]])


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_sample_that_is_no_number_spoils_a_pixel_until_its_release(device, broken):
    frames = np.full((9, 1, 5), 0.9, np.float32)
    frames[4:] = 0.1
    frames[0, 0, 0] = frames[3, 0, 1] = frames[4, 0, 2] = frames[7, 0, 3] = broken
    frames[5, 0, 4] = broken  # the second frame of the run: not decided yet
    found = find_onset(
        frames, 0.8 - np.arange(9) * 0.1, dark=0, bright=1, noise=0.01, device=device, **RELEASE
    )
    np.testing.assert_array_equal(found.status, [[0, 0, 0, 1, 0]])
    assert found.height[0, 3] == pytest.approx(-0.45)
    assert np.isnan(found.height[0, [0, 1, 2, 4]]).all()


def test_pixels_without_references_are_invalid(device):
    frames = np.full((5, 2, 4), 200, np.uint8)
    frames[3:] = 20
    dark, bright = np.full((2, 4), 20.0), np.full((2, 4), 220.0)
    bright[0, 0], dark[0, 1], bright[1, 2] = 20, np.nan, np.inf
    found = find_onset(frames, 5 - np.arange(5.0), dark=dark, bright=bright, device=device, **RELEASE)
    np.testing.assert_array_equal(found.status, [[0, 0, 1, 1], [1, 1, 0, 1]])
    np.testing.assert_array_equal(found.frame, [[-1, -1, 3, 3], [3, 3, -1, 3]])


@pytest.mark.parametrize("threshold", [0.0, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_level_itself_is_light_and_what_is_next_below_it_dark(device, dtype, threshold):
    dark, bright = (10, 21) if dtype != "float32" else map(float, np.float32([0.1, 0.7]))
    exact = dark + threshold * (bright - dark)
    least = np.ceil(exact) if dtype != "float32" else np.float32(exact)
    if float(least) < exact:
        least = np.nextafter(np.float32(least), np.float32(np.inf))
    below = least - 1 if dtype != "float32" else np.nextafter(least, np.float32(-np.inf))
    frames = np.full((4, 1, 2), 2 * bright, dtype)
    frames[2:, 0, 0], frames[2:, 0, 1] = least, below
    travel = 4 - np.arange(4.0)
    options = {"threshold": threshold, "noise": 0.1, **RELEASE}
    found = find_onset(frames, travel, dark=dark, bright=bright, device=device, **options)
    np.testing.assert_array_equal(found.status, [[3, 1]])
    assert_within_an_ulp(found, numpy_release(frames, travel, dark, bright, **options), travel)


def test_a_saturated_sample_is_light(device):
    """Bright is beyond the range: 255 is light there though it misses the level; 254 is not."""
    frames = np.full((30, 1, 3), 255, np.uint8)
    frames[20:, 0, 0], frames[20:, 0, 1] = 20, 254
    travel = 3 - np.arange(30) * 0.1
    options = {"threshold": 0.9, "noise": 1.0, **RELEASE}
    found = find_onset(frames, travel, dark=20, bright=400, device=device, **options)
    np.testing.assert_array_equal(found.status, [[1, 1, 3]])
    np.testing.assert_array_equal(found.frame, [[20, 20, -1]])
    assert_within_an_ulp(found, numpy_release(frames, travel, 20, 400, **options), travel)
    assert np.all((-found.height[0, :2] >= 1.0) & (-found.height[0, :2] <= 1.1))
    assert found.sigma[0, 0] < 0.1


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_at_the_ends_of_the_threshold_the_same_samples_are_light(device, dtype, threshold):
    frames = random_release(dtype, 20, (9, 31), seed=4, noise=0.1)
    travel = uneven_rise(20)
    dark, bright = SPEC[dtype]
    options = {"threshold": threshold, "noise": 0.1 * (bright - dark), **RELEASE}
    found = find_onset(frames, travel, dark=dark, bright=bright, device=device, **options)
    assert_within_an_ulp(found, numpy_release(frames, travel, dark, bright, **options), travel)


def test_results_on_the_way_change_nothing(device):
    frames = random_release("uint8", 30, (9, 13), seed=7)
    travel = uneven_rise(30)
    known = {"dark": 20, "bright": 220, "noise": 1.5, "device": device, **RELEASE}
    search = OnsetSearch((9, 13), frames.dtype, **known)
    for number in range(30):
        search.push(frames[number : number + 1], travel=travel[number : number + 1])
        part = search.result()
        if number:
            assert_equal(part, find_onset(frames[: number + 1], travel[: number + 1], **known))


def test_a_search_can_be_used_again(device):
    first, second = (random_release("uint8", 20, (9, 13), seed=seed) for seed in (1, 2))
    travel = uneven_rise(20)
    search = OnsetSearch((9, 13), first.dtype, device=device, **RELEASE)
    search.push(first, travel=travel)
    search.reset()
    search.push(second, travel=travel)
    assert_equal(search.result(), find_onset(second, travel, device=device, **RELEASE))


def test_a_press_played_backwards_has_its_release_where_its_onset_was(device):
    """Steps, and ramps that are under way in both samples: the same interval, so the same answer."""
    generator = np.random.default_rng(2)
    shape, count = (20, 30), 40
    middle, lasts = generator.uniform(8, 32, shape), generator.choice([1e-6, 6], shape)
    share = np.clip((np.arange(count)[:, None, None] - middle) / lasts + 0.5, 0, 1)
    frames = np.rint(20 + 201 * share).astype(np.uint8)  # no sample is at the level, 120.5
    travel = np.arange(count) / 8  # whose sums are exact
    known = {"dark": 20, "bright": 221, "hold": 1, "noise": 1.0, "device": device}
    onset = find_onset(frames, travel, **known)
    release = find_onset(frames[::-1].copy(), travel[::-1].copy(), **known, **RELEASE)
    assert np.all(onset.status == 1)
    np.testing.assert_array_equal(release.status, 1)
    np.testing.assert_array_equal(release.frame, count - onset.frame)
    steps = lasts < 1
    np.testing.assert_array_equal(release.height[steps], onset.height[steps])
    np.testing.assert_array_equal(release.sigma[steps], onset.sigma[steps])
    np.testing.assert_allclose(release.height[~steps], onset.height[~steps], atol=1e-6)
    np.testing.assert_allclose(release.sigma[~steps], onset.sigma[~steps], rtol=1e-5)


@pytest.mark.parametrize("hold", [1, 2, 5])
def test_a_release_of_the_complement_is_an_onset(device, hold):
    """All is the same to the last bit where no sample equals the level, which is light in both."""
    frames = random_press("uint8", 40, (33, 61), seed=11, noise=0.1)
    travel = uneven_rise(40)
    known = {"hold": hold, "noise": 2.0, "device": device}
    onset = find_onset(frames, -travel, dark=None, bright=221, **known)  # the level is 110.5
    release = find_onset(~frames, travel, dark=255 - 221, bright=None, **known, **RELEASE)
    assert {1, 2, 3} <= set(onset.status.flat)
    np.testing.assert_array_equal(release.frame, onset.frame)
    np.testing.assert_array_equal(release.status, np.array([0, 1, 3, 2])[onset.status])
    np.testing.assert_array_equal(release.height, -onset.height)
    np.testing.assert_array_equal(release.sigma, onset.sigma)

    tied = np.full((4, 1, 1), 20, np.uint8)
    tied[2:] = 120
    known = {"noise": 1.0, "device": device}
    assert find_onset(tied, np.arange(4.0), dark=20, bright=220, **known).status == 1
    assert find_onset(~tied, -np.arange(4.0), dark=35, bright=235, **known, **RELEASE).status == 3


def test_the_bright_reference_is_not_taken_for_a_pixels_light_plateau(device):
    """It tells the level; how bright a pixel gets is its own affair, in a release as in a press."""
    frames = random_release("uint8", 40, (33, 61), seed=8)
    travel = uneven_rise(40)
    given = find_onset(frames, travel, dark=20, bright=255, noise=1.5, device=device, **RELEASE)
    assert_equal(given, find_onset(frames, travel, dark=20, bright=None, noise=1.5, device=device, **RELEASE))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"travel": np.arange(5.0)}, "runs back at frame 1: a release only goes up"),
        ({"travel": [3.0, 2.0, 2.5, 1.0, 0.0]}, "runs back at frame 2: a release only goes up"),
        ({"travel": [3.0, np.nan, 2.0, 1.0, 0.0]}, "nan at frame 1"),
        ({"event": "onset"}, "runs back at frame 1: a press only goes down"),
        ({"dark": 220, "bright": 20}, "bright is not above dark"),
        ({"frames": np.zeros((5, 3, 3), np.float32), "bright": None}, "dark and bright"),
        ({"threshold": 1.5}, "threshold 1.5"),
        ({"hold": 0}, "hold 0"),
    ],
)
def test_bad_input_is_refused(change, words):
    call = {"frames": np.zeros((5, 3, 3), np.uint8), "travel": -np.arange(5.0), "dark": 20, "bright": 220}
    with pytest.raises(InputError, match=words) as caught:
        find_onset(**(call | RELEASE | change))
    assert "\n" not in str(caught.value)


def test_an_unknown_event_is_refused():
    with pytest.raises(InputError, match="unknown event 'slip'; known are onset, release"):
        OnsetSearch((3, 3), np.uint8, event="slip")


def test_travel_must_not_run_back_between_blocks():
    search = OnsetSearch((3, 3), np.dtype(np.uint8), event="release")
    frames = np.zeros((2, 3, 3), np.uint8)
    search.push(frames, travel=np.array([1.0, 0.0]))
    with pytest.raises(InputError, match="runs back at frame 0: a release only goes up"):
        search.push(frames, travel=np.array([0.5, 0.2]))
