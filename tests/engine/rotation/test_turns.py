"""Which frames make a turn."""

import numpy as np
import pytest

from mirrorskin.engine.rotation.design_matrix import cut_into_turns, goes_round, longest_turn

EIGHTHS = np.arange(8) * np.pi / 4
THREE = np.concatenate([EIGHTHS + turn * 2 * np.pi for turn in range(3)])


def lengths(phase):
    """Return how many frames each turn has; they must meet, and hold all frames."""
    turns = cut_into_turns(np.asarray(phase, float))
    assert [turn.start for turn in turns] == [0, *(turn.stop for turn in turns[:-1])]
    assert turns[-1].stop == len(phase)
    return [turn.stop - turn.start for turn in turns]


def test_a_turn_ends_with_the_first_frame_a_whole_turn_on():
    assert lengths(THREE) == [8, 8, 8]
    assert lengths(THREE[:-3]) == [8, 8, 5]
    assert lengths(THREE[:17]) == [8, 8, 1]


def test_a_turn_that_may_go_on_is_one():
    assert lengths(EIGHTHS) == [8]
    assert lengths([0.3]) == [1]


@pytest.mark.parametrize("start", [0.0, 1.0, -7.0, 500.0])
def test_turns_may_begin_anywhere_and_go_either_way(start):
    assert lengths(start + THREE) == [8, 8, 8]
    assert lengths(start - THREE) == [8, 8, 8]


def test_phases_modulo_a_turn_go_on():
    for phase in (THREE, -THREE, 1 + THREE):
        told = np.mod(phase, 2 * np.pi)
        assert lengths(told) == [8, 8, 8]
        assert lengths(told - np.pi) == [8, 8, 8]


def test_rounding_of_phases_moves_no_frame():
    for count in (3, 7, 8, 11, 64):
        phase = 2 * np.pi * np.arange(5 * count) / count
        assert lengths(phase.astype(np.float32)) == [count] * 5
        assert lengths(np.cumsum(np.full(5 * count, 2 * np.pi / count))) == [count] * 5


def test_a_frame_short_of_the_whole_turn_belongs_to_it():
    late = np.radians([0, 50, 130, 200, 290, 359.9, 405, 500, 719])
    assert lengths(late) == [6, 3]


def test_missing_frames_leave_their_turn():
    kept = np.delete(THREE, [9, 10, 12])
    assert lengths(kept) == [8, 5, 8]


def test_frames_that_stand_still_are_one_turn():
    assert lengths(np.zeros(40)) == [40]


def test_a_gap_of_more_than_half_a_turn_is_a_gap():
    for way in (1, -1):
        kept = np.delete(THREE, [*range(3, 8), *range(12, 18)])
        assert lengths(way * kept) == [3, 4, 6]
        whole = np.delete(THREE, range(8, 16))
        assert lengths(way * whole) == [8, 8]


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        (range(0, 360, 45), True),
        ([0, 120, 240], True),
        ([0, 180], True),
        ([0, 90, 180], True),
        ([0, 90, 170], False),
        ([350, 10, 30, 400], False),
        ([720, 480, 240], True),
        ([5], False),
    ],
)
def test_phases_go_round_where_no_gap_is_above_half_a_turn(degrees, expected):
    assert goes_round(np.radians(degrees)) == expected


def test_without_frames_there_is_no_turn():
    assert cut_into_turns(np.empty(0)) == []
    assert longest_turn(np.empty(0)) == 0


def test_the_longest_turn_is_counted_in_frames():
    assert longest_turn(THREE) == 8
    assert longest_turn(np.append(THREE, 6 * np.pi + np.arange(9) * 2 * np.pi / 9)) == 9
