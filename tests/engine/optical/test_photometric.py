"""Photometric stereo: normals of a ball exactly without noise, at the Cramer-Rao bound with it."""

import re
import warnings

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from stacks import MadeUp

from mirrorskin import engine, io
from mirrorskin.engine.optical.photometric import PhotometricStereo, photometric_stereo
from mirrorskin.io.files.arrays import ArrayRecording

AZIMUTH = np.arange(12) * 2 * np.pi / 12
ROW, COLUMN = np.mgrid[1:-1:60j, -1:1:60j]
BALL = np.dstack([COLUMN, ROW, np.sqrt(np.maximum(1 - ROW**2 - COLUMN**2, 0))])
INSIDE = BALL[..., 2] > 0.1
LAMPS = np.random.default_rng(3).normal(size=(8, 3)) * 0.4 + [0, 0, 1]
ALBEDO = np.where(INSIDE, 100 + 40 * COLUMN, 0)


def round_lamps(zenith, azimuth=AZIMUTH):
    out = np.full(len(azimuth), np.sin(zenith))
    return np.column_stack(
        [out * np.cos(azimuth), out * np.sin(azimuth), np.full(len(azimuth), np.cos(zenith))]
    )


def lit(lamps, dtype="float32", noise=0.0, seed=0, dark=0.0):
    """Frames of the ball; a sample is 0 in attached shadow, and clipped by an integer type."""
    light = dark + ALBEDO * np.maximum(np.einsum("hwk,tk->thw", BALL, lamps), 0)
    light += noise * np.random.default_rng(seed).normal(size=light.shape)
    return light.astype(dtype) if dtype == "float32" else np.rint(light).clip(0, 255).astype(dtype)


def angle(result):
    return np.arccos(np.clip(np.sum(result * BALL, axis=-1), -1, 1))[INSIDE]


def bound(lamps):
    """The RMS angle of the Cramer-Rao bound at each pixel lit by all lamps, for noise 1, by two angles."""
    along = np.dstack([BALL[..., 2], 0 * ROW, -BALL[..., 0]])
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    slopes = np.stack([ALBEDO[..., None] * along, ALBEDO[..., None] * np.cross(BALL, along), BALL], axis=-1)
    information = np.einsum("hwki,tk,tl,hwlj->hwij", slopes, lamps, lamps, slopes)[INSIDE]
    return np.sqrt(np.trace(np.linalg.inv(information)[:, :2, :2], axis1=1, axis2=2))


@pytest.mark.parametrize("lamps", [round_lamps(0.3), LAMPS], ids=["round", "anywhere"])
def test_a_ball_is_exact_without_noise(lamps):
    result = photometric_stereo(lit(lamps), light=lamps)
    np.testing.assert_allclose(result.normals[INSIDE], BALL[INSIDE], atol=2e-6)
    np.testing.assert_allclose(result.albedo[INSIDE], ALBEDO[INSIDE], rtol=2e-6)


def test_shadows_and_highlights_are_left_out():
    frames = lit(round_lamps(1.0), "uint8", dark=160.0)  # to 300 counts
    result = photometric_stereo(frames, light=round_lamps(1.0), dark=160)
    usable = INSIDE & (result.samples > 4)
    assert usable.mean() > 0.5
    assert (result.samples[usable] < 12).mean() > 0.6
    assert np.degrees(angle(result.normals)[usable[INSIDE]]).max() < 1.5


def test_too_few_lamps_are_no_answer():
    result = photometric_stereo(lit(LAMPS[:2]), light=LAMPS[:2], noise=1)
    flat = photometric_stereo(lit(LAMPS[[0, 1, 0, 1]]), light=LAMPS[[0, 1, 0, 1]])
    assert np.isnan([result.normals, flat.normals]).all()


def test_the_standard_error_is_the_cramer_rao_bound():
    lamps = round_lamps(0.3)
    lamps = lamps * np.linspace(0.5, 1.5, 12)[:, None]
    lit_by_all = np.all(np.einsum("hwk,tk->thw", BALL, lamps) > 0, axis=0)[INSIDE]
    result = photometric_stereo(lit(lamps), light=lamps, noise=2)
    np.testing.assert_allclose(
        result.normals_sigma[INSIDE][lit_by_all], 2 * bound(lamps)[lit_by_all], rtol=0.01
    )


