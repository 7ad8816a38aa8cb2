"""Phases: the fit of samples, phases that determine none, and division into turns."""

import numpy as np
import pytest

from mirrorskin.engine.correlation.design_matrix import (
    check_phases,
    fit_matrix,
    goes_round,
    longest_turn,
    split_into_turns,
)
from mirrorskin.io import InputError

MEASURED = np.deg2rad([178.1, 133.4, 91.0, 44.6, 1.9, 313.7, 268.8, 226.2])
EIGHTHS = np.arange(8) * np.pi / 4
THREE = np.concatenate([EIGHTHS + turn * 2 * np.pi for turn in range(3)])


@pytest.mark.parametrize("count", [3, 8, 36])
def test_even_phases_make_the_papers_sums(count):
    alpha = 0.3 + 2 * np.pi * np.arange(count) / count
    expected = np.stack([np.ones(count), 2 * np.cos(alpha), 2 * np.sin(alpha)]) / count
    np.testing.assert_allclose(fit_matrix(alpha), expected, atol=1e-14)


def test_uneven_phases_and_weights_are_weighted_least_squares():
    random = np.random.default_rng(1)
    samples, weights = random.normal(100, 20, 8), random.uniform(0, 3, 8)
    weights[2] = 0
    model = np.stack([np.ones(8), np.cos(MEASURED), np.sin(MEASURED)], axis=1)
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(root[:, None] * model, root * samples, rcond=None)[0]
    many_turns = MEASURED + 2 * np.pi * np.array([0, 3, -2, 100, 7, -50, 1, 0])
    for phase, weight in ((MEASURED, weights), (many_turns, weights), (MEASURED, 1e-4 * weights)):
        np.testing.assert_allclose(fit_matrix(phase, weight) @ samples, expected, rtol=1e-11)


@pytest.mark.parametrize(
    ("phase", "weights", "message"),
    [
        ([], None, "0 frames at 0 different phases"),
        ([0, 2 * np.pi, np.pi, -np.pi, 20 * np.pi], None, "5 frames at 2 different phases .* at least 3"),
        ([0, 1, 2, 3], [1, 1, 0, 0], "2 frames at 2 different phases"),
        ([0, 1e-3, 2e-3], None, "too close together .*spread them over more of the turn"),
        ([0, 1, 2], [1, 1, 1e-12], "too close together|condition"),
        ([0, 1, 2], [0, 0, 0], "all 3 frames have weight 0"),
        ([0, 1, np.nan], None, "nan at frame 2"),
        (["a", "b", "c"], None, "numbers are needed"),
        ([[0, 1, 2]], None, "one number a frame"),
        ([0, 1, 2], [1, -1, 1], "weight -1 at frame 1"),
        ([0, 1, 2], [1, 1, np.nan], "weight nan at frame 2"),
        ([0, 1, 2], 1, "shape .. for 3 frames"),
    ],
)
def test_phases_that_determine_no_fit_are_refused_in_one_line(phase, weights, message):
    with pytest.raises(InputError, match=message) as caught:
        check_phases(phase, weights)
    assert "\n" not in str(caught.value)


def lengths(phase):
    """Return how many frames each turn has; they must meet, and hold all frames."""
    turns = split_into_turns(np.asarray(phase, float))
    assert [turn.start for turn in turns] == [0, *(turn.stop for turn in turns[:-1])]
    assert turns[-1].stop == len(phase)
    return [turn.stop - turn.start for turn in turns]


@pytest.mark.parametrize(
    ("phase", "expected"),
    [
        (THREE, [8, 8, 8]),
        (THREE[:17], [8, 8, 1]),
        (500 - THREE, [8, 8, 8]),
        (np.mod(1 + THREE, 2 * np.pi), [8, 8, 8]),
        (np.mod(-THREE, 2 * np.pi), [8, 8, 8]),
        ((2 * np.pi * np.arange(55) / 11).astype(np.float32), [11] * 5),
        (np.cumsum(np.full(35, 2 * np.pi / 7)), [7] * 5),
        (np.radians([0, 50, 130, 200, 290, 359.9, 405, 500, 719]), [6, 3]),
        (np.delete(THREE, [9, 10, 12]), [8, 5, 8]),
        (-np.delete(THREE, [*range(3, 8), *range(12, 18)]), [3, 4, 6]),
        (np.zeros(40), [40]),
    ],
)
def test_a_turn_ends_with_the_first_frame_a_whole_turn_on(phase, expected):
    assert lengths(phase) == expected
    assert longest_turn(np.asarray(phase)) == max(expected)


def test_without_frames_there_is_no_turn():
    assert split_into_turns(np.empty(0)) == []
    assert longest_turn(np.empty(0)) == 0


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        ([0, 120, 240], True),
        ([0, 90, 180], True),
        ([0, 90, 170], False),
        ([720, 480, 240], True),
        ([5], False),
    ],
)
def test_phases_go_round_where_no_gap_is_above_half_a_turn(degrees, expected):
    assert goes_round(np.radians(degrees)) == expected
