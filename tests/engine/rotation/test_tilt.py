"""The tilt, estimated from the amplitude of the zenith's wave."""

from dataclasses import replace

import numpy as np
import pytest

from mirrorskin.engine.correlation.design_matrix import turn_fit
from mirrorskin.engine.diagnosis.residual_noise import CountNoise
from mirrorskin.engine.rotation.tilt import estimate_tilt, zenith_seen
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT, UNEVEN, Setup
from mirrorskin.io import InputError

SETUP = Setup(gain=60.0, noise=20.0, offset=150.0, dtype="uint16")


def estimate(samples, setup, weights=None, high=np.inf):
    """Estimate with what the lab knows."""
    phase = np.array(setup.phase)
    weight = np.ones(len(phase)) if weights is None else np.array(weights)
    scale = np.array([setup.offset, 1 / setup.slope, -np.inf, high])
    noise = CountNoise(setup.spread**2, 0.0, setup.spread**2)
    return estimate_tilt(samples, turn_fit(phase, weight), scale, noise)


def samples_of(setup, zenith=(0, 55), count=400, seed=1):
    normals = rotations.random_normals(count, seed, bins=[zenith])[0]
    return normals, rotations.expose(normals, setup, seed)


def test_the_zenith_seen_is_the_angle_to_the_axis():
    zenith, azimuth = np.radians([0, 1e-6, 2.5, 2.5, 20, 60]), np.array([0.0, 1, np.pi, 2, -3, 4])
    normals = rotations.direction(zenith, azimuth)
    expected = [rotations.between(normals, axis) for axis in rotations.axes(UNEVEN, TILT)]
    np.testing.assert_allclose(zenith_seen(zenith, azimuth, np.array(UNEVEN), TILT), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("degrees", "phase"), [(0.5, EIGHTHS), (2.5, UNEVEN), (10.0, EIGHTHS[::2]), (2.5, EIGHTHS[:3])]
)
def test_the_tilt_is_found_within_its_error(degrees, phase):
    setup = replace(SETUP, tilt=np.radians(degrees), noise=5 * degrees, phase=phase)
    normals, samples = samples_of(setup)
    error = rotations.tilt_bound(normals, setup)
    assert error < 0.02 * setup.tilt
    assert estimate(samples, setup) == pytest.approx(setup.tilt, abs=4 * error)


def test_noise_as_large_as_the_tilt_is_no_bias():
    setup = replace(SETUP, noise=60.0, tilt=np.radians(1.0))
    normals, samples = samples_of(setup, zenith=(8, 55), count=4000)
    error = rotations.tilt_bound(normals, setup)
    assert estimate(samples, setup) == pytest.approx(setup.tilt, abs=4 * error)


def test_pixels_that_lose_contact_or_are_clipped_or_missing_do_not_count():
    _, samples = samples_of(SETUP)
    lost, clipped = samples.copy(), samples.copy()
    lost[3, ::5], lost[5:7, 1::10], lost[:, 2::10] = 151, 151, 160
    assert estimate(lost, SETUP) == pytest.approx(TILT, rel=0.02)
    clipped[::2, ::4], clipped[1::2, 1::4] = 65535, 0
    assert estimate(clipped, SETUP) == pytest.approx(TILT, rel=0.02)
    missing = samples.astype(np.float32)
    missing[2, ::4] = np.nan
    assert estimate(missing, SETUP) == pytest.approx(TILT, rel=0.02)
    high = np.radians(30)
    ended = np.minimum(samples, np.uint16(SETUP.offset + SETUP.slope * high))
    assert estimate(ended, SETUP, high=high) == pytest.approx(TILT, rel=0.02)


def test_frames_count_by_their_weights():
    weights = np.array([1, 1, 1, 1, 1e-4, 1, 1, 1])
    samples = rotations.levels(rotations.random_normals(400, 1, bins=[(12, 55)])[0], SETUP)
    samples += np.random.default_rng(0).normal(0, 20, samples.shape) / np.sqrt(weights)[:, np.newaxis]
    assert estimate(samples.astype(np.float32), SETUP, weights) == pytest.approx(TILT, rel=0.02)


STILL = np.full((8, 400), 2000, np.uint16)


@pytest.mark.parametrize(
    "samples",
    [samples_of(SETUP, (0, 5))[1], samples_of(SETUP, count=25)[1], STILL, 0 * STILL, ~(0 * STILL)],
    ids=["too level", "too few", "still", "dark", "bright"],
)
def test_too_few_clear_pixels_are_an_error(samples):
    with pytest.raises(InputError, match=r"too few pixels are steep and clear .*: give it, such as 2\.5deg"):
        estimate(samples, SETUP)