def test_the_standard_errors_are_the_scatter():
    lamps = round_lamps(0.5)
    result = photometric_stereo(lit(lamps, noise=0.5), light=lamps, shadow=2)
    assert result.process["noise"] == pytest.approx(0.5, rel=0.03)
    # The dark level may be wrong by 0.2 % of the light, which nothing shows.
    assert 0.7 < np.mean((angle(result.normals) / result.normals_sigma[INSIDE]) ** 2) < 1.05
    error = (result.albedo - ALBEDO)[INSIDE] / result.albedo_sigma[INSIDE]
    assert 0.3 < np.mean(error**2) < 1.05


def test_a_lamp_that_goes_round_is_the_correlation_of_a_rotation():
    frames = lit(round_lamps(0.3), noise=0.5) + 30  # nowhere dark
    wave = engine.correlate(frames, AZIMUTH)
    vector = np.dstack([wave.cosine / np.sin(0.3), wave.sine / np.sin(0.3), wave.mean / np.cos(0.3)])
    with pytest.warns(io.MirrorskinWarning):  # 30 counts are not dark
        result = photometric_stereo(frames, AZIMUTH, zenith=0.3)
    np.testing.assert_allclose(result.normals * result.albedo[..., None], vector, atol=2e-3)
    np.testing.assert_allclose(result.residual, wave.residual, rtol=1e-3)


def test_a_lamp_is_needed_for_each_frame_and_no_more():
    run = engine.Run(PhotometricStereo(light=LAMPS))
    run.push(FRAMES[:6])
    assert np.isfinite(run.result().normals[INSIDE]).any()
    with pytest.raises(io.InputError, match="light has 8 vectors: one is needed for each of 6 frames"):
        run.result(ended=True)
    with pytest.raises(io.InputError, match="light has 8 vectors: one is needed for each of 9 frames"):
        run.push(FRAMES[:3])


def test_the_dark_level_is_that_of_the_recording():
    frames = lit(round_lamps(0.3), dark=20.0)
    header = io.Header("axial", dark=np.full(ROW.shape, 20, np.float32))
    source = MadeUp(frames, header, phase=AZIMUTH)
    result = engine.run(source, PhotometricStereo(zenith=0.3))
    expected = photometric_stereo(frames, AZIMUTH, zenith=0.3, dark=20.0)
    np.testing.assert_array_equal(result.normals, expected.normals)


FRAMES = lit(LAMPS)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({}, "phase is missing: PhotometricStereo needs it of each frame"),
        ({"phase": AZIMUTH[:8]}, "specify the zenith"),
        ({"phase": AZIMUTH[:8], "light": LAMPS}, "PhotometricStereo has no position phase"),
        ({"light": AZIMUTH[:8]}, "light has shape (8,): (T, 3) is needed"),
        ({"light": LAMPS[:3]}, "light has 3 vectors: one is needed for each of 8 frames"),
        ({"light": 0 * LAMPS}, "light has lengths 0 to 0"),
        ({"light": LAMPS, "dark": [1, 2]}, "dark has shape (2,)"),
    ],
)
def test_bad_input_is_one_line(arguments, line):
    with pytest.raises(io.InputError, match=re.escape(line)):
        photometric_stereo(FRAMES, **arguments)


@pytest.mark.parametrize("azimuth", [[0, np.pi, 0, np.pi], np.pi / 2 * np.array([1, -1, 1, -1])])
def test_lamps_in_a_plane_determine_no_normal(azimuth):
    result = photometric_stereo(lit(round_lamps(0.6, np.array(azimuth))), azimuth, zenith=0.6, noise=1)
    assert np.isnan(result.normals).all()
    assert np.isnan(result.normals_sigma).all()


def bumps():
    """Return the normals of a wavy surface, (H, W, 3)."""
    u, v = np.meshgrid(np.arange(60) * 2 * np.pi / 24, np.arange(60) * 2 * np.pi / 28)
    normal = np.dstack([-0.6 * np.cos(u) * np.cos(v), 0.5 * np.sin(u) * np.sin(v), np.ones((60, 60))])
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def shone_on(normals, blur=0.0, power=1.0):
    """Return a recording of a surface under lamps at a zenith of 0.5, seen by a camera."""
    light = 0.8 * np.einsum("hwk,tk->thw", normals, round_lamps(0.5))
    light = np.stack([gaussian_filter(frame, blur, mode="nearest") if blur else frame for frame in light])
    counts = 200 * light**power + np.random.default_rng(2).normal(size=light.shape)
    frames = np.rint(counts).clip(0, 255).astype(np.uint8)
    return ArrayRecording(frames, {"phase": AZIMUTH}, {})


