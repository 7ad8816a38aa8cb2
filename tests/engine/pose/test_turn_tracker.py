"""An object followed along the frames of a rotation."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from moved_surfaces import Map, bumpy, error_of, sampled

from mirrorskin import engine, io

TILT, GAIN, OFFSET, TURN, PIXEL = 0.05, 300.0, 30.0, 12, 0.08
SHAPE = 60, 80
KNOWN = 5  # rotation and translation along x and y
MIDDLE = float(np.mean(sampled(bumpy, rng=np.random.default_rng(0), pixel=PIXEL).height))  # mm
Path = Callable[[int], tuple[Map, Map]]


def still(number: int) -> tuple[Map, Map]:
    """No motion."""
    return np.zeros(3), np.zeros(3)


def spun(number: int) -> tuple[Map, Map]:
    """A motion that begins after the first turn."""
    steps = max(0, number - TURN)
    return np.array([0.002, -0.001, 0.006]) * steps, np.array([0.012, 0.006, 0.0]) * steps


def phase_of(number: int) -> float:
    return 2 * np.pi * number / TURN


@cache
def normals_of(
    vector: tuple[float, ...], shift: tuple[float, ...], form: Any, shape: tuple[int, int]
) -> np.ndarray:
    """Return the normals of a moved object, in float64: heights are those above their mean at rest."""

    def lowered(x: Map, y: Map) -> tuple[Map, Map, Map]:
        height, *slopes = form(x, y)
        return height - MIDDLE, *slopes

    rng, pixel = np.random.default_rng(), PIXEL * SHAPE[0] / shape[0]
    exact = sampled(lowered, vector, shift, rng=rng, shape=shape, pixel=pixel, normals_sigma=0)
    return exact.normals.astype(np.float64)


def frame(
    number: int,
    path: Path = spun,
    *,
    seed: int = 0,
    form: Any = bumpy,
    shape: tuple[int, int] = SHAPE,
    light: float = 1.0,
    noise: float = 1.5,
) -> np.ndarray:
    """Return a frame of a moved object."""
    rng = np.random.default_rng((seed, number))
    alpha = phase_of(number)
    axis = [-np.sin(TILT) * np.cos(alpha), -np.sin(TILT) * np.sin(alpha), np.cos(TILT)]
    vector, shift = path(number)
    normals = normals_of(tuple(vector), tuple(shift), form, shape)
    zenith = np.arccos(np.clip(normals @ axis, -1, 1))
    counts = light * (OFFSET + GAIN * zenith) + rng.normal(0, noise, shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8)


def tracker(pixel: float = PIXEL, **options: Any) -> engine.pose.TurnTracker:
    chosen = {"tilt": TILT, "zenith_gain": GAIN, "zenith_offset": OFFSET, "window_frames": TURN} | options
    return engine.pose.TurnTracker(engine.Normals(**chosen), pixel)


def poses(
    count: int, path: Path = spun, follow: engine.pose.TurnTracker | None = None, **options: Any
) -> list[Any]:
    follow = follow or tracker()
    return [follow.push(frame(number, path, **options), phase_of(number)) for number in range(count)]


def chi_square(pose: engine.pose.Pose, number: int, path: Path = spun) -> float:
    error, known = error_of(pose, *path(number))[:KNOWN], slice(KNOWN)
    return float(error @ np.linalg.solve(pose.covariance[known, known], error)) / KNOWN


def test_each_frame_after_the_first_turn_has_a_pose() -> None:
    found = poses(TURN + 3)
    assert [pose is not None for pose in found] == [False] * TURN + [True] * 3


def test_poses_are_wrong_by_their_covariance() -> None:
    last = TURN + 4
    chi = [chi_square(poses(last + 1, seed=seed)[-1], last) for seed in range(12)]
    assert 0.6 < np.mean(chi) < 1.7


def test_a_pose_has_the_time_of_its_frame() -> None:
    """Of a mean over the turn, x would be wrong by half of what the object moves in a turn, 0.07 mm."""
    last = 2 * TURN
    assert abs(error_of(poses(last + 1)[-1], *spun(last))[3]) < 0.006


def test_a_motion_along_the_axis_is_undetermined() -> None:
    assert np.isinf(poses(TURN + 1)[-1].sigma).tolist() == [False] * 5 + [True]


@pytest.mark.parametrize("number", [3, TURN + 3])
def test_a_flicker_of_the_light_hardly_changes_a_pose(number: int) -> None:
    last, steady, flickering = TURN + 3, tracker(), tracker()
    for at in range(last + 1):
        before = steady.push(frame(at), phase_of(at))
        after = flickering.push(frame(at, light=1.03 if at == number else 1.0), phase_of(at))
    assert before is not None
    assert after is not None
    changed = error_of(before, after.rotation, after.translation)
    assert np.all(np.abs(changed[:KNOWN]) < 1.5 * before.sigma[:KNOWN])


def there_and_back(number: int) -> tuple[Map, Map]:
    """A path that leaves the picture by half of it, and returns."""
    angle = 2 * np.pi * max(0, number - TURN) / 96
    return np.array([0, 0, 0.2 * np.sin(angle)]), np.array([1.7 * (1 - np.cos(angle)), 0, 0])


def test_an_object_that_leaves_the_picture_is_followed_by_other_keys() -> None:
    follow, last = tracker(), TURN + 47
    pose = poses(last + 1, there_and_back, follow)[-1]
    assert follow.keys > 1
    assert chi_square(pose, last, there_and_back) < 5


def test_a_path_that_returns_takes_an_earlier_key_again() -> None:
    follow = tracker()
    poses(TURN + 48, there_and_back, follow)
    there = follow.keys
    for number in range(TURN + 48, TURN + 192):
        follow.push(frame(number, there_and_back), phase_of(number))
    assert follow.keys == there


def test_an_object_that_moves_in_the_first_turn_is_refused_until_it_rests() -> None:
    def early(number: int) -> tuple[Map, Map]:
        return np.zeros(3), np.array([0.02, 0, 0]) * min(number, TURN)

    follow, again = tracker(), range(TURN + 1, 2 * TURN + 2)
    with pytest.raises(io.InputError, match="hold the object still"):
        poses(TURN + 1, early, follow)
    found = [follow.push(frame(number, early), phase_of(number)) for number in again]
    assert found[-1] is not None


def test_a_frame_without_the_object_is_refused_and_the_next_one_is_found() -> None:
    follow = tracker()
    poses(TURN + 2, follow=follow)
    with pytest.raises(io.InputError, match="not found near its last place"):
        follow.push(np.full(SHAPE, 100, np.uint8), phase_of(TURN + 2))
    pose = follow.push(frame(TURN + 3), phase_of(TURN + 3))
    assert pose is not None
    assert chi_square(pose, TURN + 3) < 5


def test_clipped_pixels_are_left_out() -> None:
    follow, last = tracker(), TURN + 3
    for number in range(last + 1):
        counts = frame(number)
        counts[:, 30:50] = 255
        pose = follow.push(counts, phase_of(number))
    assert pose is not None
    assert chi_square(pose, last) < 5


def test_large_frames_are_averaged_without_loss() -> None:
    last = TURN + 2
    small = poses(last + 1, shape=(120, 160), follow=tracker(PIXEL / 2))[-1]
    large = poses(last + 1, shape=(240, 320), follow=tracker(PIXEL / 4))[-1]
    ratio = large.sigma[:KNOWN] / small.sigma[:KNOWN]
    assert np.all((ratio > 0.35) & (ratio < 0.7))  # four times as many pixels


def slope(x: Map, y: Map) -> tuple[Map, Map, Map]:
    """A plane that leans by more than the body."""
    return 0.2 * x, 0 * x + 0.2, 0 * y


def test_a_plane_is_refused() -> None:
    with pytest.raises(io.InputError, match="more relief"):
        poses(TURN + 1, still, form=slope)


def test_a_frame_needs_no_new_memory_of_its_size() -> None:
    shape = 480, 640
    follow = tracker(PIXEL / 8)
    frames = [frame(number, shape=shape) for number in range(TURN + 4)]
    for number in range(TURN + 3):
        follow.push(frames[number], phase_of(number))
    tracemalloc.start()
    follow.push(frames[-1], phase_of(TURN + 3))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < frames[-1].size * np.dtype(np.float32).itemsize / 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window_frames": None}, "window_frames is missing"),
        ({"tilt": None}, "tilt is missing"),
        ({"tilt": "estimate"}, "tilt is missing"),
        ({"zenith_gain": None}, "zenith_gain is missing"),
    ],
)
def test_missing_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(io.InputError, match=message):
        tracker(**options)


@pytest.mark.parametrize(
    ("values", "phase", "message"),
    [
        (np.zeros((60, 81), np.uint8), 0.0, "earlier ones were uint8"),
        (np.zeros(SHAPE, np.uint16), 0.0, "earlier ones were uint8"),
        (np.zeros(SHAPE, np.uint8), np.nan, "phase is nan"),
        (np.zeros((1, *SHAPE), np.uint8), 0.0, "earlier ones were uint8"),
    ],
)
def test_frames_that_cannot_follow_are_refused(values: np.ndarray, phase: float, message: str) -> None:
    follow = tracker()
    follow.push(frame(0), 0.0)
    with pytest.raises(io.InputError, match=message):
        follow.push(values, phase)


def test_a_stream_has_the_pose_of_each_frame() -> None:
    count, alone, found = TURN + 4, tracker(), []
    live = engine.live.Stream(
        engine.live.Frames(),
        SHAPE,
        motion="axial",
        latency=np.inf,
        trackers={"pose": tracker()},
        on_update=lambda update, status: found.append(update.tracked["pose"]),
    )
    with live as stream:
        for number in range(count):
            stream.push(frame(number), phase=phase_of(number))
    for number, pose in enumerate(found):
        expected = alone.push(frame(number), phase_of(number))
        assert (pose is None) == (expected is None)
        if pose is not None:
            np.testing.assert_array_equal(pose.covariance, expected.covariance)


def test_a_stream_of_another_motion_is_refused() -> None:
    with pytest.raises(io.InputError, match="follows axial motions"):
        engine.live.Stream(engine.live.Frames(), SHAPE, motion="vertical", trackers={"pose": tracker()})
