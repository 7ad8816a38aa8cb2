"""An object followed along a stream of results."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest
from moved_surfaces import Form, Map, bumpy, error_of, sampled

from mirrorskin import engine, io
from mirrorskin.kernels.device import open_device


def test_a_stream_is_followed_over_keys_with_true_errors() -> None:
    rng, tracker = np.random.default_rng(0), engine.pose.PoseTracker()
    for number in range(24):
        vector, shift = np.array([0, 0, 0.02 * number]), np.array([0.1 * number, 0.02 * number, 0])
        pose = tracker.push(sampled(bumpy, vector, shift, rng=rng))
        error = error_of(pose, vector, shift)
        if number:
            assert error @ np.linalg.solve(pose.covariance, error) / 6 < 5
    assert tracker.keys > 1


def test_a_result_that_shares_nothing_is_refused() -> None:
    rng, tracker = np.random.default_rng(1), engine.pose.PoseTracker()
    tracker.push(sampled(bumpy, rng=rng))
    with pytest.raises(io.InputError, match="share too few pixels"):
        tracker.push(sampled(bumpy, shift=(50, 0, 0), rng=rng))


def test_a_pose_waits_for_maps_that_another_queue_has_not_written_yet() -> None:
    rng, device = np.random.default_rng(1), open_device()
    results = [sampled(bumpy, shift=(0.02 * number, 0, 0), rng=rng) for number in range(3)]
    tracker, other = engine.pose.PoseTracker(), engine.pose.PoseTracker()
    for result in results[:2]:
        tracker.push(result)
        other.push(result)
    gate = cl.UserEvent(device.context)
    sources = {name: device.from_host(name, results[2][name]) for name in results[2]}
    for source in sources.values():
        source.arrived = gate
    late = {name: source.copy_region(0, source.shape) for name, source in sources.items()}
    answer = tracker.submit(io.Result(late, x=results[2].x, y=results[2].y))
    gate.set_status(cl.command_execution_status.COMPLETE)
    np.testing.assert_array_equal(answer().translation, other.push(results[2]).translation)


def circle(steps: int, radius: float) -> list[np.ndarray]:
    """Return shifts around a closed path that begins at 0."""
    angles = 2 * np.pi * np.arange(steps) / steps
    return [radius * np.array([np.sin(angle), 1 - np.cos(angle), 0]) for angle in angles]


def test_a_path_that_returns_takes_earlier_keys_again() -> None:
    rng, tracker = np.random.default_rng(2), engine.pose.PoseTracker()
    for number, shift in enumerate(circle(16, 0.8) * 3):
        tracker.push(sampled(bumpy, (0, 0, 0), shift, rng=rng))
        if number == 16:
            keys = tracker.keys
    assert 1 < tracker.keys == keys


def test_outliers_of_a_percent_of_the_pixels_change_a_pose_by_less_than_its_sigma() -> None:
    rng = np.random.default_rng(3)
    results = [sampled(bumpy, shift=(0.02 * number, 0, 0), rng=rng) for number in range(5)]
    spoilt = [
        result.assign(height=np.where(rng.random((60, 80)) < 0.01, result.height + 2.8, result.height))
        for result in results
    ]
    clean, robust = engine.pose.PoseTracker(), engine.pose.PoseTracker()
    for result, bad in zip(results, spoilt, strict=True):
        pose, other = clean.push(result), robust.push(bad)
    assert np.all(np.abs(other.translation - pose.translation) < pose.sigma[3:])


def test_a_step_too_large_to_follow_is_found_and_noted() -> None:
    rng, tracker = np.random.default_rng(4), engine.pose.PoseTracker()
    for number in range(3):
        tracker.push(sampled(bumpy, shift=(0.01 * number, 0, 0), rng=rng))
    vector, shift = (0, 0, 1.2), (0.4, -0.3, 0)
    pose = tracker.push(sampled(bumpy, vector, shift, rng=rng))
    error = error_of(pose, vector, shift)
    assert error @ np.linalg.solve(pose.covariance, error) / 6 < 5
    assert "too large to follow" in pose.notes[-1]


def test_contact_that_is_lost_is_refused_and_found_again() -> None:
    rng, tracker = np.random.default_rng(5), engine.pose.PoseTracker()
    for number in range(3):
        tracker.push(sampled(bumpy, shift=(0.02 * number, 0, 0), rng=rng))
    gone = sampled(bumpy, rng=rng)
    with pytest.raises(io.InputError, match="no usable pixel"):
        tracker.push(gone.assign(height=np.full((60, 80), np.nan, np.float32)))
    pose = tracker.push(sampled(bumpy, shift=(0.1, 0, 0), rng=rng))
    assert pose.translation == pytest.approx([0.1, 0, 0], abs=0.003)


def test_a_hole_that_moves_with_the_contact_is_left_out() -> None:
    rng, tracker = np.random.default_rng(6), engine.pose.PoseTracker()
    row, column = np.indices((60, 80))
    for number in range(6):
        result, shift = sampled(bumpy, shift=(0.02 * number, 0, 0), rng=rng), (0.02 * number, 0, 0)
        hole = np.hypot(row - 30, column - 20 - 6 * number) < 12
        pose = tracker.push(result.assign(height=np.where(hole, np.nan, result.height)))
    error = error_of(pose, (0, 0, 0), shift)
    assert error @ np.linalg.solve(pose.covariance, error) / 6 < 5


def textured(x: Map, y: Map) -> tuple[Map, Map, Map]:
    """Return the bumpy form with fine waves, which averaging of many pixels would remove."""
    height, dz_dx, dz_dy = bumpy(x, y)
    k, amplitude = 2 * np.pi / 0.5, 0.012
    return (
        height + amplitude * np.sin(k * x) * np.cos(k * y),
        dz_dx + amplitude * k * np.cos(k * x) * np.cos(k * y),
        dz_dy - amplitude * k * np.sin(k * x) * np.sin(k * y),
    )


@pytest.mark.parametrize("form", [bumpy, textured])
def test_averaging_of_large_maps_costs_a_tenth_of_the_accuracy_at_most(form: Form) -> None:
    rng, tracker, errors = np.random.default_rng(7), engine.pose.PoseTracker(), []
    size = {"shape": (240, 320), "pixel": 0.0125}
    key = sampled(form, rng=rng, **size)
    tracker.push(key)
    for number in range(1, 9):
        vector, shift = (0, 0, 0.01 * number), (0.02 * number, 0, 0)
        result = sampled(form, vector, shift, rng=rng, **size)
        poses = tracker.push(result), engine.pose.estimate_pose(key, result)
        errors.append([error_of(pose, vector, shift) / pose.sigma for pose in poses])
    averaged, whole = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert averaged < 1.1 * whole


@pytest.mark.slow
def test_rounds_of_a_closed_path_do_not_drift() -> None:
    rng, tracker = np.random.default_rng(8), engine.pose.PoseTracker()
    angles = 2 * np.pi * np.arange(100) / 100
    size = {"shape": (120, 160), "pixel": 0.025, "height_sigma": 1e-9, "normals_sigma": 1e-9}
    path, clean = [], []
    for angle in angles:
        across, along = np.sin(angle), 1 - np.cos(angle)
        moved = (
            (0.1 * across, 0.1 * along, 0.3 * across),
            (1.5 * across, 1.5 * along, 0.05 * np.sin(2 * angle)),
        )
        path.append(moved)
        clean.append(sampled(bumpy, *moved, rng=rng, **size))
    errors, squares = [], []
    for number in range(1001):
        pose = tracker.push(noisy(clean[number % 100], rng))
        error = error_of(pose, *path[number % 100])
        if number % 100 == 0 and number:
            errors.append(error)
        if number:
            squares.append(error @ np.linalg.solve(pose.covariance, error) / 6)
    assert np.degrees(np.abs(errors)[:, :3].max()) < 0.1
    assert np.abs(errors)[:, 3:].max() < 0.005
    assert 0.7 < np.mean(squares) < 1.5


def noisy(clean: io.Result, rng: np.random.Generator) -> io.Result:
    """Return a result with noise of 1 µm and 0.01 rad."""
    normals = clean.normals + rng.normal(0, 0.01 / np.sqrt(2), clean.normals.shape)
    return clean.assign(
        height=(clean.height + rng.normal(0, 1e-3, clean.height.shape)).astype(np.float32),
        height_sigma=np.full(clean.height.shape, 1e-3, np.float32),
        normals=(normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        normals_sigma=np.full(clean.height.shape, 0.01, np.float32),
    )
