"""Normals and slopes at any known poses: the kernel compared with its reference."""

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.engine.rotation.poses import check_poses, pose_fit
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.io.base.types import body_axes
from mirrorskin.kernels.rotation import normals_pose
from mirrorskin.kernels.rotation.normals import Variance, contact_limits

COUNT, OFFSET, NOISE = 40, 60.0, 1.5
GAINS = {"uint8": 190.0, "uint16": 500.0, "float32": 500.0}  # of the first, some samples are clipped
FRAME = np.arange(COUNT)
SPIRAL = {"phase": 0.55 * FRAME, "tilt": np.radians(3) * (FRAME + 4) / COUNT}
ROCK = {"phase": np.full(COUNT, 0.7), "tilt": np.radians(3) * np.sin(0.4 * FRAME)}
PRESS = 1.2 * (FRAME + 1) / COUNT
POSES = {"spiral": SPIRAL, "rock": ROCK}
DEVIATIONS = 0.02  # of a standard error, within which kernels and reference agree


def made_frames(where, dtype, pixels=61, pressed=False, seed=3):
    """Frames of normals of all directions, some samples clipped or missing, and the fit of their poses."""
    random = np.random.default_rng(seed)
    normals = rotations.random_normals(pixels, seed=seed, bins=[(4, 58)])[0]
    zenith = np.arccos(np.clip(body_axes(**where) @ normals.T, -1, 1))
    if pressed:
        zenith[PRESS[:, np.newaxis] < random.uniform(-0.2, 0.9, pixels)] = 0.0
    frames = OFFSET + GAINS[dtype] * zenith + random.normal(0, NOISE, zenith.shape)
    pose = check_poses(COUNT, **where, travel=PRESS if pressed else None)
    if dtype == "float32":
        frames[5:9, ::7] = np.nan
        return frames.astype(dtype), pose
    return np.clip(np.rint(frames), 0, np.iinfo(dtype).max).astype(dtype), pose


def reference(frames, pose, weights, gain):
    fit = pose_fit(pose, weights)
    scale = np.array([OFFSET, 1 / gain, -np.inf, np.inf])
    answer = normals_pose.normals_pose if fit.direction is None else normals_pose.normals_rock
    return answer(
        frames,
        fit.table.astype(float),
        scale,
        fit.tilt,
        Variance(NOISE**2, 0.0, NOISE**2),
        contact_limits(len(frames) - 3, fit.tilt),
        fit.presses,
    )


@pytest.mark.parametrize("pressed", [False, True], ids=["", "pressed"])
@pytest.mark.parametrize("dtype", list(GAINS))
@pytest.mark.parametrize("name", POSES)
def test_kernel_and_reference_agree(device, name, dtype, pressed):
    frames, pose = made_frames(POSES[name], dtype, pressed=pressed)
    weights = np.random.default_rng(1).uniform(0.5, 2, COUNT)
    operation = engine.rotation.MovingNormals(
        zenith_gain=GAINS[dtype], zenith_offset=OFFSET, noise=NOISE, blur=0.0, device=device
    )
    run = engine.Run(operation)
    run.push(frames[:, np.newaxis], pose=pose, frame_weights=weights)
    result, expected = run.result(), reference(frames, pose, weights, GAINS[dtype])
    if name == "spiral":
        close = np.linalg.norm(result.normals[0] - expected.vectors, axis=1) < DEVIATIONS * expected.sigma
        sigma, reference_sigma = result.normals_sigma[0], expected.sigma
    else:
        sigma, reference_sigma = result.slope_sigma[0], expected.sigma
        close = np.abs(result.slope[0] - expected.slope) < DEVIATIONS * expected.sigma
        np.testing.assert_allclose(result.zenith[0], expected.zenith, atol=2e-4)
    finite = np.isfinite(reference_sigma)
    assert finite.mean() > 0.9
    assert close[finite].all()
    np.testing.assert_array_equal(np.isfinite(sigma), finite)
    np.testing.assert_allclose(sigma[finite], reference_sigma[finite], rtol=0.01)
    np.testing.assert_array_equal(result.contact[0], expected.contact)
    assert expected.contact.mean() > 0.9
