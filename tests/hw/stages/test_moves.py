from __future__ import annotations

import math
import re

import numpy as np
import pytest
from scripted_grbl import stage_settings

from mirrorskin.hw.base.rig_file import TiltAxis, TravelAxis
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.stages.moves import PIECE, Axes
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.io import InputError

OFFSET = {"X": 1.0, "Y": -2.0, "Z": 3.0, "A": 7.0, "B": 11.0}
NONE = dict.fromkeys("XYZAB", 0.0)
LEAN = math.radians(2.5)


def axis(letter, direction=1, zero=0.0, unit="deg"):
    kind = TiltAxis if unit == "deg" else TravelAxis
    scale = math.degrees(1.0) if unit == "deg" else 1.0
    return kind(letter=letter, direction=direction, zero=zero, limits=(-scale, scale), speed=10.0 * scale)


def axes(**changes):
    return Axes(stage_settings(**changes), "rig")


def words(line):
    return {word[0]: float(word[1:]) for word in re.findall(r"[A-Z]-?[\d.]+", line)}


def swept(line, start, plane):
    """The points of an arc as G-code means it: G3 turns from the plane's first axis to its second."""
    first, two = {"G17": "XY", "G18": "ZX", "G19": "YZ"}[plane]
    values = words(line)
    centre = [start[x] + values[{"X": "I", "Y": "J", "Z": "K"}[x]] for x in (first, two)]
    begin = math.atan2(start[two] - centre[1], start[first] - centre[0])
    end = math.atan2(values[two] - centre[1], values[first] - centre[0])
    radius = math.hypot(start[first] - centre[0], start[two] - centre[1])
    assert radius == pytest.approx(math.hypot(values[first] - centre[0], values[two] - centre[1]), abs=3e-5)
    turn = (end - begin) % math.tau if line.startswith("G3") else -((begin - end) % math.tau)
    angles = begin + np.linspace(0, turn, 25)
    return [{first: centre[0] + radius * np.cos(t), two: centre[1] + radius * np.sin(t)} for t in angles]


def path(commands, start, plane):
    points, at = [start], dict(start)
    for command in commands[1:]:
        assert command.line.startswith(("G2", "G3"))
        points += swept(command.line, at, plane)
        at = {x: words(command.line)[x] for x in at}
    return points


def test_the_machines_coordinate_is_zero_plus_direction_times_value():
    machine = axes().machine(Position(2.0, math.radians(1), math.radians(-3)))
    assert machine == pytest.approx({"Z": 8.0, "X": 31.0, "Y": 37.0})


def test_a_straight_move_names_the_machines_coordinates():
    command = axes().straight(Position(), Position(2.0), 4.0)
    assert command.line.startswith("G53G1")
    assert words(command.line) == pytest.approx({"G": 1, "Z": 8.0, "X": 30.0, "Y": 40.0, "F": 240.0})
    assert command.duration == pytest.approx(0.5)


def test_a_long_straight_move_is_sent_in_short_pieces_that_end_where_it_does():
    start, place = Position(), Position(2.0, math.radians(1), math.radians(-3))
    rig = axes()
    whole, pieces = rig.straight(start, place, 0.5), rig.pieces(start, place, 0.5)
    assert pieces[-1].line == whole.line
    assert sum(piece.duration for piece in pieces) == pytest.approx(whole.duration)
    assert max(piece.duration for piece in pieces) <= PIECE + 1e-9
    fraction = np.arange(1, len(pieces) + 1)[:, None] / len(pieces)
    ends = [[words(piece.line)[letter] for letter in "XYZ"] for piece in pieces]
    np.testing.assert_allclose(ends, [30, 40, 10] + fraction * [1.0, -3.0, -2.0], atol=1e-5)
    assert {words(piece.line)["F"] for piece in pieces} == {words(whole.line)["F"]}


@pytest.mark.parametrize(("speed", "ramp"), [(2.0, 0.5), (20.0, 5.0)])
def test_the_time_of_a_move_includes_that_to_speed_up_and_to_slow_down(speed, ramp):
    rig, path = axes(), Trapezoid(4.0, speed, 4.0)
    rig.limit_acceleration("travel", 4.0)
    rig.limit_acceleration("pitch", 0.001)  # it does not move
    pieces = rig.pieces(Position(), Position(4.0), speed)
    assert sum(piece.duration for piece in pieces) == pytest.approx(path.duration)
    assert {piece.ramp for piece in pieces} == {ramp}


@pytest.mark.parametrize("rate", [0.01, 0.1, 1.0, 5.0])
def test_no_arc_takes_long_however_slow_it_is(rate):
    arcs = axes().arcs(LEAN, 1.5, rate, 0.3, NONE)[1:]
    assert max(arc.duration for arc in arcs) <= PIECE + 1e-9
    assert sum(arc.duration for arc in arcs) == pytest.approx(1.5 / rate)


