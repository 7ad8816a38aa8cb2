"""Slopes rotated about the axis of the camera are found by their curl, and rotated back."""

from functools import cache

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.diagnosis.curl import find_azimuth_bias
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import Setup
from mirrorskin.io.files.arrays import ArrayRecording

SHAPE, PIXEL = (60, 80), (0.05, 0.06)
PHASE = np.arange(16) * np.pi / 8
SETUP = Setup(noise=1.2, offset=20.0, phase=tuple(PHASE))


WAVES = rotations.waves(SHAPE, PIXEL)


def rotated(degrees):
    """Return the normals, rotated by angles, one or one of each row."""
    angle = np.broadcast_to(np.radians(degrees), SHAPE[0])[:, np.newaxis]
    x, y, z = np.moveaxis(WAVES, -1, 0)
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)


def noisy(normals, sigma=0.02):
    normals = normals + np.random.default_rng(1).normal(0, sigma, normals.shape)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def error_of(normals):
    return find_azimuth_bias(normals, np.ones(SHAPE, np.uint8), PIXEL)


@cache
def rolled():
    """Return a rotation seen by a rolling shutter: the last row a frame after the first."""
    light = rotations.levels(rotated(-np.linspace(0, 22.5, SHAPE[0])), SETUP)
    counts = np.rint(light + np.random.default_rng(2).normal(0, 1.2, light.shape))
    header = {"tilt": SETUP.tilt, "zenith_gain": SETUP.slope, "zenith_offset": 20.0, "pixel_size": PIXEL}
    source = ArrayRecording(counts.clip(0, 255).astype(np.uint8), {"phase": PHASE}, header)
    with pytest.warns(io.MirrorskinWarning, match="as by a rolling shutter, which is corrected"):
        return engine.reconstruct(source, blur=0.0)


@pytest.mark.parametrize("degrees", [-20, 3, 12])
def test_the_angle_of_slopes_that_are_rotated_is_found(degrees):
    angle = error_of(noisy(rotated(degrees)))
    assert np.degrees([angle.first, angle.last]) == pytest.approx([degrees, degrees], abs=0.4)


def test_a_rotation_that_grows_from_row_to_row_is_found():
    angle = error_of(noisy(rotated(np.linspace(2, 20, SHAPE[0]))))
    assert np.degrees([angle.first, angle.last]) == pytest.approx([2, 20], abs=1)


def test_slopes_of_a_surface_are_not_rotated():
    assert error_of(noisy(WAVES)) is None


def test_slopes_without_curvature_show_no_rotation():
    plate = np.broadcast_to(rotations.direction(np.radians(20), 0.3), (*SHAPE, 3))
    assert error_of(noisy(plate)) is None


def test_few_slopes_show_no_rotation():
    assert find_azimuth_bias(rotated(12), np.eye(*SHAPE, dtype=np.uint8), PIXEL) is None


def test_normals_seen_by_a_rolling_shutter_have_the_errors_that_they_state():
    result = rolled()
    error = np.linalg.norm(np.cross(result.normals.astype(float), WAVES), axis=-1)
    assert 0.8 < np.mean((error / result.normals_sigma) ** 2) < 1.3  # 17 without


def test_the_angles_are_stated():
    assert (
        "azimuths are wrong by +0.2 degrees in the first row and -21.6 in the last"
        in rolled().process["warnings"]
    )


def test_azimuths_are_those_of_the_corrected_normals():
    result = rolled()
    azimuth = np.arctan2(result.normals[..., 1], result.normals[..., 0])
    np.testing.assert_array_equal(result.azimuth, azimuth)
