"""The tests' own book on axial rotations (tests/support/rotations.py), held against plainer ones."""

from dataclasses import replace

import numpy as np
import poses
import pytest
import rotations
from rotations import EIGHTHS, SETUPS, TILT, UNEVEN, Setup
from scipy import integrate, stats
from scipy.optimize import least_squares

SHARP = Setup(gain=5.0, noise=0.0, offset=10.0, dtype="float32")


def shadow(parameters):
    """Any point of the upper hemisphere, by where it is over the picture."""
    x, y = parameters
    return np.array([x, y, np.sqrt(max(1 - x * x - y * y, 1e-12))])


def most_likely(samples, setup):
    """Search for the normal of which the samples are the likeliest, from two places."""
    axes = rotations.axes(setup.phase, setup.tilt)

    def misfit(parameters):
        return setup.offset + setup.slope * np.arccos(np.clip(axes @ shadow(parameters), -1, 1)) - samples

    told = rotations.paper(samples, setup)
    guess = np.sin(told.zenith) * np.array([np.cos(told.azimuth), np.sin(told.azimuth)])
    found = [least_squares(misfit, start, method="lm") for start in (guess, guess / 3)]
    return shadow(min(found, key=lambda one: one.cost).x)


@pytest.mark.parametrize("phase", [EIGHTHS, UNEVEN])
def test_a_level_is_what_the_matrices_of_a_leaning_body_say(phase):
    setup = replace(SHARP, phase=phase)
    normals = rotations.random_normals(20, seed=1)
    for level, angle in zip(rotations.levels(normals, setup), phase, strict=True):
        turned = poses.leaning(angle, TILT, press=0.0).turn
        zenith, _ = poses.angles(normals @ turned.T)
        np.testing.assert_allclose((level - setup.offset) / setup.slope, zenith, atol=1e-12)


def test_the_bound_is_that_of_differences():
    setup = replace(SETUPS["uint8"], phase=UNEVEN)
    normals = rotations.random_normals(6, seed=4)
    step = 1e-6
    right, up = rotations.tangents(normals)
    rows = [
        (rotations.levels(normals + step * way, setup) - rotations.levels(normals - step * way, setup))
        for way in (right, up)
    ]
    rows = np.stack(rows, axis=-1) / (2 * step * setup.spread)
    told = np.einsum("k...a,k...b->...ab", rows, rows)
    np.testing.assert_allclose(rotations.information(normals, setup), told, rtol=1e-5, atol=1e-3)
    expected = np.trace(np.linalg.inv(told), axis1=-2, axis2=-1)
    np.testing.assert_allclose(rotations.bound(normals, setup), expected, rtol=1e-5)


@pytest.mark.parametrize("noise", [1.0])
def test_rounding_adds_a_twelfth_to_the_square_of_the_noise(noise):
    counts = np.arange(-20, 21)
    information = []
    for mean in np.linspace(0, 1, 11):
        step = 1e-4
        chance = [
            np.diff(stats.norm.cdf(np.arange(-20.5, 21), mean + change, noise)) for change in (-step, 0, step)
        ]
        slope = (chance[2] - chance[0]) / (2 * step)
        information.append(np.sum(slope**2 / np.maximum(chance[1], 1e-300)))
    assert len(counts) == len(slope)
    expected = 1 / replace(SETUPS["uint8"], noise=noise).spread ** 2
    np.testing.assert_allclose(information, expected, rtol=0.01)
    assert np.mean(information) == pytest.approx(expected, rel=0.003)


