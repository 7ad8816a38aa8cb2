"""The object's position in the body's frame, compared with explicit rotations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mirrorskin.io import InputError
from mirrorskin.twin import Axial, Body, Cylinder, Horizontal, Object, Plane, Sphere, Twist, Vertical
from mirrorskin.twin.movement import Movement
from mirrorskin.twin.obstacle import meet
from mirrorskin.twin.view import View

POINTS = np.random.default_rng(3).uniform(-8, 8, (50, 3))


def seen(movement: Movement, frame: int) -> NDArray[np.float64]:
    """Return the points as the body sees them in a frame."""
    pose = movement.pose(movement.reduced(movement.path[frame]))
    return POINTS @ pose.rotation.T + pose.shift


def test_a_press_raises_the_object() -> None:
    np.testing.assert_allclose(seen(Vertical([0.0, 0.7]), 1), POINTS + np.array([0, 0, 0.7]))


@pytest.mark.parametrize("pivot", [(0.0, 0.0, 0.0), (0.0, 0.0, 40.0), (3.0, -2.0, -1.5)])
@pytest.mark.parametrize("phase", [0.0, 0.4, np.pi / 2, 3.9, -2.0])
def test_the_axis_leans_away_from_the_phase_and_the_pivot_stays(
    phase: float, pivot: tuple[float, float, float]
) -> None:
    tilt, press = 0.3, 1.2
    movement = Axial([phase], tilt, press, pivot)
    axis = np.array([-np.sin(tilt) * np.cos(phase), -np.sin(tilt) * np.sin(phase), np.cos(tilt)])
    # The shortest rotation that takes the body's axis to z is the one that does not spin the body.
    turn, _ = Rotation.align_vectors([[0, 0, 1]], [axis])
    lean = np.cross(axis, [0, 0, 1])
    shortest = Rotation.from_rotvec(lean / np.linalg.norm(lean) * tilt)
    centre = np.array(pivot) - [0, 0, press]  # in the world, where the body stands lowered
    expected = shortest.apply(POINTS - centre) + pivot
    np.testing.assert_allclose(seen(movement, 0), expected, atol=1e-10)
    np.testing.assert_allclose(turn.apply(axis), [0, 0, 1], atol=1e-12)


def test_whole_turns_are_the_same_pose() -> None:
    movement = Axial(np.arange(24) * np.pi / 4, 0.04, 1.0)
    for frame in range(8):
        np.testing.assert_array_equal(seen(movement, frame), seen(movement, frame + 8))
        np.testing.assert_array_equal(seen(movement, frame), seen(movement, frame + 16))


@pytest.mark.parametrize("count", [3, 5, 7, 10, 12, 36, 100])
def test_turns_by_parts_that_binary_numbers_only_come_close_to_are_the_same_poses(count: int) -> None:
    phase = 0.3 + np.arange(4 * count) * 2 * np.pi / count
    for turned in (phase, phase % (2 * np.pi), -phase):
        movement = Axial(turned, 0.04, 1.0)
        assert len(np.unique(movement.reduced(movement.path))) == count
        for frame in range(count):
            np.testing.assert_array_equal(seen(movement, frame), seen(movement, frame + 3 * count))


def test_the_object_goes_against_a_sideways_move() -> None:
    movement = Horizontal([[0.0, 0.0], [0.3, -0.2]], 0.5)
    np.testing.assert_allclose(seen(movement, 1), POINTS + np.array([-0.3, 0.2, 0.5]))


def test_the_object_turns_against_a_twist() -> None:
    expected = Rotation.from_euler("z", -0.2).apply(POINTS) + np.array([0, 0, 0.5])
    np.testing.assert_allclose(seen(Twist([0.0, 0.2], 0.5), 1), expected)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Vertical([]), "travel is empty"),
        (lambda: Vertical([0.3, np.nan, 0.4]), "travel.*frame 1"),
        (lambda: Vertical([0.1], compliance=-1.0), "compliance"),
        (lambda: Axial([], 0.1, 1.0), "phase is empty"),
        (lambda: Axial([0.0, np.nan], 0.1, 1.0), "phase.*frame 1"),
        (lambda: Axial([0.0], 0.0, 1.0), "tilt 0 degrees.*at most 30 degrees"),
        (lambda: Axial([0.0], np.radians(30.1), 1.0), "tilt 30.1 degrees"),
        (lambda: Axial([0.0], -0.1, 1.0), "tilt"),
        (lambda: Axial([0.0], np.nan, 1.0), "tilt"),
        (lambda: Axial([0.0], 0.1, np.inf), "press"),
        (lambda: Axial([0.0], 0.1, 1.0, (0.0, 1.0)), "pivot"),  # type: ignore[arg-type]
        (lambda: Horizontal([0.1, 0.2], 1.0), "displacement"),
        (lambda: Horizontal(np.zeros((0, 2)), 1.0), "displacement is empty"),
        (lambda: Horizontal([[0.1, np.inf]], 1.0), "displacement.*frame 0"),
        (lambda: Twist([[0.1]], 1.0), "twist"),
        (lambda: Twist([0.1], np.nan), "press"),
    ],
)
def test_bad_input_is_refused_in_one_line(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("pivot", [(0.0, 0.0, 0.0), (0.0, 0.0, 40.0), (3.0, -2.0, -1.5), (-30.0, 10.0, 0.0)])
def test_a_rotation_raises_the_rim_of_a_disc_by_the_stated_height(pivot: tuple[float, float, float]) -> None:
    angles = np.linspace(-np.pi, np.pi, 721)
    movement = Axial(angles[:-1], 0.3, 1.2, pivot)
    rim = 8.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    highest = max(
        float((rim @ pose.rotation.T + pose.shift)[:, 2].max()) for pose in map(movement.pose, movement.path)
    )
    assert highest <= movement.rise(8.0) + 1e-12
    assert highest == pytest.approx(movement.rise(8.0), abs=1e-3)


@pytest.mark.parametrize("thing", [Sphere(), Cylinder(), Plane()])
def test_no_object_is_higher_than_its_rise(thing: Object) -> None:
    rng = np.random.default_rng(6)
    view = View((60, 60), (0.6, 0.6), Body())
    for _ in range(5):
        x, y, z = rng.uniform(-6, 6, 3)
        movement = Axial(rng.uniform(-3, 3, 1), rng.uniform(0.05, 0.5), rng.uniform(1, 4), (x, y, z))
        highest = np.nanmax(meet(thing, movement.pose(movement.path[0]), view).height, initial=0.0)
        assert 0 < highest <= movement.rise(thing.radius)
