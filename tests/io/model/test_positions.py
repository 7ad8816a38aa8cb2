"""Checks of travel and phase."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.io import InputError
from mirrorskin.io.model.positions import check_phase, check_strokes, check_travel, stroke_starts


@pytest.mark.parametrize(
    "values", [[0, 1, 2, 3], [3, 2, 2, -1], [0, 2, 2, 1], [5, 5, 5, 5], np.array([0, 200, 7, 90], np.uint8)]
)
def test_strokes_may_begin_in_either_direction(values):
    actual = check_strokes(values, 4, "travel")
    np.testing.assert_array_equal(actual, np.asarray(values, float))
    assert actual.dtype == np.float64


@pytest.mark.parametrize(
    ("check", "values", "line"),
    [
        (check_travel, None, "travel is missing: a vertical press needs the travel of each frame, in mm"),
        (check_travel, [[0, 1, 2, 3]], r"travel has shape \(1, 4\) for 4 frames: one number a frame"),
        (check_travel, [0, 1, 2, np.inf], "travel is inf at frame 3: every frame needs a finite number"),
        (check_travel, ["0", "1", "2", "3"], "travel is of type <U1: numbers are needed"),
        (
            check_travel,
            [0, 2, 1, 3],
            "travel runs back at frame 2: a press only goes down; cut or reverse it",
        ),
        (check_travel, np.array([3, 2, 1, 0], np.uint8), "travel runs back at frame 1"),
        (check_strokes, [0, 2, np.nan, 3], "travel is nan at frame 2"),
        (check_phase, None, "travel is missing: an axial rotation needs the phase of each frame, in radians"),
        (check_phase, [0, np.nan, 1, 2], "travel is nan at frame 1"),
    ],
)
def test_impossible_input_is_one_line(check, values, line):
    with pytest.raises(InputError, match=line) as caught:
        check(values, 4, "travel")
    assert "\n" not in str(caught.value)


def test_a_block_goes_on_where_the_one_before_ended():
    np.testing.assert_array_equal(check_travel([2, 3], 2, "travel", after=[2.0]), [2, 3])
    with pytest.raises(InputError, match="travel runs back at frame 0"):
        check_travel([1.9, 3], 2, "travel", after=[2.0])


@pytest.mark.parametrize(
    ("travel", "direction", "starts"),
    [
        ([0.0, 1.0, 2.0], 0, []),
        ([0.0, 1.0, 1.0, 0.5, 0.5, 2.0], 0, [3, 5]),
        ([2.0, 1.0, 2.0], 1, [1, 2]),
        ([2.0, 1.0, 2.0], -1, [2]),
        ([1.0, 1.0], 1, []),
        ([1.0], 1, []),
    ],
)
def test_a_stroke_begins_where_travel_turns(travel, direction, starts):
    assert stroke_starts(np.array(travel), direction).tolist() == starts
