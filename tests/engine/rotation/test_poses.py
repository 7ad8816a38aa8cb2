"""Normals from any known poses, compared with the Cramer-Rao bound, and with a turn."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.io.base.types import body_axes
from mirrorskin.twin import Camera, Leaning, Plane, Twin

GAIN, OFFSET, NOISE = 500.0, 40.0, 1.5
COUNT, SHAPE = 48, (60, 70)
FRAME = np.arange(COUNT)
PHASE = FRAME * 2 * np.pi / 12
GROWING = np.radians(2.5) * (FRAME + 1) / COUNT
ROCKING = np.radians(2.5) * np.sin(0.385 * FRAME)
PRESS = 1.5 * (FRAME + 1) / COUNT
NORMALS = rotations.random_normals(SHAPE[0] * SHAPE[1], seed=7, bins=[(4, 50)])[0].reshape(*SHAPE, 3)
EXACT = io.Header("axial", **rotations.EXACT)
SCALE = {"zenith_gain": GAIN, "zenith_offset": OFFSET, "blur": 0.0, "header": EXACT}


def shown(axes, resting=False, seed=5):
    """Frames that show the normals, and the sheet at rest where they are out of contact."""
    zenith = np.arccos(np.clip(np.einsum("ki,hwi->khw", axes, NORMALS), -1, 1))
    counts = OFFSET + GAIN * np.where(resting, 0.0, zenith)
    return (counts + np.random.default_rng(seed).normal(0, NOISE, counts.shape)).astype(np.float32)


def information(axes, directions, visible=1.0):
    """Fisher's information of the samples on moves of the normal along directions, (H, W, n, n), 1/rad^2."""
    cosine = np.einsum("ki,hwi->khw", axes, NORMALS)
    growth = np.einsum("ki,nhwi->nkhw", axes, directions) / np.sqrt(1 - cosine**2)
    return np.einsum("mkhw,nkhw,khw->hwmn", growth, growth, np.broadcast_to(visible, cosine.shape)) * (
        (GAIN / NOISE) ** 2
    )


def bound(axes, visible=1.0):
    """The least mean square angle of an unbiased estimate."""
    covariance = np.linalg.inv(information(axes, np.stack(rotations.tangents(NORMALS)), visible))
    return np.trace(covariance, axis1=-2, axis2=-1)


def angle(result):
    return np.arccos(np.clip(np.sum(result.normals * NORMALS, axis=-1, dtype=float), -1, 1))


def test_a_growing_precession_reaches_the_bound_with_true_errors():
    axes = body_axes(PHASE, GROWING)
    result = engine.estimate_normals(shown(axes), PHASE, tilt=GROWING, **SCALE)
    error = angle(result)
    assert np.sqrt(np.sum(error**2) / np.sum(bound(axes))) < 1.05
    assert np.mean((error / result.normals_sigma) ** 2) == pytest.approx(1, abs=0.06)
    assert result.process["noise"] == pytest.approx(NOISE, rel=0.02)
    assert (result.status == 1).all()
    assert result.contact.mean() > 0.99


def test_a_turn_is_one_case_of_poses():
    tilt = np.radians(2.5)
    frames = shown(body_axes(PHASE[:12], tilt))[:12]
    turn = engine.estimate_normals(frames, PHASE[:12], tilt=tilt, noise=NOISE, **SCALE)
    poses = engine.estimate_normals(frames, axis=body_axes(PHASE[:12], tilt), noise=NOISE, **SCALE)
    np.testing.assert_allclose(poses.normals, turn.normals, atol=3e-4)
    for name in ("normals_sigma", "mean", "cosine", "sine", "residual"):
        np.testing.assert_allclose(getattr(poses, name), getattr(turn, name), rtol=2e-3, atol=2e-3)
    np.testing.assert_array_equal(poses.contact, turn.contact)