def chi2(result, normals):
    error = np.linalg.norm(np.cross(result.normals.astype(float), normals), axis=-1)
    return np.mean((error / result.normals_sigma)[5:-5, 5:-5] ** 2)


def test_a_lens_that_blurs_is_part_of_the_error():
    result = engine.run(shone_on(bumps(), blur=1.5), PhotometricStereo(zenith=0.5))
    assert 0.5 < chi2(result, bumps()) < 2  # 33 without


def recorded(
    lamps, power=1.0, stray=0.0, gloss=0.0, fading=0.0, exposure=1.0, dtype=np.uint8, top=255, seed=2
):
    """Return frames of the wavy surface with faults, and the dark level."""
    light = 0.8 * np.einsum("hwk,tk->thw", bumps(), lamps)
    half = lamps + np.array([0, 0, 1])
    shine = np.einsum("hwk,tk->thw", bumps(), half / np.linalg.norm(half, axis=1)[:, None])
    light += gloss * np.maximum(shine, 0) ** 20
    light = (1 - stray) * light + stray * light.mean(axis=(1, 2), keepdims=True)
    light *= 1 + fading * np.linspace(0, 1, len(lamps))[:, None, None]
    counts = 20 + (200 * (exposure * light) ** power + np.random.default_rng(seed).normal(size=light.shape))
    return np.rint(counts * top / 255).clip(0, top).astype(dtype), 20 * top / 255


TWO_RINGS = np.concatenate(
    [round_lamps(0.4, AZIMUTH[::2]), round_lamps(0.8, AZIMUTH[1::2])]  # at different zeniths
)
FAULTS = {
    "gamma": ({"power": 0.9}, "to its power"),
    "stray light": ({"stray": 0.05}, "counts of stray light"),
    "gloss": ({"gloss": 0.1}, "gloss"),
    "fading": ({"fading": -0.04}, ""),
    "saturation": ({"exposure": 1.5}, ""),
    "saturation, 12 bits": ({"exposure": 1.5, "dtype": np.uint16, "top": 4095}, ""),
    "saturation, floats": ({"exposure": 1.5, "dtype": np.float32}, ""),
}


@pytest.mark.parametrize("lamps", [round_lamps(0.6), TWO_RINGS], ids=["ring", "two rings"])
@pytest.mark.parametrize(("fault", "text"), FAULTS.values(), ids=FAULTS)
def test_faults_of_light_are_in_the_errors_or_reported(fault, text, lamps):
    frames, dark = recorded(lamps, **fault)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", io.MirrorskinWarning)
        result = photometric_stereo(frames, light=lamps, dark=dark, shadow=4)
        run = engine.run(
            ArrayRecording(frames, {"phase": AZIMUTH}, {"dark": np.float32(dark)}),
            PhotometricStereo(light=lamps, shadow=4),
        )
    np.testing.assert_allclose(result.normals_sigma, run.normals_sigma, rtol=1e-6)
    assert all(text in str(warning.message) for warning in caught)
    assert bool(caught) is bool(text)
    assert text or 0.4 < chi2(result, bumps()) < 2


def test_light_without_a_fault_has_no_finding():
    for seed in range(4):
        for lamps in (round_lamps(0.6), TWO_RINGS, LAMPS):
            frames, dark = recorded(lamps, seed=seed)
            result = photometric_stereo(frames, light=lamps, dark=dark, shadow=4)
            assert 0.5 < chi2(result, bumps()) < 1.1


def test_brightness_that_is_not_proportional_to_light_is_found():
    with pytest.warns(
        io.MirrorskinWarning, match="stray light were everywhere .or as with gloss or gamma|to its power"
    ):
        engine.run(shone_on(bumps(), power=0.9), PhotometricStereo(zenith=0.5))


def test_brightness_that_is_proportional_to_light_has_no_finding():
    result = engine.run(shone_on(bumps()), PhotometricStereo(zenith=0.5))
    assert "warnings" not in result.process
    assert 0.5 < chi2(result, bumps()) < 1.1
