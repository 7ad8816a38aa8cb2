"""The motion of an object between two results, and its covariance, compared with known motions."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from moved_surfaces import RADIUS, ball, bumpy, error_at, error_of, plane, rod, sampled
from scipy.spatial.transform import Rotation
from turned_objects import Moved, turned

from mirrorskin import engine, io
from mirrorskin.twin import make_object


def draw(rng: np.random.Generator, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    return size * rng.normal(0, 0.02, 3), size * rng.normal(0, 0.05, 3)


def mean_chi_square(draws: int, shape: tuple[int, int]) -> float:
    chi_squares = []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        vector, shift = draw(rng)
        pair = (sampled(bumpy, *motion, rng=rng, shape=shape) for motion in ((), (vector, shift)))
        pose = engine.pose.estimate_pose(*pair)
        error = error_of(pose, vector, shift)
        chi_squares.append(error @ np.linalg.solve(pose.covariance, error) / 6)
    return float(np.mean(chi_squares))


def test_errors_match_the_covariance() -> None:
    assert mean_chi_square(30, (60, 80)) == pytest.approx(1.0, abs=0.3)


@pytest.mark.slow
def test_errors_of_many_draws_match_the_covariance() -> None:
    assert mean_chi_square(150, (120, 160)) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("form", "free"), [(bumpy, 0), (rod, 2), (ball, 3), (plane, 3)])
@pytest.mark.parametrize("size", [0.0, 1.0, 4.0])
def test_what_a_surface_cannot_determine_is_undetermined(form, free: int, size: float) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        pose = engine.pose.estimate_pose(sampled(form, rng=rng), sampled(form, *draw(rng, size), rng=rng))
        assert len(pose.undetermined) == free
        assert np.isfinite(pose.rotation).all()
        assert np.isinf(pose.sigma).any() == (free > 0)
        np.testing.assert_allclose(pose.undetermined @ pose.undetermined.T, np.eye(free), atol=1e-9)


def test_a_ball_is_known_by_its_centre_alone() -> None:
    centre, errors = np.array([0, 0, -RADIUS]), []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        vector, shift = draw(rng)
        pose = engine.pose.estimate_pose(sampled(ball, rng=rng), sampled(ball, vector, shift, rng=rng))
        expected = engine.pose.Pose(vector, shift, *[None] * 4).apply(centre)
        errors.append(error_at(pose, centre, expected, np.eye(3)))
    assert np.mean(errors) == pytest.approx(1.0, abs=0.4)


def test_nothing_moves_where_nothing_is_known_to() -> None:
    rng = np.random.default_rng(0)
    pose = engine.pose.estimate_pose(sampled(ball, rng=rng), sampled(ball, (0, 0, 0.8), rng=rng))
    np.testing.assert_allclose(pose.rotation, 0, atol=2e-3)
    np.testing.assert_allclose(pose.translation, 0, atol=5e-3)


def test_large_motions_are_found_from_nothing() -> None:
    rng = np.random.default_rng(1)
    vector, shift = np.array([0.05, -0.1, 1.7]), np.array([0.6, -0.4, 0.1])
    pose = engine.pose.estimate_pose(sampled(bumpy, rng=rng), sampled(bumpy, vector, shift, rng=rng))
    assert np.abs(error_of(pose, vector, shift)).max() < 0.005
    assert pose.chi_square == pytest.approx(1, abs=0.1)


def test_a_motion_that_leaves_little_in_common_is_found_and_no_other() -> None:
    rng = np.random.default_rng(0)
    pair = (sampled(bumpy, (0, 0, 0), shift, rng=rng, shape=(40, 50)) for shift in ((0, 0, 0), (1.5, 0, 0)))
    pose = engine.pose.estimate_pose(*pair)
    assert pose.chi_square < 1.2
    np.testing.assert_allclose(pose.rotation, 0, atol=0.01)
    np.testing.assert_allclose(pose.translation, (1.5, 0, 0), atol=0.01)


def test_a_start_leads_to_the_same_motion() -> None:
    rng = np.random.default_rng(2)
    vector, shift = np.array([0.05, -0.1, 1.7]), np.array([0.6, -0.4, 0.1])
    pair = sampled(bumpy, rng=rng), sampled(bumpy, vector, shift, rng=rng)
    near = dataclasses.replace(engine.pose.estimate_pose(*pair), rotation=vector, translation=shift)
    pose = engine.pose.estimate_pose(*pair, start=near)
    np.testing.assert_allclose(pose.rotation, engine.pose.estimate_pose(*pair).rotation, atol=1e-4)


def test_heights_alone_are_enough() -> None:
    rng = np.random.default_rng(3)
    vector, shift = draw(rng)
    pair = [sampled(bumpy, *motion, rng=rng) for motion in ((), (vector, shift))]
    pose = engine.pose.estimate_pose(*(surface.assign(normals=None, normals_sigma=None) for surface in pair))
    assert np.abs(error_of(pose, vector, shift)).max() < 0.005


def test_outliers_on_one_side_are_left_out_or_noted() -> None:
    chi_squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        vector, shift = draw(rng)
        results = []
        for motion in ((), (vector, shift)):
            heights = sampled(bumpy, *motion, rng=rng, shape=(60, 80)).assign(
                normals=None, normals_sigma=None
            )
            high = (rng.random(heights.height.shape) < 0.01) * rng.uniform(0.05, 0.5, heights.height.shape)
            results.append(heights.assign(height=(heights.height + high).astype(np.float32)))
        pose = engine.pose.estimate_pose(*results)
        error = error_of(pose, vector, shift)
        if not pose.notes:
            chi_squares.append(error @ np.linalg.solve(pose.covariance, error) / 6)
    assert len(chi_squares) >= 6
    assert np.mean(chi_squares) < 2


@pytest.mark.parametrize("sigma", [1e-6, 1e-12, 1e-30])
def test_maps_without_noise_have_a_pose_and_a_covariance(sigma: float) -> None:
    rng = np.random.default_rng(5)
    vector, shift = draw(rng)
    none = {"height_sigma": 0.0, "normals_sigma": 0.0}
    pair = [sampled(bumpy, *motion, rng=rng, **none) for motion in ((), (vector, shift))]
    same = {"height_sigma": np.full_like(pair[0].height, sigma)}
    same |= {"normals_sigma": same["height_sigma"]}
    pose = engine.pose.estimate_pose(*(surface.assign(same) for surface in pair))
    assert np.abs(error_of(pose, vector, shift)).max() < 1e-3
    assert 0 < pose.sigma.max() < 1e-3


def test_integrated_heights_leave_z_open() -> None:
    rng = np.random.default_rng(4)
    pair = []
    for motion in ((), draw(rng)):
        surface = sampled(bumpy, *motion, rng=rng)
        pieces = np.zeros(surface.height.shape, np.int32), np.ones(1, np.uint8)
        pair.append(surface.assign(component=pieces[0], offset_unknown=pieces[1]))
    (free,) = engine.pose.estimate_pose(*pair).undetermined
    np.testing.assert_allclose(np.abs(free), [0, 0, 0, 0, 0, 1], atol=1e-6)


def test_the_covariance_is_0_along_undetermined_directions_wherever_the_object_is() -> None:
    rng = np.random.default_rng(4)
    part = slice(0, 25), slice(30, None)  # whose middle is not the origin
    pair = []
    for motion in ((), draw(rng)):
        touch = sampled(bumpy, *motion, rng=rng)
        apart = {"component": np.zeros(touch.height.shape, np.int32), "offset_unknown": np.ones(1, np.uint8)}
        maps = {name: np.full_like(values, np.nan) for name, values in touch.maps().items()}
        for name, values in maps.items():
            values[part] = touch[name][part]
        pair.append(touch.assign(maps | apart))
    pose = engine.pose.estimate_pose(*pair)
    assert len(pose.undetermined) == 1
    along = pose.undetermined @ pose.covariance
    assert np.abs(along).max() < 1e-9 * np.abs(pose.covariance).max()


def test_pixels_near_the_border_of_contact_do_not_count() -> None:
    rng = np.random.default_rng(5)
    vector, shift = draw(rng)
    pair = []
    for motion in ((), (vector, shift)):
        surface = sampled(bumpy, *motion, rng=rng)
        contact = np.ones(surface.height.shape, np.uint8)
        contact[:, 30:34] = 0
        normals = surface.normals.copy()
        normals[:, 28:36, 0] += 0.2
        pair.append(surface.assign(contact=contact, normals=normals))
    pose = engine.pose.estimate_pose(*pair)
    assert pose.chi_square == pytest.approx(1, abs=0.1)
    assert np.abs(error_of(pose, vector, shift)).max() < 0.005


@pytest.mark.parametrize(
    ("name", "top", "free"), [("sphere", -RADIUS, 4), ("cone", 0.0, 2), ("cylinder", -RADIUS, 3)]
)
def test_errors_on_results_from_frames_match_the_covariance(name, top: float, free: int) -> None:
    """Of the ball's centre, the cone's tip, or the rod's axis, whether it moved or not."""
    errors = []
    thing = make_object(name, (128, 128), (0.07, 0.07))
    for seed in range(3):
        before, deep = turned(thing, seed)
        for shift, angle in (((0.0, 0.0), 0.0), ((0.3, -0.2), 0.15)):
            after, deep_after = turned(Moved(thing, shift, angle), seed + 100)
            pose = engine.pose.estimate_pose(before, after)
            assert len(pose.undetermined) == free
            point, expected = np.array([0, 0, top + deep]), np.array([*shift, top + deep_after])
            ways = np.eye(3)[:2]
            if name == "cylinder":
                ways = np.array([[-math.sin(angle), math.cos(angle), 0]])
            errors.append(error_at(pose, point, expected, ways))
    assert 0.2 < np.mean(errors) < 1.8