@pytest.mark.parametrize(("direction", "middle"), [(0.0, 0.0), (0.6, np.radians(5)), (2.9, 0.0)])
def test_rocking_determines_the_slope_along_it_at_the_bound_and_nothing_across(direction, middle):
    phase = np.full(COUNT, direction)
    axes = body_axes(phase, ROCKING + middle)
    result = engine.estimate_normals(shown(axes), phase, tilt=ROCKING + middle, **SCALE)
    along = np.array(
        [np.cos(result.process["slope_direction"]), np.sin(result.process["slope_direction"]), 0.0]
    )
    assert np.isclose((result.process["slope_direction"] - direction + 0.1) % np.pi, 0.1)
    p, q = NORMALS @ along, NORMALS[..., 2]
    error = result.slope + p / q
    parts = np.broadcast_to(np.stack([along, [0, 0, 1.0]])[:, None, None], (2, *SHAPE, 3))
    growth = np.stack([-1 / q, p / q**2], axis=-1)
    best = np.einsum("hwi,hwij,hwj->hw", growth, np.linalg.inv(information(axes, parts)), growth)
    assert np.sqrt(np.sum(error**2) / np.sum(best)) < 1.05
    assert np.mean((error / result.slope_sigma) ** 2) == pytest.approx(1, abs=0.06)
    assert np.sqrt(np.mean((result.zenith - np.arccos(q)) ** 2)) < 4 * NOISE / GAIN / np.sqrt(COUNT)
    assert (result.status == 4).all()
    assert result.normals is result.normals_sigma is result.azimuth is None


@pytest.mark.parametrize("direction", [0.0, 0.3, 1.0, 3.0, np.pi - 1e-9, -1e-12])
def test_rocking_of_several_windows_uses_all_frames(direction):
    """The direction of a window differs from that of the first by rounding."""
    axes = body_axes(np.full(COUNT, direction), ROCKING)
    run = engine.Run(engine.rotation.MovingNormals(**SCALE, longest=16))
    run.push(shown(axes), pose=axes)
    assert run.result().process["frames"] == COUNT


def test_two_phases_half_a_turn_apart_rock():
    phase = np.pi * (FRAME % 2) + 0.3
    frames = shown(body_axes(phase, np.radians(2.5)))
    result = engine.estimate_normals(frames, phase, tilt=np.radians(2.5), **SCALE)
    assert (result.status == 4).all()
    assert result.process["slope_direction"] == pytest.approx(0.3)


def test_a_spiral_into_the_object_uses_the_frames_in_contact():
    depth = np.random.default_rng(8).uniform(0.1, 1.2, SHAPE)
    axes, resting = body_axes(PHASE, GROWING), PRESS[:, np.newaxis, np.newaxis] < depth
    result = engine.estimate_normals(
        shown(axes, resting), PHASE, tilt=GROWING, travel=PRESS, noise=NOISE, **SCALE
    )
    error, best = angle(result), bound(axes, ~resting)
    assert np.sqrt(np.sum(error**2) / np.sum(best)) < 1.05
    assert np.mean((error / result.normals_sigma) ** 2) == pytest.approx(1, abs=0.1)
    assert result.contact.mean() > 0.97
    with pytest.warns(io.MirrorskinWarning, match="the brightness changes at no pixel"):
        never = engine.estimate_normals(
            shown(axes, np.True_), PHASE, tilt=GROWING, travel=PRESS, noise=NOISE, **SCALE
        )
    assert (never.status == 2).all()
    assert np.isnan(never.normals).all()


