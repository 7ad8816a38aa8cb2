"""One turn of a result with maps of each turn."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import io


def a_result(*size, **changes):
    """Return a result of so many turns, rows and columns, or of rows and columns."""
    values = np.arange(np.prod(size), dtype=np.float32).reshape(size)
    maps = {"zenith": values, "normals": np.stack([values] * 3, -1), "edges": values.astype(np.uint8)}
    places = dict(zip("xy", io.pixel_axes(size[-2:], (0.5, 0.6)), strict=True))
    return io.Result(**maps | places | {"process": {"source": "a.h5"}} | changes)


def test_a_result_without_turns_passes():
    result = a_result(4, 5)
    assert io.select_turn(result, None) is result
    vectors = io.Result(normals=np.zeros((4, 5, 3), np.float32))
    assert io.select_turn(vectors, None) is vectors


@pytest.mark.parametrize("turn", [0, 2])
def test_the_maps_of_a_turn_are_those_of_it(turn):
    result = a_result(3, 4, 5)
    actual = io.select_turn(result, turn)
    assert set(actual.maps()) == {"zenith", "normals", "edges"}
    for name, values in actual.maps().items():
        np.testing.assert_array_equal(values, getattr(result, name)[turn])
    np.testing.assert_array_equal(actual.x, result.x)
    np.testing.assert_array_equal(actual.y, result.y)
    assert actual.process == {"source": "a.h5", "turn": turn}
    assert result.process == {"source": "a.h5"}


def test_components_count_from_0_in_each_turn():
    component = np.array([[[0, 0, -1], [1, 1, -1]], [[4, -1, 2], [4, -1, 2]], [[-1, -1, -1]] * 2], np.int32)
    unknown = np.array([1, 0, 1, 0, 0], np.uint8)
    result = a_result(3, 2, 3, component=component, offset_unknown=unknown)
    second = io.select_turn(result, 1)
    assert second.component.tolist() == [[1, -1, 0], [1, -1, 0]]
    assert second.component.dtype == np.int32
    assert second.offset_unknown.tolist() == [1, 0]
    third = io.select_turn(result, 2)
    assert (third.component == -1).all()
    assert third.offset_unknown.tolist() == []
    bare = io.select_turn(a_result(3, 2, 3, component=component), 1)
    assert bare.component.tolist() == second.component.tolist()
    assert bare.offset_unknown is None


@pytest.mark.parametrize(
    ("size", "turn", "line"),
    [
        ((3, 4, 5), None, "has maps of 3 turns: choose one with --turn 0 to 2"),
        ((3, 4, 5), 3, "has maps of 3 turns, and none of turn 3: choose one with --turn 0 to 2"),
        ((3, 4, 5), -1, "none of turn -1: choose one"),
        ((1, 4, 5), None, r"has maps of 1 turn: choose one with --turn 0$"),
        ((4, 5), 0, "the maps of this result are not of single turns: leave --turn out"),
    ],
)
def test_a_turn_that_is_not_there_is_one_line(size, turn, line):
    with pytest.raises(io.InputError, match=line) as caught:
        io.select_turn(a_result(*size), turn)
    assert "\n" not in str(caught.value)
