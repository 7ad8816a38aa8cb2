"""Where the object is in the body's frame: against rotations written out here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mirrorskin.hw.twin import Axial, Horizontal, Twist, Vertical
from mirrorskin.hw.twin.movement import Movement
from mirrorskin.io import Block, InputError

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


def test_a_phase_that_jumps_back_goes_on_as_a_path() -> None:
    movement = Axial(np.arange(16) * np.pi / 4 % (2 * np.pi), 0.04, 1.0)
    np.testing.assert_allclose(np.diff(movement.path), np.pi / 4)
    assert movement.positions.max() < 2 * np.pi


def test_the_object_goes_against_a_sideways_move() -> None:
    movement = Horizontal([[0.0, 0.0], [0.3, -0.2]], 0.5)
    np.testing.assert_allclose(seen(movement, 1), POINTS + np.array([-0.3, 0.2, 0.5]))


def test_the_object_turns_against_a_twist() -> None:
    expected = Rotation.from_euler("z", -0.2).apply(POINTS) + np.array([0, 0, 0.5])
    np.testing.assert_allclose(seen(Twist([0.0, 0.2], 0.5), 1), expected)


def test_blocks_and_headers_say_where_the_body_is() -> None:
    axial = Axial([0.1, 0.2, 0.3], 0.04, 1.0, (0.0, 1.0, 2.0))
    assert axial.header().pivot == (0.0, 1.0, 2.0)
    assert (axial.header().tilt, axial.header().press) == (0.04, 1.0)
    np.testing.assert_array_equal(axial.mark(Block(np.zeros((2, 1, 1)), 1)).phase, [0.2, 0.3])
    sideways = Horizontal(np.arange(8.0).reshape(4, 2), 0.5)
    moved = sideways.mark(Block(np.zeros((3, 1, 1)), 0)).displacement
    np.testing.assert_array_equal(moved, [[0, 1], [2, 3], [4, 5]])
    assert sideways.header().press == 0.5
    np.testing.assert_array_equal(Twist([0.1, 0.2], 0.5).mark(Block(np.zeros((1, 1, 1)), 1)).twist, [0.2])
    assert Vertical([1.0]).header().press is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Vertical([]), "travel is empty"),
        (lambda: Vertical([0.3, 0.2, 0.4]), "travel.*frame 1"),
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


def test_a_tilt_of_thirty_degrees_is_the_most() -> None:
    assert Axial([0.0], np.radians(30), 1.0).tilt == np.radians(30)
