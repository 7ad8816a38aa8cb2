"""Touches of one surface are put at the right places, within their stated errors."""

from __future__ import annotations

import numpy as np
import pytest
from moved_surfaces import bumpy, error_of, sampled
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

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


def rough(seed, correlation=3.0, step=0.0, shape=(200, 400)):
    """Return a random surface of Sq 4 um, (H, W), mm, with a step of some height near its middle."""
    height = gaussian_filter(np.random.default_rng(seed).normal(size=shape), correlation, mode="wrap")
    height *= 0.004 / height.std()
    height[:, shape[1] // 2 - 20 :] += step
    return height


def cut(surface, at, rng, *, size=(200, 240), sigma=3e-4, pixel=0.01):
    """Return a field of a surface, its first column at ``at``, with noise."""
    part = surface[: size[0], at : at + size[1]] + rng.normal(0, sigma, size)
    x, y = io.pixel_axes(size, (pixel, pixel))
    noise = np.full(size, sigma, np.float32)
    return io.Result(height=part.astype(np.float32), height_sigma=noise, x=x, y=y)


def chi_square(pose, vector, shift):
    error = error_of(pose, vector, shift)
    return error @ np.linalg.solve(pose.covariance, error) / 6


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.0, 0.05])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("along", [2, 5, 10, 20, 40, 60, 80, 100, 120])
def test_fields_of_rough_surfaces_are_found_at_any_shift(step, seed, along):
    rng, surface = np.random.default_rng(seed + 100), rough(seed, step=step)
    pose = engine.pose.stitch([cut(surface, at, rng) for at in (0, along)]).poses[1]
    np.testing.assert_allclose(pose.translation[:2], (-0.01 * along, 0), atol=1e-3)


@pytest.mark.parametrize("correlation", [0.3, 1.0, 3.0])
def test_small_fields_of_rough_surfaces_are_found_within_their_sigma(correlation):
    rng, surface = np.random.default_rng(0), rough(2, correlation)
    fields = [cut(surface, at, rng, size=(70, 80)) for at in (0, 37)]
    pose = engine.pose.stitch(fields).poses[1]
    assert chi_square(pose, np.zeros(3), np.array([-0.37, 0, 0])) < 3


def test_a_turned_field_of_a_rough_surface_is_found():
    rng, surface = np.random.default_rng(0), rough(2)
    first, second = (cut(surface, at, rng, size=(90, 90)) for at in (0, 25))
    half_turned = second.assign(height=second.height[::-1, ::-1].copy())
    pose = engine.pose.stitch([first, half_turned]).poses[1]
    assert abs(pose.rotation[2]) == pytest.approx(np.pi, abs=1e-3)
    np.testing.assert_allclose(pose.translation[:2], (0.25, 0), atol=1e-3)


def test_the_noise_of_a_rough_surface_is_that_by_which_fields_differ():
    rng, surface = np.random.default_rng(0), rough(2, 0.3)
    fields = [cut(surface, at, rng, size=(70, 80)).assign(height_sigma=None) for at in (0, 37)]
    result = engine.pose.stitch(fields).result
    assert np.nanmedian(result.height_sigma[:, :30]) == pytest.approx(3e-4, rel=0.15)  # one field
    assert "is estimated from the differences of overlapping results" in result.process["warnings"]


