"""The tests' own formulas of axial rotations (evaluation/scenes/rotations.py), compared with simpler ones."""

from dataclasses import replace

import numpy as np
import poses
import pytest
from scipy import integrate, stats

from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, SETUPS, TILT, UNEVEN, Setup

SHARP = Setup(gain=5.0, noise=0.0, offset=10.0, dtype="float32")


@pytest.mark.parametrize("phase", [EIGHTHS, UNEVEN])
def test_a_level_is_that_of_the_matrices_of_a_leaning_body(phase):
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
        (
            rotations.levels(normals + step * direction, setup)
            - rotations.levels(normals - step * direction, setup)
        )
        for direction in (right, up)
    ]
    rows = np.stack(rows, axis=-1) / (2 * step * setup.spread)
    information = np.einsum("k...a,k...b->...ab", rows, rows)
    np.testing.assert_allclose(rotations.information(normals, setup), information, rtol=1e-5, atol=1e-3)
    expected = np.trace(np.linalg.inv(information), axis1=-2, axis2=-1)
    np.testing.assert_allclose(rotations.bound(normals, setup), expected, rtol=1e-5)


@pytest.mark.parametrize("z", [-1.0, 0.5, 5.0])
def test_clipped_samples_have_the_estimate_of_the_likelihood(z):
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
