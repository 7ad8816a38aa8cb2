"""The tilt: what a body can lean, and what is told of it by the amplitude of the zenith's wave."""

from dataclasses import replace

import numpy as np
import pytest
import rotations
from rotations import EIGHTHS, TILT, UNEVEN, Setup

from mirrorskin.engine.rotation.design_matrix import turn_fit
from mirrorskin.engine.rotation.residual_noise import CountNoise
from mirrorskin.engine.rotation.tilt import check_tilt, estimate_tilt, one_wave, zenith_seen
from mirrorskin.io import InputError

SETUP = Setup(gain=60.0, noise=20.0, offset=150.0, dtype="uint16")
OPEN = [-np.inf, np.inf]


def told(samples, setup, weights=None, ends=OPEN):
    """Estimate with what the lab knows."""
    phase = np.array(setup.phase)
    weight = np.ones(len(phase)) if weights is None else np.array(weights)
    scale = np.array([setup.offset, 1 / setup.slope, *ends])
    noise = CountNoise(setup.spread**2, 0.0, setup.spread**2)
    return estimate_tilt(samples, turn_fit(phase, weight), scale, noise)


def samples_of(setup, zenith=(0, 55), count=400, seed=1):
    normals = rotations.random_normals(count, seed, bins=[zenith])[0]
    return normals, rotations.expose(normals, setup, seed)


@pytest.mark.parametrize("degrees", [1e-3, 2.5, 30.0])
def test_a_body_can_lean_up_to_30_degrees(degrees):
    assert check_tilt(np.radians(degrees)) == np.radians(degrees)


@pytest.mark.parametrize("degrees", [0.0, -2.5, 30.1, 40.0, np.nan, np.inf])
def test_a_tilt_that_cannot_be_is_refused(degrees):
    with pytest.raises(InputError, match=rf"tilt {degrees:g} deg: above 0 and up to 30 deg is needed"):
        check_tilt(np.radians(degrees))


def test_the_zenith_seen_is_the_angle_to_the_axis():
    zenith, azimuth = np.radians([0, 1e-6, 2.5, 2.5, 20, 60]), np.array([0.0, 1, np.pi, 2, -3, 4])
    expected = [
        rotations.between(rotations.direction(zenith, azimuth), axis) for axis in rotations.axes(UNEVEN, TILT)
    ]
    found = zenith_seen(zenith, azimuth, np.array(UNEVEN), TILT)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("degrees", [0.5, 2.5, 10.0])
@pytest.mark.parametrize("phase", [EIGHTHS, UNEVEN, EIGHTHS[::2], EIGHTHS[:3]])
def test_the_tilt_is_told_within_its_error(degrees, phase):
    setup = replace(SETUP, tilt=np.radians(degrees), noise=5 * degrees, phase=phase)
    normals, samples = samples_of(setup)
    error = rotations.tilt_bound(normals, setup)
    assert error < 0.02 * setup.tilt
    assert told(samples, setup) == pytest.approx(setup.tilt, abs=4 * error)


def test_noise_as_large_as_the_tilt_is_no_bias():
    setup = replace(SETUP, noise=60.0, tilt=np.radians(1.0))
    normals, samples = samples_of(setup, zenith=(8, 55), count=4000)
    error = rotations.tilt_bound(normals, setup)
    assert told(samples, setup) == pytest.approx(setup.tilt, abs=4 * error)


def test_pixels_that_lose_contact_do_not_count():
    _, samples = samples_of(SETUP)
    samples[3, ::5] = 151
    samples[5:7, 1::10] = 151
    samples[:, 2::10] = 160
    assert told(samples, SETUP) == pytest.approx(TILT, rel=0.02)


def test_what_is_clipped_or_missing_or_out_of_range_does_not_count():
    setup = replace(SETUP, dtype="float32")
    _, samples = samples_of(setup)
    samples[2, ::4] = np.nan
    assert told(samples, setup) == pytest.approx(TILT, rel=0.02)
    _, samples = samples_of(SETUP)
    samples[::2, ::4] = 65535
    samples[1::2, 1::4] = 0
    assert told(samples, SETUP) == pytest.approx(TILT, rel=0.02)
    high = np.radians(30)
    _, samples = samples_of(SETUP)
    samples = np.minimum(samples, np.uint16(SETUP.offset + SETUP.slope * high))
    assert told(samples, SETUP, ends=[-np.inf, high]) == pytest.approx(TILT, rel=0.02)


def test_weights_count():
    weights = np.array([1, 1, 1, 1, 1e-4, 1, 1, 1])
    normals = rotations.random_normals(400, 1, bins=[(12, 55)])[0]
    samples = rotations.levels(normals, SETUP)
    samples += np.random.default_rng(0).normal(0, 20, samples.shape) / np.sqrt(weights)[:, np.newaxis]
    assert told(samples.astype(np.float32), SETUP, weights) == pytest.approx(TILT, rel=0.02)


def still():
    return np.full((8, 400), 2000, np.uint16)


@pytest.mark.parametrize(
    "samples",
    [samples_of(SETUP, (0, 5))[1], samples_of(SETUP, count=25)[1], still(), 0 * still(), ~(0 * still())],
    ids=["too level", "too few", "still", "dark", "bright"],
)
def test_too_little_that_tells_is_said_so(samples):
    with pytest.raises(
        InputError,
        match=r"too few pixels are steep and clear .*: give it, such as 2\.5deg",
    ):
        told(samples, SETUP)


def test_steep_and_level_pixels_are_told_apart():
    wave = np.array([[100.0, 100, 100, np.nan], [10, 40, 15, 1], [0, 30, 15, 1]])
    np.testing.assert_array_equal(one_wave(wave, np.array([10.0, 0.01, *OPEN])), [True, False, True, False])
    darker = wave * [[1], [-1], [-1]]
    scale = np.array([190.0, -0.01, *OPEN])
    np.testing.assert_array_equal(one_wave(darker, scale), [True, False, True, False])
    assert one_wave(np.array([[10.0], [0], [0]]), np.array([10.0, 0.01, *OPEN])).tolist() == [False]
