"""Focus variation: the height of a texture that defocus blurs, and its standard error."""

import re

import numpy as np
import pytest
from bare import bare

from mirrorskin import engine, io
from mirrorskin.engine.optical.focus import Focus
from mirrorskin.io.files.arrays import ArrayRecording

SHAPE = (48, 48)
TRAVEL = np.arange(0, 9, 0.5)
PITCH = 0.12  # cycles per pixel


def textured(travel=TRAVEL, sharpest=4.2, seed=0, waves=None, contrast=30.0):
    """Frames of waves in all directions, blurred by a Gaussian whose width is |travel - sharpest| pixels.

    Of waves as long as each other the contrast is a Gaussian over the travel; ``sharpest`` may be a map.
    """
    generator = np.random.default_rng(seed)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    frames = np.full((len(travel), *SHAPE), 120.0)
    width = np.abs(travel[:, None, None] - sharpest)
    for pitch in [PITCH] * 40 if waves is None else waves(generator):
        angle, phase = generator.uniform(0, 2 * np.pi, 2)
        wave = np.cos(2 * np.pi * pitch * (np.cos(angle) * column + np.sin(angle) * row) + phase)
        frames += contrast * np.sqrt(2 / 40) * np.exp(-2 * (np.pi * pitch * width) ** 2) * wave
    return frames


def find_focus(frames, travel, **options):
    return bare(Focus(**options), frames, travel=travel)


def noisy(frames, noise, seed):
    return (frames + noise * np.random.default_rng(seed).normal(size=frames.shape)).astype(np.float32)


@pytest.mark.parametrize("reach", [1, 2, 4])
@pytest.mark.parametrize("sharpest", [4.0, 4.1, 4.25])
def test_waves_of_one_length_are_exact_without_noise(reach, sharpest):
    frames = textured(sharpest=sharpest).astype(np.float32)
    result = find_focus(frames, TRAVEL, noise=0, reach=reach)
    np.testing.assert_allclose(result.height, -sharpest, atol=2e-4)


def test_steps_may_be_uneven_and_go_up():
    travel = np.cumsum(np.random.default_rng(1).uniform(0.2, 0.8, 18))[::-1]
    result = find_focus(textured(travel).astype(np.float32), travel, noise=0)
    np.testing.assert_allclose(result.height, -4.2, atol=2e-4)


def test_texture_of_all_lengths_is_right_to_a_twentieth_of_a_step():
    frames = textured(waves=lambda generator: np.sqrt(generator.uniform(0.02**2, 0.3**2, 200)))
    result = find_focus(frames.astype(np.float32), TRAVEL, noise=0)
    assert abs(np.median(result.height) + 4.2) < 0.5 / 20


def test_the_standard_error_includes_a_curve_that_is_not_a_gaussian():
    frames = textured(waves=lambda generator: np.sqrt(generator.uniform(0.02**2, 0.3**2, 200)))
    result = find_focus(noisy(frames, 0.1, 0), TRAVEL, noise=0.1)
    ratio = (result.height + 4.2) / result.height_sigma
    assert 0.1 < np.mean(ratio**2) < 2  # 100 by noise alone


def test_contrast_in_two_frames_has_no_vertex():
    strength = np.array([0, 0, 0, 1, 0.9, 0, 0, 0, 0], np.float32)[:, None, None]
    texture = np.random.default_rng(0).normal(100, 10, SHAPE).astype(np.float32)
    result = find_focus(strength * texture, np.arange(9.0), noise=0.1)
    assert (result.status == 2).all()


def test_a_slope_is_followed():
    slope = 4 + 0.02 * (np.arange(SHAPE[1]) - 23.5)
    result = find_focus(textured(sharpest=slope).astype(np.float32), TRAVEL, noise=0)
    error = (result.height + slope)[:, 6:-6]
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_three_samples_leave_no_standard_error():
    result = find_focus(noisy(FRAMES, 0.5, 1), TRAVEL, noise=0.5, reach=1)
    assert np.isfinite(result.height).any()
    assert np.isnan(result.height_sigma).all()


@pytest.mark.parametrize(("noise", "reach"), [(0.5, 2), (3.0, 2)])
def test_the_standard_error_is_the_scatter(noise, reach):
    frames, square = textured(), []
    for seed in range(40):
        result = find_focus(noisy(frames, noise, seed), TRAVEL, noise=noise, reach=reach)
        sound = result.status == 1
        assert sound.mean() > 0.9
        square.append(np.mean(((result.height + 4.2) / result.height_sigma)[sound] ** 2))
    # So small a picture does not exclude relief inside the windows.
    assert 0.3 < np.mean(square) < 1.1


def test_sharpness_is_the_contrast_without_the_noise():
    result = find_focus(noisy(textured(sharpest=4.0), 3.0, 0), TRAVEL, noise=3.0)
    clean = find_focus(textured(sharpest=4.0).astype(np.float32), TRAVEL, noise=0)
    assert np.mean(result.sharpness**2) == pytest.approx(np.mean(clean.sharpness**2), rel=0.01)


def test_a_picture_without_texture_has_no_peak():
    result = find_focus(noisy(np.full((18, *SHAPE), 100.0), 2.0, 0), TRAVEL, noise=2.0)
    assert (result.status != 1).mean() > 0.999
    assert np.isnan(result.height[result.status != 1]).all()


def test_a_peak_at_the_end_of_the_stack_is_reported():
    result = find_focus(textured(sharpest=9.5).astype(np.float32), TRAVEL, noise=0)
    assert (result.status == 3).all()
    assert np.isnan(result.height).all()


