"""What the swing of the brightness of a rotation shows: gamma, vignetting, gains of pixels, and blur."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mirrorskin import engine, io
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import Setup
from mirrorskin.io.files.arrays import ArrayRecording

SIZE, PIXEL, COUNT = 72, 0.05, 16
SETUP = Setup(noise=1.2, offset=20.0, phase=tuple(np.arange(COUNT) * 2 * np.pi / COUNT))
FULL = 200.0  # counts above dark


WAVES = rotations.waves((SIZE, SIZE), (PIXEL, PIXEL))


def shares(normals):
    """Return the light of each frame, as a share of full light."""
    return (rotations.levels(normals, SETUP) - 20) / FULL


def result_of(light, **stated):
    counts = np.rint(20 + FULL * light + np.random.default_rng(1).normal(0, SETUP.noise, light.shape))
    header = {"tilt": SETUP.tilt, "zenith_gain": SETUP.slope, "zenith_offset": 20.0}
    header |= {"pixel_size": (PIXEL, PIXEL), **stated}
    frames = counts.clip(0, 255).astype(np.uint8)
    return engine.reconstruct(ArrayRecording(frames, {"phase": np.array(SETUP.phase)}, header), blur=0.0)


def warned(light, words, **stated):
    with pytest.warns(io.MirrorskinWarning, match=words):
        return result_of(light, **stated)


def chi2(result):
    error = np.linalg.norm(np.cross(result.normals.astype(float), WAVES), axis=-1)
    return np.nanmean((error / result.normals_sigma) ** 2)


def uneven():
    """Return shares of the light that reach the pixels: less in the corners."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE))
    return 1 - 0.1 * (x**2 + y**2) / 2


def gains():
    return 1 + 0.03 * np.random.default_rng(5).standard_normal((SIZE, SIZE))


def test_light_as_stated_has_no_finding():
    process = result_of(shares(WAVES), **rotations.EXACT).process
    assert not {"warnings", "pixel_gain_sigma"} & set(process)


def test_a_response_that_is_not_linear_is_found():
    warned(shares(WAVES) ** 0.85, "as with a gamma")


def test_uneven_light_is_no_warning():
    assert "warnings" not in result_of(shares(WAVES) * uneven()).process


def test_errors_of_normals_in_uneven_light_include_it():
    assert chi2(result_of(shares(WAVES) * uneven())) < 1.3


def test_a_lens_that_blurs_is_found():
    blurred = np.stack([gaussian_filter(frame, 1.5, mode="nearest") for frame in shares(WAVES)])
    warned(blurred, r"as if a lens blurs by 1\.2 pixels")


def test_gains_of_pixels_are_estimated():
    assert result_of(shares(WAVES) * gains()).process["pixel_gain_sigma"] == pytest.approx(0.03, abs=0.006)


def test_gains_of_pixels_are_part_of_the_errors_of_normals():
    assert 0.8 < chi2(result_of(shares(WAVES) * gains(), **rotations.EXACT)) < 1.25


def test_gains_of_pixels_are_part_of_the_errors_of_heights():
    even, differing = (result_of(shares(WAVES) * gain, **rotations.EXACT) for gain in (1, gains()))
    assert np.median(differing.height_sigma) > 1.1 * np.median(even.height_sigma)


def test_a_plate_shows_nothing():
    plate = np.broadcast_to(rotations.direction(np.radians(20), 0.3), (SIZE, SIZE, 3))
    assert "warnings" not in result_of(shares(plate) ** 0.85).process