@pytest.mark.parametrize("z", [-1.0, 0.5, 5.0])
def test_what_clipping_leaves_is_what_the_likelihood_tells(z):
    inside, _ = integrate.quad(lambda x: x**2 * stats.norm.pdf(x), -20, z)
    beyond = stats.norm.sf(z)
    expected = inside + stats.norm.pdf(z) ** 2 / beyond
    normal = rotations.direction(0.5, 0.0)
    level = rotations.levels(normal, SHARP)[0]
    noisy = replace(SHARP, noise=2.0)
    clipped = replace(noisy, high=level + 2 * z)
    assert rotations.clipped_share(normal, clipped)[0] == pytest.approx(expected, abs=1e-9)
    mirrored = replace(noisy, low=level - 2 * z)
    assert rotations.clipped_share(normal, mirrored)[0] == pytest.approx(expected, abs=1e-9)
    np.testing.assert_array_equal(rotations.clipped_share(normal, noisy), 1.0)


def test_the_paper_knows_the_azimuth_and_its_mean_is_off_as_the_errata_say():
    zenith, azimuth = np.radians(10), 2.0
    told = rotations.paper(rotations.levels(rotations.direction(zenith, azimuth), SHARP), SHARP)
    assert told.zenith - zenith == pytest.approx(TILT**2 / 4 / np.tan(zenith), rel=0.03)
    assert np.degrees(told.zenith - zenith) == pytest.approx(0.16, abs=0.01)
    assert told.azimuth == pytest.approx(azimuth, abs=1e-4)
    assert told.modulation == pytest.approx(TILT, rel=0.01)
    flat = rotations.paper(rotations.levels(rotations.direction(0.0, 0.0), SHARP), SHARP)
    assert flat.zenith == pytest.approx(TILT)


@pytest.mark.parametrize("zenith", [2.5, 30.0])
def test_the_likeliest_normal_reaches_the_bound(zenith):
    stack = rotations.draw(SETUPS["uint8"], 160, seed=5, bins=[(zenith, zenith)])
    found = [most_likely(samples, stack.setup) for samples in stack.frames[:, 0].T.astype(float)]
    told = rotations.scores(np.array([found]), np.sqrt(stack.bound), stack)
    # The mean of 160 squares of which most is one number's is known to 11 percent, its root to half of that.
    assert told.ratio[0] == pytest.approx(1, abs=0.16)
    assert told.chi_square[0] == pytest.approx(told.ratio[0] ** 2, rel=0.01)
    assert np.abs(rotations.mean_error(np.array([found]), stack)).max() < 4


def test_the_scorer_sees_a_bias_a_wrong_sigma_and_a_missing_answer():
    stack = rotations.draw(SETUPS["uint8"], 4000, seed=6, bins=[(30, 30), (1, 1)])
    right, up = rotations.tangents(stack.normals)
    noise = np.random.default_rng(0).normal(0, 1e-3, (2, *stack.bound.shape, 1))
    found = stack.normals + right * noise[0] + up * noise[1]
    sigma = np.full(stack.bound.shape, 1e-3 * np.sqrt(2))
    told = rotations.scores(found, sigma, stack)
    np.testing.assert_allclose(told.rms, sigma[:, 0], rtol=0.03)
    np.testing.assert_allclose(told.chi_square, 1, atol=0.06)
    np.testing.assert_allclose(rotations.scores(found, 2 * sigma, stack).chi_square, told.chi_square / 4)
    assert np.abs(rotations.mean_error(found, stack)).max() < 4
    zenith, azimuth = rotations.angles(found)
    for moved in (
        rotations.direction(zenith + 2e-4, azimuth),
        rotations.direction(zenith, azimuth + 2e-4 / np.sin(zenith)),
    ):
        assert np.all(np.abs(rotations.mean_error(moved, stack)).max(axis=1) > 4)
    found[0, 7] = np.nan
    assert np.isnan(rotations.scores(found, sigma, stack).ratio[0])


def test_the_bound_of_the_tilt_is_that_of_the_likeliest_tilt():
    setup = replace(SETUPS["float32"], noise=0.5)
    normals = rotations.random_normals(30, seed=7, bins=[(10, 40)])
    sigma = rotations.tilt_bound(normals, setup)
    # Far from the axis only the amplitude tells of the tilt: eight samples, thirty times.
    assert sigma == pytest.approx(setup.spread / setup.slope / np.sqrt(8 / 2 * 30), rel=0.03)
