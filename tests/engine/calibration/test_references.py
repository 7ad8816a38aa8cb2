"""References measured from frames of known pixels with artificial defects."""

import numpy as np
import pytest
from reference_frames import SCALES, TOPS, expose, pixels, rolled, source

from mirrorskin import io
from mirrorskin.engine.calibration import references as module
from mirrorskin.engine.calibration.references import measure_references
from mirrorskin.io.watch.saturation import scale_top

NOISE = 1.5


def references(dark, bright, **options):
    """Return the references of frames."""
    return measure_references([source(dark, "dark")], [source(bright, "bright")], **options).references


def measure(dark, light, dtype="uint8", count=24, top=None):
    """Measure pixels of which dark level and light are known, in a flat field."""
    noise = NOISE * SCALES[dtype]
    return measure_references(
        [source(expose(dark, noise, count, dtype, 11, top))],
        [source(expose(dark + light, 1.3 * noise, count, dtype, 12, top))],
    )


def with_defects(dtype, top):
    """Return pixels of which some are hot, dead and saturated, and the bits that say so."""
    dark, light = pixels(dtype=dtype)
    scale = SCALES[dtype]
    if top is not None:
        light = np.minimum(light, top - 6 * scale - dark)  # the sound ones stay clear of the top
    bits = np.zeros(dark.shape, np.uint8)
    chosen = np.random.default_rng(8).permutation(dark.size)[:90].reshape(3, 30)
    for bit, where in zip((1, 2, 4), chosen, strict=True):
        bits.flat[where] = bit if bit != 4 or top is not None else 0
    dark[bits == 1] += 60 * scale
    light[bits == 1] = 90 * scale
    light[bits == 2] *= np.linspace(0, 0.3, 30)
    if top is not None:
        light[bits == 4] = top + 10 * scale - dark[bits == 4]
    return dark, light, bits


@pytest.mark.parametrize(("dtype", "top"), [("uint8", 255), ("uint16", 4095), ("float32", None)])
def test_all_defects_are_found_and_no_sound_pixel_is(dtype, top):
    dark, light, bits = with_defects(dtype, top)
    references_ = measure(dark, light, dtype, top=top).references
    np.testing.assert_array_equal(references_.defects, bits)
    for levels in (references_.dark, references_.bright, references_.dark_sigma, references_.bright_sigma):
        assert levels.dtype == np.float32
        np.testing.assert_array_equal(np.isnan(levels), bits != 0)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_levels_are_right_and_their_errors_true(dtype):
    dark, light = pixels(dtype=dtype)
    light = np.minimum(light, (TOPS[dtype] or 1e9) - 10 * SCALES[dtype] - dark)
    measured = measure(dark, light, dtype)
    references_ = measured.references
    for value, sigma, truth in (
        (references_.dark, references_.dark_sigma, dark),
        (references_.bright, references_.bright_sigma, dark + light),
    ):
        assert np.mean(((value - truth) / sigma) ** 2) == pytest.approx(1, abs=0.06)
        assert abs(np.mean(value - truth)) < 0.05 * np.median(sigma)
    noise = NOISE * SCALES[dtype]
    assert measured.dark.sigma == pytest.approx(noise / 24**0.5, rel=0.05)
    assert measured.bright.noise == pytest.approx(1.3 * noise, rel=0.05)
    assert measured.dark.frames == measured.bright.frames == 24
    assert abs(measured.dark.drift) < 0.1 * noise


def test_several_recordings_count_as_one():
    dark, light = pixels()
    frames = expose(dark, NOISE, 20), expose(dark + light, NOISE, 30)
    whole = references(*frames)
    parts = ([source(part) for part in np.array_split(stack, 3)] for stack in frames)
    from_parts = measure_references(*parts).references
    for name in ("dark", "bright", "dark_sigma", "bright_sigma", "defects"):
        np.testing.assert_allclose(getattr(from_parts, name), getattr(whole, name), rtol=1e-5, err_msg=name)


def test_a_smooth_glow_and_a_field_that_ends_are_no_hot_pixels():
    dark, light = pixels()
    y, x = (np.linspace(-1, 1, size) for size in dark.shape)
    dark = 16 + 60 * np.exp(-3 * ((x - 1) ** 2 + (y[:, np.newaxis] - 1) ** 2))
    beyond = np.hypot(x, y[:, np.newaxis]) > 1.05
    light[beyond] = 0
    references_ = measure(dark, light).references
    assert not np.any(references_.defects & 1)
    np.testing.assert_array_equal(references_.defects[beyond], 2)
    assert np.count_nonzero(references_.defects[~beyond]) == 0


def test_a_pixel_that_flickers_is_hot_and_one_that_never_changes_or_gives_no_numbers_is_dead():
    dark, light = pixels(dtype="float32")
    noise = np.full(dark.shape, NOISE)
    noise[5, 6] = 12.0
    frames = expose(dark, noise, 24, "float32"), expose(dark + light, NOISE, 24, "float32")
    for stack in frames:
        stack[:, 9, 9] = 21
        stack[:, :, 20] = 18
    frames[0][::2, 3, 4] = np.nan
    frames[1][:, 8, 8] = np.nan
    measured = references(*frames)
    assert measured.defects[5, 6] & 1
    assert measured.defects[9, 9] == measured.defects[8, 8] == 2
    assert np.all(measured.defects[:, 20] == 2)
    assert np.count_nonzero(measured.defects) == 3 + len(dark)
    assert measured.dark[3, 4] == pytest.approx(dark[3, 4], abs=5 * float(measured.dark_sigma[3, 4]))
    assert measured.dark_sigma[3, 4] == pytest.approx(1.41 * np.nanmedian(measured.dark_sigma), rel=0.05)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_frames_that_are_all_equal_are_exact_but_for_their_rounding(dtype):
    shape = 4, 5, 7
    measured = measure_references([source(np.full(shape, 16, dtype))], [source(np.full(shape, 200, dtype))])
    references_ = measured.references
    assert np.all(references_.dark == 16)
    assert np.all(references_.bright == 200)
    assert not references_.defects.any()
    np.testing.assert_allclose(references_.dark_sigma, 0.0 if dtype == "float32" else 12**-0.5, rtol=1e-6)
    assert measured.dark.drift == 0


