"""Onset and release: kernels equal their NumPy references, and these a loop over pixels."""

import math
import re

import numpy as np
import pytest
from bare import bare, bare_run, find_onset
from presses import LEVELS, SPEC, assert_equal, assert_within_an_ulp, first_run, numpy_onset, random_press

from mirrorskin import engine, io
from mirrorskin.engine import Onset, Run
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.sources import ArraySource
from mirrorskin.io import InputError
from mirrorskin.kernels.press import onset as reference

DTYPES = sorted(SPEC)
EVENTS = ["onset", "release"]
RELEASE = {"event": "release"}
ODD, EVEN = (33, 61), (32, 64)  # pixels: a frame of the latter is whole words
# Three frames from an onset on are looked at in any case, and 64 at once.
BY_KIND = pytest.mark.parametrize(
    ("dtype", "hold", "subframe", "event"),
    [
        ("uint8", 2, True, "onset"),
        ("uint16", 2, True, "onset"),
        ("float32", 2, True, "onset"),
        ("uint8", 2, True, "release"),
        ("float32", 2, True, "release"),
        ("uint8", 1, False, "onset"),
        ("uint16", 5, False, "release"),
        ("uint16", 65, True, "onset"),
        ("uint8", 3, True, "onset"),
        ("uint8", 300, True, "release"),
        ("uint16", 1, True, "release"),
        ("uint16", 7, False, "onset"),
        ("float32", 1, True, "onset"),
        ("float32", 5, True, "release"),
        ("float32", 64, False, "onset"),
    ],
)


def stroke(dtype, count, shape, event="onset", **options):
    """Frames and uneven travel of a press, or of one that is played backwards."""
    frames = random_press(dtype, count, shape, **options)
    travel = np.cumsum(np.random.default_rng(5).uniform(0.001, 0.2, count)) - 1.7
    return (frames, travel) if event == "onset" else (frames[::-1].copy(), travel[::-1].copy())


def search_in_blocks(frames, travel, cuts, **options):
    return bare(Onset(**options), frames, cuts, travel=travel)


def by_reference(frames, travel, dark, bright, **options):
    """Run the references; the plateau that a release begins on is always the pixel's own."""
    estimated = options.get("event") == "release" or dark is None
    with np.errstate(all="ignore"):
        return numpy_onset(frames, travel, dark, bright, own_dark=estimated, **options)


@pytest.mark.parametrize(("dtype", "hold"), [("uint8", 1), ("uint16", 2), ("float32", 7), ("uint8", 300)])
@pytest.mark.parametrize("event", EVENTS)
def test_the_reference_finds_the_first_run_that_holds(dtype, hold, event):
    dark, bright = SPEC[dtype]
    frames, travel = stroke(dtype, 25, (9, 11), event, seed=hold, noise=0.2)
    onset = by_reference(frames, travel, dark, bright, noise=1.0, hold=hold, event=event)
    light = frames.astype(float) >= (dark + bright) / 2
    runs = light if event == "onset" else ~light
    expected = np.array([first_run(series, hold) for series in runs.reshape(25, -1).T]).reshape(9, 11)
    np.testing.assert_array_equal(onset.frame, expected)
    never, start = (2, 3) if event == "onset" else (3, 2)
    np.testing.assert_array_equal(onset.status, np.select([expected == -1, expected == 0], [never, start], 1))