def test_a_missing_sample_is_left_out_and_a_missing_pixel_invalid():
    frames = textured().astype(np.float32)
    frames[6, 9, 9] = np.nan
    frames[:, 30, 30] = np.nan
    result = find_focus(frames, TRAVEL, noise=0)
    assert result.height[9, 9] == pytest.approx(-4.2, abs=1e-3)
    assert result.status[30, 30] == result.status[26, 34] == 0
    assert result.status[25, 30] == 1


FRAMES = textured().astype(np.float32)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"frames": FRAMES[0]}, "frames are float32 (48, 48): for a single frame, pass frame[None]"),
        ({"noise": None}, "noise is missing"),
        ({"radius": 1.5}, "radius is 1.5: a whole number is needed"),
    ],
)
def test_bad_input_is_one_line(arguments, line):
    with pytest.raises(io.InputError, match=re.escape(line)):
        engine.optical.find_focus(**{"frames": FRAMES, "travel": TRAVEL, "noise": 1, **arguments})


def test_texture_that_is_uneven_on_a_slope_is_part_of_the_error():
    slope = 4.2 + 0.05 * (np.arange(SHAPE[1]) - 23.5)
    fading = np.linspace(1, 0.1, SHAPE[1])
    frames = 120 + (textured(sharpest=slope) - 120) * fading
    result = find_focus(noisy(frames, 0.05, 0), TRAVEL, noise=0.05)
    ratio = (result.height + slope)[6:-6, 6:-6] / result.height_sigma[6:-6, 6:-6]
    assert 0.1 < np.mean(ratio**2) < 1  # 2.0 without


def test_errors_grow_where_few_pixels_around_have_a_peak():
    frames = textured()
    frames[:, :, 24:] = 120  # no texture there
    result = find_focus(noisy(frames, 0.5, 0), TRAVEL, noise=0.5)
    inside, border = np.nanmedian(result.height_sigma[:, 10]), np.nanmedian(result.height_sigma[:, 24])
    assert border > 1.4 * inside


def carved(depth, period, seed, noise=1.0):
    """Return errors over standard deviations on a surface with grooves that a window averages over."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    surface = 4.2 + depth * np.sin(2 * np.pi * (column + 0.3 * row) / period)
    waves = {"waves": lambda generator: generator.uniform(0.08, 0.2, 60)}
    frames = textured(sharpest=surface, seed=seed, **waves)
    result = find_focus(noisy(frames, noise, seed), TRAVEL, noise=noise)
    return ((result.height + surface) / result.height_sigma)[6:-6, 6:-6]


@pytest.mark.parametrize(("depth", "period"), [(0.3, 5), (0.3, 8), (0.3, 16), (0.1, 8), (0.0, 8)])
def test_relief_inside_the_window_is_part_of_the_error(depth, period):
    square = [np.nanmean(carved(depth, period, seed) ** 2) for seed in range(4)]
    assert 0.3 < np.mean(square) < 1.6


def test_only_some_rows_of_large_pictures_show_the_relief(monkeypatch):
    whole = carved(0.3, 8, 0)
    monkeypatch.setattr("mirrorskin.engine.optical.focus._ALL_ROWS", 0)
    some = carved(0.3, 8, 0)
    assert np.nanmean(some**2) == pytest.approx(np.nanmean(whole**2), rel=0.2)


def test_light_that_changes_is_part_of_the_error():
    frames = textured(contrast=20)
    fading = np.linspace(1.1, 0.9, len(TRAVEL))[:, np.newaxis, np.newaxis]
    steady, faded = (
        engine.optical.find_focus(noisy(stack, 0.1, 0), TRAVEL, noise=0.1)
        for stack in (frames, frames * fading)
    )
    shift = np.abs(np.nanmedian(faded.height - steady.height))
    assert shift > 3 * np.nanmedian(steady.height_sigma)
    assert 0.7 * shift < np.nanmedian(faded.height_sigma) < 2 * shift


def jumped(steps):
    """Return the travel of frames from which some are missing, or one is there twice, before frame 9."""
    return np.where(np.arange(len(TRAVEL)) >= 9, TRAVEL + 0.5 * steps, TRAVEL)


def focus_frames(travel, stated):
    """Return the maps of an inclined surface at some travel, from a recording that states another one."""
    slope = 4.2 + 0.04 * (np.arange(SHAPE[1]) - 23.5)
    frames = noisy(textured(travel, sharpest=slope), 0.5, 0)
    return engine.run(ArrayRecording(frames, {"travel": stated}, {}), Focus(noise=0.5))


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        (1, "0.5 mm further, as if a frame before it was missing"),
        (-1, "0.5 mm back, as if a frame before it was there twice"),
    ],
)
def test_a_lost_frame_is_found_by_the_peaks(steps, words):
    with pytest.warns(io.MirrorskinWarning, match=f"from frame 9 on, .* fit a travel {words}"):
        focus_frames(jumped(steps), TRAVEL)


def test_travel_that_is_measured_may_jump():
    assert "peaks" not in focus_frames(jumped(1), jumped(1)).process.get("warnings", "")


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_a_curve_that_is_no_gaussian_is_no_scatter(slope):
    """The texture has waves of all lengths, so that the logarithm of its contrast is no parabola."""
    ratios = []
    for seed in range(3):
        sharpest = 4.2 + slope * (np.arange(SHAPE[1]) - SHAPE[1] / 2)
        frames = textured(
            sharpest=sharpest,
            seed=seed,
            waves=lambda generator: generator.uniform(0.05, 0.3, 200),
            contrast=20,
        )
        result = find_focus(noisy(frames, 1.0, seed), TRAVEL, noise=1.0)
        inside = np.s_[8:-8, 8:-8]
        ratios.append(((result.height + sharpest) / result.height_sigma)[inside])
    assert 0.15 < np.nanmean(np.square(ratios)) < 2