@pytest.mark.parametrize(
    ("dark", "bright", "message"),
    [
        ((1, 16), (8, 200), "dark contains 1 frame"),
        ((8, 16), (1, 200), "bright contains 1 frame"),
        ((0, 16), (8, 200), "dark contains no frames"),
        ((8, 200), (8, 16), "no brighter"),
        ((8, 16), (8, 16), "no brighter"),
    ],
)
def test_frames_that_contain_no_information_are_refused(dark, bright, message):
    frames = [np.full((count, 5, 7), level, np.uint8) for count, level in (dark, bright)]
    with pytest.raises(io.InputError, match=message):
        references(*frames)


def test_frames_of_nan_of_two_cameras_of_a_ball_and_of_light_are_refused():
    nothing = np.full((4, 5, 7), np.nan, np.float32)
    with pytest.raises(io.InputError, match="no pixel"):
        references(nothing, nothing + 1)
    with pytest.raises(io.InputError, match=r"7 x 6 uint8 and dark of 7 x 5 uint8"):
        references(np.zeros((3, 5, 7), np.uint8), np.zeros((3, 6, 7), np.uint8))
    with pytest.raises(io.InputError, match="uint16"):
        references(np.zeros((3, 5, 7), np.uint8), np.zeros((3, 5, 7), np.uint16))
    dark, light = pixels((21, 33))
    with pytest.raises(io.InputError, match="--rolled"):
        references(expose(dark, NOISE, 24), rolled(dark, light, 60, 0.4, 0.1))
    lit = dark.copy()
    lit[:, :5] += 0.8 * light[:, :5]
    with pytest.raises(io.InputError, match="lifted"):
        references(expose(lit, NOISE, 24), expose(dark + light, NOISE, 24))


def test_a_drift_is_reported():
    dark, light = pixels()
    rising = np.linspace(0, 3, 40)[:, np.newaxis, np.newaxis]
    measured = measure_references(
        [source(expose(dark, NOISE, 40))], [source(expose(dark + light + rising, NOISE, 40))]
    )
    assert measured.bright.drift == pytest.approx(1.54, abs=0.05)
    assert measured.dark.drift == pytest.approx(0, abs=0.05)


def test_the_frames_that_are_missing_are_counted():
    dark, light = pixels()
    level = measure(dark, light, count=16).dark
    assert level.missing(level.sigma) == 0
    more = level.missing(level.sigma / 2)
    assert more == pytest.approx(48, abs=2)
    assert measure(dark, light, count=16 + more).dark.sigma == pytest.approx(level.sigma / 2, rel=0.02)
    level = measure_references([source(expose(dark, 0.1, 8))], [source(expose(dark + light, 0.1, 8))]).dark
    assert 0.1 < level.rounding < 0.29
    assert level.missing(0.9 * level.rounding) is None
    assert level.missing(1.0) == 0


def test_a_rolled_ball_gives_full_light_without_bias():
    dark, light = pixels()
    light[4, 5] = 0
    light[7, 8] = 260 - dark[7, 8]
    frames = expose(dark, NOISE, 64), rolled(dark, light, 120, 0.35, 0.15)
    measured = measure_references([source(frames[0])], [source(frames[1])], rolled=True)
    references_ = measured.references
    assert references_.defects[4, 5] == 2
    assert references_.defects[7, 8] == 4
    assert np.count_nonzero(references_.defects) == 2
    error, sigma = (
        (values)[references_.defects == 0]
        for values in (references_.bright - dark - light, references_.bright_sigma)
    )
    assert abs(error.mean()) < 0.1 * np.median(sigma)
    assert np.mean((error / sigma) ** 2) == pytest.approx(1, abs=0.08)
    assert measured.bright.frames == 120
    assert np.isnan(measured.bright.drift)


def test_a_rolled_ball_is_read_in_bands_where_memory_is_short(monkeypatch):
    dark, light = pixels((11, 13))
    frames = expose(dark, NOISE, 32), rolled(dark, light, 60, 0.4, 0.1)
    whole = references(*frames, rolled=True)
    monkeypatch.setattr(module, "_MEMORY", 60 * 13 * 4)
    counts = []
    again = [source(frames[1], again=True)]
    bands = measure_references([source(frames[0])], again, rolled=True, progress=counts.append).references
    assert counts[-1] == 32 + 3 * 60
    np.testing.assert_allclose(bands.bright, whole.bright, atol=0.6)
    with pytest.raises(io.InputError, match="record it first"):
        references(*frames, rolled=True)


def test_the_top_of_a_camera_is_known_by_its_bits():
    tops = 255, 1023, 4095, 65535, 65520, 65472
    assert [scale_top(highest, True) for highest in tops] == list(tops)
    assert [scale_top(highest, True) for highest in (200, 240, 127, 254, 1)] == [None] * 5
    assert [scale_top(highest, False) for highest in (254.5, 1e30, 1.0)] == [None, None, 1]