def refusals() -> dict[str, tuple[io.Result, io.Result, str]]:
    rng = np.random.default_rng(6)
    good = sampled(bumpy, rng=rng)
    no_height = good.assign(height=None)
    unsure = good.assign(height_sigma=None, normals_sigma=None)
    odd = good.assign(normals_sigma=good.normals_sigma[:5])
    nowhere = good.assign(x=None, y=None)
    small = sampled(bumpy, rng=rng, shape=(4, 4))
    far = small.assign(x=small.x + 100)
    return {
        "no height": (no_height, good, "needs heights"),
        "no sigma": (good, unsure, "with a sigma"),
        "sizes": (odd, good, "one size"),
        "no pixel size": (nowhere, good, "give pixel_size"),
        "no overlap": (good, far, "share too few pixels"),
    }


@pytest.mark.parametrize("name", refusals())
def test_what_cannot_be_compared_is_refused(name: str) -> None:
    first, second, message = refusals()[name]
    with pytest.raises(io.InputError, match=message):
        engine.pose.estimate_pose(first, second)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.5, 1.6, 3.1])
def test_a_rotation_is_kept_to_rounding_errors(angle: float) -> None:
    vector = angle * np.array([0.6, -0.64, 0.48])
    pose = engine.pose.Pose(vector, np.zeros(3), np.eye(6), 1.0, 1, np.zeros((0, 6)))
    np.testing.assert_allclose(pose.motion.turn, Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(pose.inverse().rotation, -vector, rtol=1e-13, atol=1e-25)