def tiles(rows, columns, seed, shape=(40, 50), pixel=0.05, overlap=0.35):
    """Return fields of a wavy surface by rows, moved a little, and their true motions and form."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0, 5.2, (40, 2)), rng.uniform(0, 2 * np.pi, 40)

    def form(x, y):
        angles = [(u, v, u * x + v * y + phase) for (u, v), phase in zip(waves, phases, strict=True)]
        parts = [(np.sin(angle), u * np.cos(angle), v * np.cos(angle)) for u, v, angle in angles]
        return tuple(0.004 * np.sqrt(2 / 40) * sum(values) for values in zip(*parts, strict=True))

    results, motions = [], []
    for row in range(rows):
        for column in range(columns):
            first = not row and not column
            vector = (not first) * rng.normal(0, (0.003, 0.003, 0.01))
            place = np.array([column * shape[1], -row * shape[0], 0]) * pixel * (1 - overlap)
            place[:2] += (not first) * rng.normal(0, pixel, 2)
            shift = -Rotation.from_rotvec(vector).apply(place) + [0, 0, (not first) * rng.normal(0, 0.02)]
            field = sampled(form, vector, shift, rng=rng, shape=shape, height_sigma=3e-4)
            results.append(field.assign(normals=None, normals_sigma=None))
            motions.append((vector, shift))
    return results, motions, form


@pytest.mark.parametrize(
    ("rows", "columns", "offsets"),
    [(1, 12, None), (1, 12, (50 * 0.05 * 0.65, 0)), pytest.param(4, 5, None, marks=pytest.mark.slow)],
)
def test_many_fields_become_one_surface_within_its_sigma(rows, columns, offsets):
    results, motions, form = tiles(rows, columns, 1)
    whole = engine.pose.stitch(results, offsets=offsets)
    assert whole.links >= rows * (columns - 1) + columns * (rows - 1)
    squares = [
        chi_square(pose, *motion) for pose, motion in zip(whole.poses, motions, strict=True) if pose.pixels
    ]
    assert 0.3 < np.mean(squares) < 2
    result = whole.result
    error = result.height - form(*np.meshgrid(result.x, result.y))[0]
    assert 0.1 < np.nanmean((error / result.height_sigma) ** 2) < 2
    assert np.mean(result.status == 2) < 0.01


def test_the_order_of_fields_does_not_matter():
    results, motions, _ = tiles(1, 4, 3)
    order = [0, 2, 3, 1]  # the second shares nothing with the first
    poses = engine.pose.stitch([results[number] for number in order]).poses
    for number, pose in zip(order[1:], poses[1:], strict=True):
        assert chi_square(pose, *motions[number]) < 3


def test_a_refusal_says_what_was_tried():
    rng = np.random.default_rng(0)
    fields = [cut(rough(seed), 0, rng, size=(50, 60)) for seed in (1, 2)]
    with pytest.raises(io.InputError, match=r"at the peaks .* rotations about z; at best .* sigmas"):
        engine.pose.stitch(fields)
    with pytest.raises(io.InputError, match=r"within 10% of the field .* check --offset"):
        engine.pose.stitch(fields, offsets=(0.2, 0.0))


def test_a_surface_that_repeats_itself_has_a_warning_unless_its_offset_is_stated():
    rng, (row, column) = np.random.default_rng(0), np.indices((80, 200))
    surface = 0.004 * np.sin(2 * np.pi * column / 25) * np.cos(2 * np.pi * row / 25)
    fields = [cut(surface, at, rng, size=(80, 100)) for at in (0, 40)]
    assert "state --offset" in engine.pose.stitch(fields).result.process["warnings"]
    stated = engine.pose.stitch(fields, offsets=(0.42, 0.01))
    np.testing.assert_allclose(stated.poses[1].translation[:2], (-0.4, 0), atol=1e-3)
    assert "warnings" not in stated.result.process


def test_a_plain_surface_is_where_it_is_stated_with_a_warning():
    rng = np.random.default_rng(0)
    fields = [cut(np.zeros((60, 100)), 0, rng, size=(60, 80)) for _ in range(2)]
    whole = engine.pose.stitch(fields, offsets=(0.3, 0.0))
    np.testing.assert_allclose(whole.poses[1].translation[:2], (-0.3, 0), atol=1e-6)
    assert "do not determine all of the motion of result 1" in whole.result.process["warnings"]


def test_an_offset_that_is_no_number_is_refused():
    with pytest.raises(io.InputError, match="offsets is 'here': numbers are needed"):
        engine.pose.stitch(touches(moves=MOVES[:2]), offsets="here")


@pytest.mark.parametrize("offsets", [(1.0,), [(1.0, 0.0)] * 3, (np.nan, 0.0), [1.0, 0.0, 1.0, 0.0]])
def test_offsets_that_are_no_positions_are_refused(offsets):
    with pytest.raises(io.InputError, match="once or 1 times"):
        engine.pose.stitch(touches(moves=MOVES[:2]), offsets=offsets)