@BY_KIND
def test_a_device_agrees_with_the_reference_however_the_stack_is_cut(device, dtype, hold, subframe, event):
    levels, generator = SPEC[dtype], np.random.default_rng(6)
    options = {"threshold": 0.4, "hold": hold, "subframe": subframe, "event": event}
    for size, per_pixel in ((ODD, False), (EVEN, False), ((17, 23), True)):
        dark, bright = (part * generator.uniform(0.8, 1.2, size) for part in levels) if per_pixel else levels
        frames, travel = stroke(dtype, 60, size, event, seed=3, noise=0.008 if per_pixel else 0.1)
        options["noise"] = 0.008 * (levels[1] - levels[0])
        onset = find_onset(frames, travel, dark=dark, bright=bright, device=device, **options)
        assert {1, 2, 3} <= set(onset.status.flat)
        assert_within_an_ulp(onset, by_reference(frames, travel, dark, bright, **options), travel)
        arguments = {"dark": dark, "bright": bright, "device": device, **options}
        for cuts in (range(1, 60), range(7, 60, 7), [1, 2, 59]):
            assert_equal(search_in_blocks(frames, travel, list(cuts), **arguments), onset)


@BY_KIND
def test_tiny_stacks_of_all_kinds(device, dtype, hold, subframe, event):
    """Levels, references, noise, sizes, cuts and broken samples by chance, against the reference."""
    generator = np.random.default_rng([DTYPES.index(dtype), hold, subframe])
    for turn in range(16):
        count, shape = int(generator.integers(2, 90)), tuple(generator.integers(1, [4, 131]))
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
        arguments = {"dark": dark, "bright": bright, "device": device, **options}
        result = search_in_blocks(frames, travel, list(cuts), **arguments)
        options["noise"] = result.process["noise"]
        assert_within_an_ulp(result, by_reference(frames, travel, dark, bright, **options), travel)


@pytest.mark.parametrize(
    ("dtype", "hold", "count"),
    [("uint16", 33, 150), ("float32", 100, 400), ("uint8", 129, 500), ("uint8", 300, 900)],
)
def test_long_runs_are_counted_over_spans_and_cuts(device, dtype, hold, count):
    """Runs of about as many light frames as it takes, broken now and then by chance."""
    generator, (dark, bright) = np.random.default_rng(33), SPEC[dtype]
    fraction = 1 - 1 / generator.uniform(0.5 * hold, 3 * hold, (3, 64))
    light = generator.random((count, 3, 64)) < fraction
    light[:: hold - 1, :, ::8] = light[-1, :, ::4] = False  # or else there is a run in every pixel
    frames, travel = np.where(light, bright, dark).astype(dtype), np.arange(count) / 64
    options = {"hold": hold, "noise": 0.01 * (bright - dark)}
    expected = by_reference(frames, travel, dark, bright, **options)
    runs = np.array([first_run(series, hold) for series in light.reshape(count, -1).T]).reshape(3, 64)
    np.testing.assert_array_equal(expected.frame, runs)
    assert {1, 2} <= set(expected.status.flat)
    for cuts in (
        [],
        [1],
        [32, 64, 96, 128],
        *(np.unique(generator.integers(1, count, n)) for n in (3, 9, 40)),
    ):
        arguments = {"dark": dark, "bright": bright, "device": device, **options}
        assert_within_an_ulp(search_in_blocks(frames, travel, list(cuts), **arguments), expected, travel)


@pytest.mark.parametrize("count", [300, pytest.param(70_000, marks=pytest.mark.slow)])
def test_long_stacks(device, count):
    onset = np.array([[1, 254, 255, 256], [count - 300, count - 2, count - 1, count + 1]])
    frames = np.where(np.arange(count)[:, None, None] >= onset, 220, 20).astype(np.uint8)
    result = find_onset(frames, np.arange(count) * 1e-3, **LEVELS["uint8"], device=device)
    np.testing.assert_array_equal(result.frame, np.where(onset < count, np.maximum(onset, 0), -1))


@pytest.mark.parametrize("event", EVENTS)
def test_a_sudden_step_is_in_the_middle_of_its_interval(device, event):
    frames = np.full((4, 1, 1), 20, np.uint8)
    frames[2:] = 180
    travel = np.array([0.0, 0.1, 0.4, 0.5])
    if event == "release":
        frames, travel = frames[::-1].copy(), travel[::-1]
    onset = find_onset(frames, travel, **LEVELS["uint8"], noise=1.0, event=event, device=device)
    assert onset.height[0, 0] == np.float32(-0.25)
    assert onset.height_sigma[0, 0] == pytest.approx(0.15 / np.sqrt(3))