def test_without_a_speed_the_slowest_axis_sets_the_time():
    rig = axes()
    assert rig.straight(Position(), Position(2.0), None).duration == pytest.approx(0.1)
    tilted = rig.straight(Position(), Position(0.1, math.radians(5)), None)
    assert tilted.duration == pytest.approx(0.05)
    rig.limit("pitch", 50.0)
    assert rig.straight(Position(), Position(0.1, math.radians(5)), None).duration == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("place", "speed", "message"),
    [
        (Position(1), 20.1, "too fast for the axis of travel; the maximum is 20 mm/s"),
        (Position(1, 0.05), 19.0, r"too fast for the axis of pitch"),
        (Position(0, 0.05), 1.8, "the maximum is 1.745 rad/s"),
        (Position(1), 0.016, "too slow for the controller; the minimum is 1"),
        (Position(1), 0.0, "positive"),
        (Position(1), -1.0, "positive"),
        (Position(1), math.nan, "positive"),
        (Position(1), math.inf, "positive"),
    ],
)
def test_an_impossible_speed_is_refused(place, speed, message):
    rig = axes()
    rig.limit("pitch", math.degrees(0.1) if place.travel else 1e9)
    with pytest.raises(InputError, match=f"^rig: .*{message}"):
        rig.straight(Position(), place, speed)


@pytest.mark.parametrize(("turns", "start"), [(1.0, 0.0), (-1.0, 1.0), (0.25, 3.0), (-2.6, -2.0)])
@pytest.mark.parametrize("directions", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
@pytest.mark.parametrize(
    ("letters", "plane"),
    [("XY", "G17"), ("YX", "G17"), ("ZX", "G18"), ("XZ", "G18"), ("YZ", "G19"), ("ZY", "G19")],
)
def test_arcs_have_the_right_number_and_sense_of_turns(letters, plane, directions, start, turns):
    third = (set("XYZ") - set(letters)).pop()
    rig = axes(
        travel=axis(third, 1, 5.0, "mm"),
        pitch=axis(letters[0], directions[0], 30.0),
        roll=axis(letters[1], directions[1], -40.0),
    )
    commands = rig.arcs(LEAN, turns, 0.5, start, OFFSET)
    assert commands[0].line == plane
    assert sum(command.duration for command in commands) == pytest.approx(abs(turns) / 0.5)
    machine = rig.machine(Position(0, LEAN * math.cos(start), LEAN * math.sin(start)))
    points = path(commands, {x: machine[x] - OFFSET[x] for x in letters}, plane)
    places = [rig.place({third: 0.0} | {x: p[x] + OFFSET[x] for x in letters}) for p in points]
    np.testing.assert_allclose([place.tilt for place in places], LEAN, atol=1e-6)
    phase = np.unwrap([place.phase for place in places])
    assert np.all(np.diff(phase) * np.sign(turns) >= -1e-5)
    assert phase[-1] - phase[0] == pytest.approx(math.tau * turns, abs=1e-4)
    assert places[0].phase == pytest.approx(math.remainder(start, math.tau))


def test_every_line_of_a_precession_fits_a_line_of_the_controller():
    far = axes(pitch=axis("X", 1, -1234.56789), roll=axis("Y", -1, -1234.56789))
    assert max(len(command.line) for command in far.arcs(0.9, 100.0, 1.0, 1.234, NONE)) < 70


@pytest.mark.parametrize(
    ("tilt", "turns", "rate", "message"),
    [
        (LEAN, 1.0, 0.0, "a precession with .* is not possible"),
        (LEAN, 1.0, -1.0, "a precession with .* is not possible"),
        (LEAN, 0.0, 1.0, "a precession with .* is not possible"),
        (0.0, 1.0, 1.0, "a precession with .* is not possible"),
        (LEAN, math.inf, 1.0, "a precession with .* is not possible"),
        (LEAN, 1e300, 1.0, "too many"),
        (LEAN, -10_001.0, 1.0, "too many"),
        (LEAN, 9_000.0, 0.01, "take 250 hours; the maximum is 24 hours"),
        (LEAN, 1.0, math.nan, "a precession with .* is not possible"),
        (LEAN, 1.0, 6.4, "the maximum is 6.366"),
        (math.radians(0.01), 1.0, 0.1, "too slow for the controller"),
    ],
)
def test_an_impossible_precession_is_refused(tilt, turns, rate, message):
    with pytest.raises(InputError, match=f"^rig: .*{message}"):
        axes().arcs(tilt, turns, rate, 0.0, NONE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pitch": axis("A"), "roll": axis("B")}, "not support arcs in the axes A and B"),
        ({"pitch": axis("X"), "roll": axis("A")}, "not support arcs in the axes X and A"),
        ({"pitch": None, "roll": None}, "cannot lean"),
        ({"pitch": axis("X", unit="mm"), "roll": axis("Y")}, "same unit"),
    ],
)
def test_axes_that_span_no_plane_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        axes(**changes).arcs(LEAN, 1.0, 0.5, 0.0, NONE)
