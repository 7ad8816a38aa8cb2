"""Normals under a wall: the reference compared with simple searches and rays, and the kernel with it."""

import math

import numpy as np
import pytest
import walls
from scipy import optimize
from walls import PHASE, TILT, facing, light_of

from mirrorskin.engine.correlation.design_matrix import fit_matrix
from mirrorskin.engine.rotation.response import make_response
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.kernels.rotation.normals import Variance, contact_limits
from mirrorskin.kernels.rotation.normals_wall import _places, _rotations, normals_wall
from mirrorskin.kernels.rotation.response import wall_light

DARK, BRIGHT = 10.0, 240.0


def turn_of(phase=PHASE, weights=None):
    weights = np.ones(len(phase)) if weights is None else np.asarray(weights)
    return np.stack([np.cos(phase), np.sin(phase), np.sqrt(weights), *fit_matrix(phase, weights)])


class Scene:
    """Mirrors of all directions all over a picture, and the counts that they make."""

    def __init__(self, shape=(20, 31), follows=False, gamma=1.0, zenith=(16, 42), phase=PHASE, seed=1):
        rng = np.random.default_rng(seed)
        axes = np.linspace(-7, 7, shape[1]), np.linspace(5, -5, shape[0])
        self.shape, self.phase, self.rng = shape, phase, rng
        self.heights = rng.uniform(0, 1.2, shape)
        wall = walls.response(shape, gamma)
        setting = wall, DARK, BRIGHT, axes, self.heights, walls.PIVOT, follows
        self.response = make_response(*setting)
        self.scale = self.response.planes.reshape(5, -1).astype(np.float64)
        pixels = shape[0] * shape[1]
        angles = np.radians(rng.uniform(*zenith, pixels)), rng.uniform(-np.pi, np.pi, pixels)
        self.normals = facing(*angles)
        turning, _ = _rotations(turn_of(phase), TILT)
        turned = np.einsum("kij,nj->kni", turning, self.normals)
        place, wall = _places(self.scale, turning, self.response.wall), self.response.wall
        self.light, within = wall_light(place, turned, wall.geometry, wall.lamps, wall.curve, wall.reach)
        self.within = within.all(axis=0)

    def frames(self, noise, dtype="float32"):
        counts = self.light / self.scale[1] + self.scale[0] + noise * self.rng.normal(size=self.light.shape)
        if dtype == "float32":
            return counts.astype(np.float32)
        return np.clip(np.rint(counts), 0, np.iinfo(dtype).max).astype(dtype)

    def answer(self, frames, noise, weights=None):
        noise, limits = Variance(noise**2, 0.0, noise**2), contact_limits(len(frames) - 3, TILT)
        turn = turn_of(self.phase, weights)
        return normals_wall(frames, turn, self.scale, self.response.wall, TILT, noise, limits)


def off(actual, true):
    return np.linalg.norm(actual - true, axis=1)


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("follows", [False, True])
def test_without_noise_the_normal_is_the_true_one(gamma, follows):
    scene = Scene(follows=follows, gamma=gamma)
    result = scene.answer(scene.frames(0.0).astype(np.float64), 1e-4)
    assert scene.within.mean() > 0.8
    assert np.max(off(result.vectors, scene.normals)[scene.within]) < 1e-4
    assert np.median(off(result.vectors, scene.normals)[scene.within]) < 1e-6
    assert result.contact[scene.within].all()


def test_the_reference_finds_the_likeliest_normal():
    scene = Scene((1, 6))
    noise = 2.0
    frames = scene.frames(noise)
    result = scene.answer(frames, noise)
    samples = (frames - scene.scale[0]) * scene.scale[1]
    for pixel in np.flatnonzero(scene.within)[:2]:

        def misfit(angles, pixel=pixel):
            setting = scene.response.wall.curve, *scene.scale[2:, [pixel]], facing(*np.array(angles))
            return [
                sample - light_of(*setting, at, follows=False)[0]
                for sample, at in zip(samples[:, pixel], PHASE, strict=True)
            ]

        vector = scene.normals[pixel]
        start = math.acos(vector[2]), math.atan2(vector[1], vector[0])
        best = optimize.least_squares(misfit, start, x_scale=(0.01, 0.1), diff_step=1e-5).x
        assert off(result.vectors[[pixel]], facing(*best)[np.newaxis])[0] < 0.02 * result.sigma[pixel]


def test_samples_beyond_the_ends_of_the_wall_contain_no_information_and_do_no_harm():
    scene = Scene((40, 61), zenith=(14, 43))
    noise = 0.5
    result = scene.answer(scene.frames(noise), noise)
    some = ~scene.within & np.isfinite(result.sigma)
    assert some.sum() > 100
    error = off(result.vectors, scene.normals)[some] / result.sigma[some]
    assert np.median(error) < 1.5


def test_a_pixel_that_does_not_follow_the_object_is_not_a_contact():
    scene = Scene((2, 40))
    frames = scene.frames(0.0)
    frames[:, :40] = frames[:1, :40]  # still
    frames[:, 40:60] = DARK
    frames += 0.5 * scene.rng.normal(size=frames.shape).astype(np.float32)
    result = scene.answer(frames, 0.5)
    assert not result.contact[:60].any()
    assert np.isnan(result.sigma[40:60]).all()
    assert result.contact[60:][scene.within[60:]].all()


# Each is a kernel of its own, and takes its time to be built.
CASES = {
    "uint8": ("uint8", (7, 31), {}, None),
    "float32, follows, weights, missing": (
        "float32",
        (5, 9),
        {"follows": True, "gamma": 2.2},
        [1, 2, 3, 0.3, 1, 1, 1, 0.5],
    ),
    "uint16, one pixel, 3 frames": (
        "uint16",
        (1, 1),
        {"phase": np.array([0.2, 2.1, 4.4]), "zenith": (30, 31)},
        None,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_kernel_and_reference_agree(device, case):
    dtype, shape, options, weights = CASES[case]
    scene = Scene(shape, **({"zenith": (20, 50)} | options))
    noise = 0.4
    frames = scene.frames(noise, dtype)
    if dtype == "float32":
        frames[scene.rng.random(frames.shape) < 0.02] = np.nan
    expected = scene.answer(frames, noise, weights)
    stack = frames.reshape(-1, *shape)
    arguments = {"response": scene.response, "noise": noise, "frame_weights": weights, "device": device}
    result = rotations.estimate(stack, scene.phase, tilt=TILT, **arguments)
    finite = np.isfinite(result.normals_sigma.ravel())
    # A sample at the very end of the wall may fall on either side.
    assert np.mean(finite != np.isfinite(expected.sigma)) <= 0.01
    assert finite.any()
    both = finite & np.isfinite(expected.sigma)
    error = off(result.normals.reshape(-1, 3)[both], expected.vectors[both])
    assert np.quantile(error / expected.sigma[both], 0.98) < 1e-2
    close = np.abs(result.normals_sigma.ravel()[both] / expected.sigma[both] - 1) < 1e-3
    assert close.mean() > 0.98
    assert np.mean(result.contact.ravel()[both] == expected.contact[both]) > 0.98
    for name in ("mean", "cosine", "sine", "residual"):
        np.testing.assert_allclose(getattr(result, name).ravel(), getattr(expected, name), 2e-5, 2e-4)