@pytest.mark.parametrize("event", EVENTS)
def test_a_ramp_is_interpolated_exactly(device, event):
    """A ramp of 16 counts a frame crosses 120 at a quarter of its step, whatever the references."""
    frames, travel = (np.arange(12) * 16 + 20).astype(np.uint8)[:, None, None], np.arange(12) * 0.1
    if event == "release":
        frames, travel = frames[::-1].copy(), travel[::-1]
    onset = find_onset(frames, travel, **LEVELS["uint8"], noise=1.0, event=event, device=device)
    assert onset.height[0, 0] == pytest.approx(-0.625, abs=1e-7)
    assert onset.height_sigma[0, 0] == pytest.approx(0.1 / 16 * np.hypot(0.25, 0.75), rel=1e-3)


def test_sigma_is_true_on_ramps(device):
    """On a ramp whose steps stand well above the noise, the mean square of error over sigma is 1."""
    generator = np.random.default_rng(0)
    crossing = generator.uniform(10, 14, (200, 250))
    counts = 120 + 24 * (np.arange(24)[:, None, None] - crossing)
    frames = (counts + generator.normal(0, 1.5, counts.shape)).astype(np.float32)
    onset = find_onset(frames, np.arange(24) * 0.1, dark=20, bright=220, noise=1.5, device=device)
    assert np.all(onset.status == 1)
    error = onset.height + 0.1 * crossing
    assert np.mean((error / onset.height_sigma) ** 2) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("event", EVENTS)
def test_sigma_is_true_on_steps(device, event):
    generator = np.random.default_rng(0)
    crossing = generator.uniform(1, 28, (200, 250))
    counts = np.where(np.arange(30)[:, None, None] >= crossing, 200, 20) + generator.normal(
        0, 1.5, (30, 200, 250)
    )
    frames, travel = np.rint(counts).astype(np.uint8), np.arange(30) * 0.1
    if event == "release":
        frames, travel = frames[::-1].copy(), travel[::-1]
    onset = find_onset(frames, travel, **LEVELS["uint8"], event=event, device=device)
    error = onset.height + 0.1 * crossing
    assert np.mean((error / onset.height_sigma) ** 2) == pytest.approx(1, abs=0.05)
    assert abs(np.mean(error)) < 0.001


def test_a_pixel_that_hovers_about_its_level_does_not_claim_to_know_when(device):
    """Light since frame 3, but so faintly that noise decides when it passes for light."""
    generator = np.random.default_rng(3)
    counts = np.where(np.arange(40)[:, None, None] >= 3, 119.5, 20) + generator.normal(0, 1.5, (40, 50, 60))
    frames = np.rint(counts).astype(np.uint8)
    onset = find_onset(frames, np.arange(40) * 0.1, **LEVELS["uint8"], noise=1.5, device=device)
    late = (onset.status == 1) & (onset.frame > 10)
    assert late.sum() > 100
    assert np.max(np.abs(((onset.height + 0.25) / onset.height_sigma)[late])) < 4


def test_a_plateau_that_noise_takes_below_its_level_began_in_the_step_that_led_to_it(device):
    """Plateaus at 101 to 104 % of the threshold, with a noise of 2 %: many cross it frames after the step."""
    generator = np.random.default_rng(3)
    depth, plateau = generator.uniform(0.2, 1.0, (2, 40, 50))
    fraction, travel = 0.5 * (1.01 + 0.03 * plateau), 0.1 * np.arange(14)
    light = fraction * (travel[:, np.newaxis, np.newaxis] > depth)
    frames = (20 + 200 * light + generator.normal(0, 2, light.shape)).astype(np.float32)
    onset = find_onset(frames, travel, dark=20.0, bright=220.0, noise=2.0, device=device)
    valid = onset.status == 1
    error = (onset.height + depth)[valid]
    assert valid.mean() > 0.9
    assert np.mean(np.abs(error) > 0.15) < 1e-3  # a step is 0.1 mm
    assert np.mean((error / onset.height_sigma[valid]) ** 2) == pytest.approx(1.0, abs=0.1)