def test_more_than_a_window_of_frames_is_joined():
    frame = np.arange(130)
    lean = np.radians(2.5) * np.sin(0.385 * frame)
    axes = body_axes(np.zeros(130), lean)
    result = engine.estimate_normals(shown(axes), axis=axes, noise=NOISE, **SCALE)
    assert (result.process["turns"], result.process["frames"]) == (3, 130)
    slope = -NORMALS[..., 0] / NORMALS[..., 2]
    assert np.mean(((result.slope - slope) / result.slope_sigma) ** 2) == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize(
    ("where", "line"),
    [
        ({"axis": np.tile([0, 0, 1.0], (COUNT, 1))}, "same tilt and phase: they determine no slope"),
        ({"axis": np.ones((COUNT, 3))}, "a unit vector each is needed"),
        ({"axis": np.eye(3)[[2, 2, 2]]}, r"pose has shape \(3, 4\) for 48 frames"),
        ({"phase": PHASE, "tilt": GROWING[:5]}, r"tilt has shape \(5,\) for 48 frames"),
        ({"phase": PHASE, "tilt": np.full(COUNT, 0.6)}, "tilt 34.3.* deg at frame 0: 30 deg at most"),
        ({"tilt": GROWING}, "poses are a phase and a tilt of each frame, or an axis"),
        ({"phase": PHASE, "tilt": GROWING, "axis": body_axes(PHASE, 0.1)}, "give one of both"),
        ({"phase": PHASE, "tilt": GROWING, "travel": np.full(COUNT, np.nan)}, "travel is not finite"),
        ({"phase": PHASE}, "tilt is missing"),
        (
            {"axis": body_axes(np.arctan2(ROCKING, 0.2), np.hypot(ROCKING, 0.2))},
            "axes lie in a plane that is not upright",
        ),
    ],
)
def test_poses_that_determine_nothing_are_one_line(where, line):
    with pytest.raises(io.InputError, match=line) as caught:
        engine.estimate_normals(np.zeros((COUNT, 3, 4), np.float32), noise=NOISE, **where, **SCALE)
    assert "\n" not in str(caught.value)


PLANE = Plane(np.radians(24), 0.7, 2.0)


def recorded(movement, tmp_path):
    """A twin's recording of a plane, opened again."""
    twin = Twin(
        object=PLANE,
        shape=(44, 44),
        pixel_size=0.08,
        movement=movement,
        pattern="linear",
        camera=Camera(np.uint16, noise=2.0, seed=3),
    )
    with io.Recorder(twin, tmp_path / "a.h5", truth=lambda: twin.truth) as recorder:
        recorder.drain(lambda count: None)
    return twin, io.open_recording(tmp_path / "a.h5")


def test_a_rocked_recording_gives_its_slope(tmp_path):
    twin, recording = recorded(Leaning(np.full(COUNT, 0.5), ROCKING, 0.8), tmp_path)
    with recording:
        np.testing.assert_allclose(recording.tilt, ROCKING)
        assert recording.header.tilt is None
        result = engine.reconstruct(recording)
    slope = -np.tan(PLANE.zenith) * np.cos(PLANE.azimuth - result.process["slope_direction"])
    answered = result.contact == 1
    assert answered.sum() > 600
    assert np.mean(((result.slope - slope) / result.slope_sigma)[answered] ** 2) == pytest.approx(1, abs=0.15)
    assert np.all(result.status[answered] == 4)
    assert result.normals is None
    assert result.height is None
    live = engine.reconstruct(twin)
    np.testing.assert_array_equal(live.slope, result.slope)
    io.save_result(result, tmp_path / "r.h5")
    np.testing.assert_array_equal(io.open_result(tmp_path / "r.h5").slope, result.slope)


def test_a_recorded_spiral_gives_normals_and_heights(tmp_path):
    _, recording = recorded(Leaning(PHASE, GROWING, PRESS), tmp_path)
    with recording:
        np.testing.assert_allclose(recording.travel, PRESS)
        assert recording.header.press is None
        result = engine.reconstruct(recording, blur=0.0)
        with pytest.raises(io.InputError, match="registering frames with heights needs one tilt"):
            engine.reconstruct(recording, heights=np.zeros((44, 44)))
        with pytest.raises(io.InputError, match="method 'paper' needs one tilt"):
            engine.reconstruct(recording, method="paper")
    normal = rotations.direction(PLANE.zenith, PLANE.azimuth)
    error = np.arccos(np.clip(result.normals @ normal, -1, 1))
    answered = result.contact == 1
    assert answered.sum() > 900
    assert np.mean((error / result.normals_sigma)[answered] ** 2) == pytest.approx(1, abs=0.2)
    assert np.isfinite(result.height[answered]).all()
    assert set(np.unique(result.status)) <= {1, 2}
