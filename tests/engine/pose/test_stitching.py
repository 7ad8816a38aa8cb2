"""Touches of one surface are put at the right places, within their stated errors."""

from __future__ import annotations

import numpy as np
import pytest
from moved_surfaces import bumpy, sampled

from mirrorskin import engine, io

MOVES = (
    ((0, 0, 0), (0, 0, 0)),
    ((0.02, -0.01, 0.05), (-1.5, 0.2, 0.02)),
    ((-0.02, 0.02, -0.03), (-2.6, -0.8, -0.03)),
)


def touches(seed=0, moves=MOVES, **options):
    rng = np.random.default_rng(seed)
    return [sampled(bumpy, np.array(turn), np.array(shift), rng=rng, **options) for turn, shift in moves]


@pytest.fixture(scope="module")
def whole():
    return engine.pose.stitch(touches())


def errors(result):
    x, y = np.meshgrid(result.x, result.y)
    return result.height - bumpy(x, y)[0]


def test_the_surface_is_larger_and_right_to_its_sigma(whole):
    result = whole.result
    finite = np.isfinite(result.height)
    assert finite.sum() > 1.5 * 60 * 80
    error = errors(result)[finite]
    assert np.sqrt(np.mean(error**2)) < 1e-3
    # Interpolation takes noise away, of which the standard deviations say nothing.
    assert 0.5 < np.mean((error / result.height_sigma[finite]) ** 2) < 1.2
    assert (result.status == 2).sum() < 5


def test_what_several_touches_saw_is_known_better(whole):
    result = whole.result
    once, more = np.nanmax(result.height_sigma), np.nanmin(result.height_sigma)
    assert more < 0.75 * once


def test_poses_are_those_that_the_touches_were_moved_by(whole):
    for (turn, shift), pose in zip(MOVES[1:], whole.poses[1:], strict=True):
        np.testing.assert_allclose(pose.rotation, turn, atol=4e-3)
        np.testing.assert_allclose(pose.translation, shift, atol=5e-3)
    assert whole.links == 3


def test_normals_are_turned_and_merged(whole):
    result = whole.result
    x, y = np.meshgrid(result.x, result.y)
    _, across, up = bumpy(x, y)
    upright = np.dstack([-across, -up, np.ones_like(x)])
    upright /= np.linalg.norm(upright, axis=-1, keepdims=True)
    finite = np.isfinite(result.normals).all(axis=-1)
    angle = np.linalg.norm(result.normals - upright, axis=-1)[finite]
    assert np.sqrt(np.mean(angle**2)) < 0.011


def test_a_touch_of_unknown_offset_takes_that_of_the_others():
    first, second = touches(moves=MOVES[:2])
    shape = second.height.shape
    relative = {"component": np.zeros(shape, np.int32), "offset_unknown": np.ones(1, np.uint8)}
    shifted = io.Result(
        height=second.height + np.float32(0.4),
        height_sigma=second.height_sigma,
        normals=second.normals,
        normals_sigma=second.normals_sigma,
        x=second.x,
        y=second.y,
        **relative,
    )
    result = engine.pose.stitch([first, shifted]).result
    assert np.sqrt(np.nanmean(errors(result) ** 2)) < 2e-3
    assert result.offset_unknown is None


@pytest.mark.parametrize("relative", [0, 1])
def test_the_offset_and_the_pose_of_a_levelled_touch_are_in_its_sigma(relative):
    squares = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        pair = [
            sampled(bumpy, rng=rng, shape=(60, 70), height_sigma=2e-2),
            sampled(bumpy, (0.01, -0.01, 0.02), (-1, 0.2, 0), rng=rng, shape=(60, 70), height_sigma=2e-4),
        ]
        pair[relative] = pair[relative].assign(
            height=pair[relative].height + np.float32(0.4),
            component=np.zeros((60, 70), np.int32),
            offset_unknown=np.ones(1, np.uint8),
        )
        result = engine.pose.stitch(pair).result
        error = errors(result) - (0.4 if relative == 0 else 0)  # heights are the first touch's
        squares.append(np.nanmean((error / result.height_sigma) ** 2))
    assert 0.5 < np.mean(squares) < 1.5


def test_touches_that_differ_are_reported():
    first, second = touches(moves=MOVES[:1] * 2)
    dented = np.array(second.height)
    dented[20:30, 30:40] -= 0.02
    other = io.Result(
        height=dented,
        height_sigma=second.height_sigma,
        normals=second.normals,
        normals_sigma=second.normals_sigma,
        x=second.x,
        y=second.y,
    )
    result = engine.pose.stitch([first, other]).result
    assert (result.status[21:29, 31:39] == 2).all()
    assert (result.height_sigma[21:29, 31:39] > 0.005).all()
    assert (result.status == 2).sum() < 130


def test_what_shares_nothing_is_refused_by_name():
    far = sampled(lambda x, y: bumpy(x + 40.0, 3 * y), rng=np.random.default_rng(1))
    with pytest.raises(io.InputError, match=r"other\.h5 shares too little"):
        engine.pose.stitch([touches()[0], far], names=["one.h5", "other.h5"])


def test_a_single_result_is_refused():
    with pytest.raises(io.InputError, match="two or more"):
        engine.pose.stitch(touches(moves=MOVES[:1]))


def test_heights_without_sigma_are_refused_by_name():
    first, second = touches(moves=MOVES[:2])
    bare = io.Result(
        height=second.height,
        normals=second.normals,
        normals_sigma=second.normals_sigma,
        x=second.x,
        y=second.y,
    )
    with pytest.raises(io.InputError, match=r"two\.h5 has no height_sigma"):
        engine.pose.stitch([first, bare], names=["one.h5", "two.h5"])