def test_a_sample_that_is_lit_by_its_neighbours_does_not_show_when_the_change_began(device):
    frames = np.array([20.0, 20, 38, 190, 200, 200], np.float32).reshape(-1, 1, 1)
    onset = find_onset(frames, 0.1 * np.arange(6), dark=20.0, bright=220.0, noise=1.0, device=device)
    assert 0.02 < onset.height_sigma.item() < 0.1 / math.sqrt(12)  # by interpolation, 0.0005


@pytest.mark.filterwarnings("ignore:find_onset. no height")
def test_noise_is_estimated_from_the_first_two_frames():
    generator = np.random.default_rng(1)
    for noise in (0.6, 1.5, 6.0):
        frames = np.rint(30 + generator.normal(0, noise, (5, 200, 200))).astype(np.uint8)
        frames[1, :, :40] = 200  # what changes in between is left out
        onset = find_onset(frames, np.arange(5.0), **LEVELS["uint8"])
        assert onset.process["noise"] == pytest.approx(np.hypot(noise, 1 / np.sqrt(12)), rel=0.03)


def test_a_spike_is_not_an_onset_unless_the_stack_ends_on_it_and_moves_no_plateau(device):
    frames = np.full((9, 1, 4), 20, np.uint8)
    frames[3, 0, 0] = frames[8, 0, 1] = 255
    frames[[3, 4], 0, 2] = 255
    onset = find_onset(frames, np.arange(9.0), **LEVELS["uint8"], device=device)
    np.testing.assert_array_equal(onset.frame, [[-1, 8, 3, -1]])
    released = find_onset(255 - frames, -np.arange(9.0), **LEVELS["uint8"], device=device, **RELEASE)
    np.testing.assert_array_equal(released.frame, [[-1, 8, 3, -1]])
    frames = np.full((9, 1, 4), 20, np.uint8)
    frames[4:] = 150
    frames[4, 0, 1] = frames[5, 0, 2] = frames[6, 0, 3] = 255
    onset = find_onset(frames, np.arange(9) * 0.1, **LEVELS["uint8"], noise=1.5, device=device)
    np.testing.assert_allclose(onset.height, np.full((1, 4), -0.35), rtol=1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
def test_what_never_changes_has_no_height(device, dtype):
    for value, status in ((20, 2), (200, 3)):
        frames = np.full((6, 5, 7), value, dtype)
        with pytest.warns(io.MirrorskinWarning, match="find_onset: no height at any pixel"):
            onset = engine.find_onset(frames, np.arange(6.0), dark=20, bright=220, device=device)
        assert np.all(onset.status == status)
        assert np.all(onset.frame == (0 if status == 3 else -1))
        assert np.isnan(onset.height).all()
        assert np.isnan(onset.height_sigma).all()


def test_a_pixel_that_is_dark_at_start_stays_so_though_it_turns_light(device):
    frames = np.full((9, 1, 3), 20, np.uint8)
    frames[3:6] = 200
    frames[1, 0, 1] = 200  # its dark first frame was a spike
    frames[:, 0, 2] = 200
    onset = find_onset(frames, 9 - np.arange(9.0), **LEVELS["uint8"], device=device, **RELEASE)
    np.testing.assert_array_equal(onset.status, [[2, 1, 3]])
    np.testing.assert_array_equal(onset.frame, [[0, 6, -1]])


@pytest.mark.parametrize("event", EVENTS)
def test_a_sample_that_is_not_a_number_spoils_a_pixel_until_its_onset(device, event):
    for broken in (np.nan, np.inf, -np.inf):
        low, high = (0.1, 0.9) if event == "onset" else (0.9, 0.1)
        frames = np.full((9, 1, 5), low, np.float32)
        frames[4:] = high
        frames[0, 0, 0] = frames[3, 0, 1] = frames[4, 0, 2] = frames[7, 0, 3] = broken
        frames[5, 0, 4] = broken  # the second frame of the run: not decided yet
        travel = np.arange(9) * 0.1 if event == "onset" else 0.8 - np.arange(9) * 0.1
        onset = find_onset(frames, travel, dark=0, bright=1, noise=0.01, event=event, device=device)
        np.testing.assert_array_equal(onset.status, [[0, 0, 0, 1, 0]])
        assert onset.height[0, 3] == pytest.approx(-0.35 if event == "onset" else -0.45)
        assert np.isnan(onset.height[0, [0, 1, 2, 4]]).all()


@pytest.mark.parametrize("event", EVENTS)
def test_a_saturated_sample_is_light_though_its_level_is_beyond_the_range(device, event):
    frames = np.full((30, 1, 3), 20, np.uint8)
    frames[20:, 0, 0], frames[20:, 0, 1], frames[:, 0, 2] = 255, 254, 255
    frames[10, 0, 1] = 255
    travel = np.arange(30) * 0.1
    if event == "release":
        frames, travel = frames[::-1].copy(), travel[::-1].copy()
    options = {"threshold": 0.9, "noise": 1.0, "event": event}
    onset = find_onset(frames, travel, dark=20, bright=400, device=device, **options)
    assert_within_an_ulp(onset, by_reference(frames, travel, 20, 400, **options), travel)
    np.testing.assert_array_equal(onset.status[0, [0, 2]], [1, 3])
    assert 1.9 <= -onset.height[0, 0] <= 2.0
    assert 0 < onset.height_sigma[0, 0] < 0.1


def test_pixels_without_references_are_invalid(device):
    frames = np.full((5, 2, 4), 20, np.uint8)
    frames[3:] = 200
    dark, bright = np.full((2, 4), 20.0), np.full((2, 4), 220.0)
    bright[0, 0], dark[0, 1], bright[1, 2] = 20, np.nan, np.inf
    options = {"dark": dark, "bright": bright, "device": device}
    onset = find_onset(frames, np.arange(5.0), **options)
    np.testing.assert_array_equal(onset.frame, [[-1, -1, 3, 3], [3, 3, -1, 3]])
    released = find_onset(frames[::-1].copy(), -np.arange(5.0), **options, **RELEASE)
    for status in (onset.status, released.status):
        np.testing.assert_array_equal(status, [[0, 0, 1, 1], [1, 1, 0, 1]])


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_level_is_the_smallest_light_sample(device, dtype):
    dark, bright = (10, 21) if dtype != "float32" else map(float, np.float32([0.1, 0.7]))
    for threshold in (0.0, 0.25, 0.5, 1.0):
        exact = dark + threshold * (bright - dark)
        lowest = np.ceil(exact) if dtype != "float32" else np.float32(exact)
        if float(lowest) < exact:
            lowest = np.nextafter(np.float32(lowest), np.float32(np.inf))
        below = lowest - 1 if dtype != "float32" else np.nextafter(lowest, np.float32(-np.inf))
        frames = np.zeros((4, 1, 2), dtype)
        frames[2:, 0, 0], frames[2:, 0, 1] = lowest, below
        options = {"dark": dark, "bright": bright, "threshold": threshold, "noise": 0.1, "device": device}
        np.testing.assert_array_equal(find_onset(frames, np.arange(4.0), **options).status, [[1, 2]])
        if dtype != "uint16":
            frames[:2] = 2 * bright
            np.testing.assert_array_equal(
                find_onset(frames, -np.arange(4.0), **options, **RELEASE).status, [[3, 1]]
            )


def test_thresholds_that_binary_cannot_hold_are_met():
    """0.55 of the way from 0 to 100 is 55 counts, though 0.55 * 100 is a little more."""
    for percent in range(1, 100):
        frames = np.zeros((4, 1, 2), np.uint8)
        frames[2:, 0] = percent, percent - 1
        onset = find_onset(frames, np.arange(4.0), dark=0, bright=100, threshold=percent / 100, noise=0.5)
        np.testing.assert_array_equal(onset.status, [[1, 2]], err_msg=str(percent))


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_levels_are_those_of_the_reference_to_the_last_bit(device, dtype, event):
    """References of all kinds: plain, fractional, beyond the range, negative, equal, swapped, no numbers."""
    shape, top = (61, 67), {"uint8": 255, "uint16": 65535, "float32": 3.0}[dtype]
    generator = np.random.default_rng(1)
    dark = generator.uniform(-0.2, 0.6, shape) * top
    bright = dark + generator.uniform(0, 1, shape) * top
    whole, odd = generator.random(shape) < 0.5, generator.random(shape)
    dark, bright = np.where(whole, np.rint(dark), dark), np.where(whole, np.rint(bright), bright)
    bright = np.select([odd < 0.02, odd < 0.04, odd < 0.06], [dark, dark - 1, np.inf], bright)
    dark = np.select([odd > 0.98, odd > 0.96], [np.nan, -np.inf], dark)
    dark, bright, noise = dark.astype(np.float32), bright.astype(np.float32), 0.01 * top
    for threshold in (0.0, 0.55, 1.0):
        options = {"dark": dark, "bright": bright, "threshold": threshold, "noise": noise, "event": event}
        frames = np.zeros((2, *shape), dtype)
        search = Onset(device=device, **options)
        run = Run(Plan(search, checked=False), ArraySource(frames, search, {"travel": [0.0, 1.0]}))
        read = run.operation._picture.read
        levels = read(("levels", 0), ("levels", 1))
        run.push(frames[:1], travel=[0.0])  # looks for what is surely dark
        level, plateau, light = reference.onset_levels(
            bright, dark, threshold - 1e-12, np.dtype(dtype), release=event == "release"
        )
        alive = np.isfinite(level)
        np.testing.assert_array_equal(read("frames_left")[0] > 0, alive)
        # A level that is 0 but for rounding is so in float64, too.
        zero = np.abs(level) < 1e-6
        np.testing.assert_array_equal(levels[0][alive & ~zero], level[alive & ~zero])
        np.testing.assert_allclose(levels[0][alive & zero], level[alive & zero], rtol=0, atol=1e-9)
        np.testing.assert_array_equal(levels[1][alive], plateau[alive])
        np.testing.assert_array_equal(read(("thresholds", 0))[0][alive], light[alive])
        sure = reference.onset_sure(level, light, 6 * noise)
        np.testing.assert_array_equal(read(("thresholds", 1))[0][alive], sure[alive])
        plane = reference.complement(np.zeros(shape, dtype)) if event == "release" else plateau
        near = reference.onset_near(level, plane, sure)
        np.testing.assert_array_equal(read(("thresholds", 2))[0][alive], near[alive])


def test_the_whole_range_of_uint16(device):
    edges = [0, 1, 2, 127, 128, 254, 255, 256, 257, 32767, 32768, 32769, 65279, 65280, 65534, 65535]
    travel = np.arange(70) / 64
    for level in (1, 2, 128, 255, 256, 32768, 65535):
        frames = np.random.default_rng(level).choice(edges, (70, 7, 37)).astype(np.uint16)
        options = {"threshold": 1.0, "noise": 0.5}
        onset = find_onset(frames, travel, dark=0, bright=level, device=device, **options)
        assert_within_an_ulp(onset, by_reference(frames, travel, 0, level, **options), travel)


@pytest.mark.parametrize("broken", [False, True])
def test_the_whole_range_of_float32(device, broken):
    """Which samples are light, at least: differences between the largest are beyond a float."""
    odd = np.float32([0, -0.0, 1e-45, -1e-45, 1e-39, -1e-39, 1e-38, 0.5, 1, -1, 255, 65535, 3e38, -3e38])
    generator, travel = np.random.default_rng(int(broken)), np.arange(70) / 64
    for level in (1e-39, 1e-38, 0.5, 65535.0, 1e30):
        frames = generator.choice(odd, (70, 7, 37)).astype(np.float32)
        if broken:
            struck = generator.random(frames.shape) < 0.03
            frames[struck] = generator.choice(np.float32([np.nan, np.inf, -np.inf]), np.count_nonzero(struck))
        options = {"threshold": 1.0, "noise": 0.0}
        onset = find_onset(frames, travel, dark=0, bright=level, device=device, **options)
        expected = by_reference(frames, travel, 0, level, **options)
        np.testing.assert_array_equal(onset.status, expected.status)
        np.testing.assert_array_equal(onset.frame, expected.frame)
    zeros = np.full((4, 1, 2), -1, np.float32)
    zeros[2:] = 0.0, -0.0
    for level in (0.0, -0.0):
        options = {"dark": -1, "bright": level, "threshold": 1.0, "noise": 0.0, "device": device}
        np.testing.assert_array_equal(find_onset(zeros, np.arange(4.0), **options).frame, [[2, 2]])


def test_a_hold_longer_than_any_stack_waits_for_the_end(device):
    frames = np.full((9, 1, 2), 20, np.float32)
    frames[2:5] = 200
    frames[5:, 0, 1], frames[7, 0, 1] = 200, np.inf
    options = {"dark": 20, "bright": 220, "hold": 2**31 - 1, "noise": 1.0, "device": device}
    np.testing.assert_array_equal(search_in_blocks(frames, np.arange(9.0), [4], **options).status, [[2, 0]])
    np.testing.assert_array_equal(find_onset(frames[:5], np.arange(5.0), **options).frame, [[2, 2]])


def test_travel_may_pause(device):
    frames = np.full((5, 1, 1), 20, np.uint8)
    frames[3:] = 200
    onset = find_onset(frames, [0.0, 0.1, 0.1, 0.1, 0.2], **LEVELS["uint8"], noise=1.0, device=device)
    assert onset.height[0, 0] == np.float32(-0.1)
    assert onset.height_sigma[0, 0] == 0


def test_a_press_played_backwards_has_its_release_where_its_onset_was(device):
    """Steps, and ramps that are under way in both samples: the same interval, so the same answer."""
    generator = np.random.default_rng(2)
    middle, lasts = generator.uniform(8, 32, (20, 30)), generator.choice([1e-6, 6], (20, 30))
    fraction = np.clip((np.arange(40)[:, None, None] - middle) / lasts + 0.5, 0, 1)
    frames = np.rint(20 + 201 * fraction).astype(np.uint8)  # no sample is at the level, 120.5
    travel = np.arange(40) / 8  # whose sums are exact
    options = {"dark": 20, "bright": 221, "noise": 1.0, "device": device}
    onset = find_onset(frames, travel, **options)
    release = find_onset(frames[::-1].copy(), travel[::-1].copy(), **options, **RELEASE)
    np.testing.assert_array_equal(release.frame, 40 - onset.frame)
    steps = lasts < 1
    np.testing.assert_array_equal(release.height[steps], onset.height[steps])
    np.testing.assert_allclose(release.height[~steps], onset.height[~steps], atol=1e-6)
    np.testing.assert_allclose(release.height_sigma, onset.height_sigma, rtol=1e-5)


def test_a_release_of_the_complement_is_an_onset(device):
    """All is the same to the last bit where no sample equals the level, which is light in both."""
    frames, travel = stroke("uint8", 40, ODD, "release", seed=11, noise=0.1)
    frames = frames[::-1].copy()
    options = {"noise": 2.0, "device": device}
    onset = bare(Onset(bright=221, **options), frames, travel=-travel)  # the level is 110.5
    release = bare(Onset(dark=255 - 221, **options, **RELEASE), ~frames, travel=travel)
    assert {1, 2, 3} <= set(onset.status.flat)
    np.testing.assert_array_equal(release.frame, onset.frame)
    np.testing.assert_array_equal(release.status, np.array([0, 1, 3, 2])[onset.status])
    np.testing.assert_array_equal(release.height, -onset.height)
    np.testing.assert_array_equal(release.height_sigma, onset.height_sigma)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": np.zeros((1, 3, 3), np.uint8), "travel": [0.0]}, "at least 2 frames"),
        ({"frames": np.zeros((5, 3, 3), np.float32), "dark": None}, "dark and bright"),
        ({"travel": [0.0, 1.0, np.nan, 2.0, 3.0]}, "nan at frame 2"),
        ({"travel": [0.0, 1.0, 0.5, 2.0, 3.0]}, "runs back at frame 2: a press only goes down"),
        ({"event": "release"}, "runs back at frame 1: a release only goes up"),
        ({"dark": np.zeros((2, 3))}, "the frames are 3 x 3"),
        ({"dark": 220, "bright": 20}, "bright is not above dark"),
    ],
)
def test_bad_input_is_refused(change, words):
    call = {"frames": np.zeros((5, 3, 3), np.uint8), "travel": np.arange(5.0), "dark": 20, "bright": 220}
    with pytest.raises(InputError, match=words) as caught:
        find_onset(**(call | change))
    assert "\n" not in str(caught.value)


def test_frames_that_do_not_follow_are_refused():
    search = bare_run(Onset())
    search.push(np.zeros((1, 3, 3), np.uint8), travel=[1.0])
    with pytest.raises(InputError, match="at least 2 frames; 1 has been pushed"):
        search.result()
    with pytest.raises(InputError, match="runs back at frame 0"):
        search.push(np.zeros((2, 3, 3), np.uint8), travel=[0.5, 2.0])


def twelve_bits():
    """Return frames of 12 bits in which all but one column turn light, and their travel."""
    frames = np.random.default_rng(3).normal(200, 5, (9, 20, 20))
    for column in range(19):
        frames[2 + column // 4 :, :, column] += 3000
    return np.rint(frames).astype(np.uint16), 0.1 * np.arange(9)


def test_levels_that_are_not_given_are_estimated_with_a_note():
    frames, travel = twelve_bits()
    onset = engine.find_onset(frames, travel)
    message = r"no dark and bright given: estimated as 2\d\d and 32\d\d counts \(give dark and bright, or .*"
    assert re.fullmatch(message, onset.process["notes"])
    expected = engine.reconstruct(frames, travel=travel)
    np.testing.assert_array_equal(onset.height, expected.height)
    np.testing.assert_array_equal(onset.height_sigma, expected.height_sigma)
    right = np.broadcast_to(-0.15 - 0.1 * (np.arange(19) // 4), (20, 19))
    np.testing.assert_allclose(onset.height[:, :19], right, atol=0.06)


def test_levels_of_other_counts_than_the_frames_are_reported():
    frames, travel = twelve_bits()
    shares = (frames / 4096).astype(np.float32)
    line = r"samples are 0\.\d+ to 0\.\d+, below the threshold of 1700 between dark 200 and bright 3200: are"
    with pytest.warns(io.MirrorskinWarning, match=line):
        engine.find_onset(shares, travel, dark=200, bright=3200)
    with pytest.warns(io.MirrorskinWarning, match=line):
        engine.reconstruct(shares, travel=travel, dark=200, bright=3200)
