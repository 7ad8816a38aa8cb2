"""The emulated stage moves as mechanics says: against closed forms, and within the limits by any program."""

from __future__ import annotations

import math

import numpy as np
import pytest
from grbl_bench import Bench
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

RATE, ACCELERATION = 30.0, 500.0  # the defaults, mm/s and mm/s^2


def path(bench: Bench, begin: float, end: float, count: int) -> NDArray[np.float64]:
    return np.array([bench.place(at) for at in np.linspace(begin, end, count)])


def begin_of_move(bench: Bench) -> float:
    """When the last line has been read, which is when its move begins."""
    return bench.now - 0.0005


def end_of_moves(bench: Bench) -> float:
    bench.until_rest()
    return bench.now


@pytest.mark.parametrize(
    ("distance", "speed"), [(10.0, 20.0), (1.0, 20.0), (0.5, 20.0), (-7.0, 5.0), (0.001, 20.0), (3.0, 30.0)]
)
def test_a_line_takes_the_time_of_its_trapezoid(distance: float, speed: float) -> None:
    bench = Bench()
    bench.send(f"G1X{distance}F{speed * 60}")
    begin = begin_of_move(bench)
    size = abs(distance)
    if size >= speed**2 / ACCELERATION:
        duration = size / speed + speed / ACCELERATION
    else:  # a triangle
        duration = 2 * math.sqrt(size / ACCELERATION)
    assert end_of_moves(bench) - begin == pytest.approx(duration, abs=1e-9)
    assert bench.place() == pytest.approx((distance, 0, 0), abs=1e-12)
    assert not bench.machine.moving()
    assert not bench.machine.moving(begin - 1e-6)
    assert bench.machine.moving(begin + 1e-6)
    assert bench.machine.moving(begin + duration - 1e-6)


def test_a_line_goes_by_its_trapezoid() -> None:
    bench = Bench()
    speed, distance = 20.0, 10.0
    bench.send(f"G1X{distance}F{speed * 60}")
    begin = begin_of_move(bench)
    ramp = speed / ACCELERATION
    duration = distance / speed + ramp
    time = np.linspace(0, duration, 333)
    expected = np.piecewise(
        time,
        [time < ramp, (time >= ramp) & (time <= duration - ramp), time > duration - ramp],
        [
            lambda t: ACCELERATION * t**2 / 2,
            lambda t: speed * t - speed * ramp / 2,
            lambda t: distance - ACCELERATION * (duration - t) ** 2 / 2,
        ],
    )
    np.testing.assert_allclose(path(bench, begin, begin + duration, 333)[:, 0], expected, atol=1e-9)
    assert bench.machine.speed(begin + duration / 2) == pytest.approx(speed)


def test_the_slowest_axis_limits_a_line_over_several() -> None:
    bench = Bench({110: 1800, 111: 600, 112: 1800, 120: 500, 121: 500, 122: 50})
    bench.send("G0X3Y4Z12")  # a unit vector of 3/13, 4/13, 12/13
    begin = begin_of_move(bench)
    speed = min(30 * 13 / 3, 10 * 13 / 4, 30 * 13 / 12)
    acceleration = min(500 * 13 / 3, 500 * 13 / 4, 50 * 13 / 12)
    assert bench.machine.speed(begin + 0.1) == pytest.approx(acceleration * 0.1)
    assert speed**2 / acceleration > 13  # a triangle
    assert end_of_moves(bench) - begin == pytest.approx(2 * math.sqrt(13 / acceleration))


@pytest.mark.parametrize("parts", [(4, 8, 10), (0.1, 0.3, 0.4, 10), (9.6, 9.9, 10), (0.01, 9.99, 10)])
def test_lines_in_line_are_one_line(parts: tuple[float, ...]) -> None:
    bench, other = Bench(), Bench()
    bench.write("G1F1200\n" + "".join(f"X{part}Y{part}\n" for part in parts))
    other.write("G1F1200\nX10Y10\n")
    assert bench.until_rest() == pytest.approx(other.until_rest(), abs=1e-9)


def test_a_line_that_turns_back_stops_first() -> None:
    bench = Bench()
    bench.write("G1X10F1200\nX0\n")
    bench.wait(0.001)
    assert bench.until_rest() == pytest.approx(2 * (10 / 20 + 20 / ACCELERATION))


@pytest.mark.parametrize(("x", "y"), [(0.0, 10.0), (7.0, 7.0), (-7.0, 7.0), (9.0, 1.0)])
def test_a_corner_is_passed_at_the_speed_of_a_circle_that_cuts_it(x: float, y: float) -> None:
    deviation, speed = 0.02, 20.0
    bench = Bench({11: deviation})
    bench.write(f"G1X10F{speed * 60}\nG91X{x}Y{y}\n")
    bench.wait(0.001)
    length = math.hypot(x, y)
    half = (math.pi - math.atan2(y, x)) / 2  # half the angle between the two
    radius = deviation * math.sin(half) / (1 - math.sin(half))
    bisector = np.array([x / length - 1, y / length])
    acceleration = ACCELERATION * np.linalg.norm(bisector) / np.abs(bisector).max()
    corner = min(speed, math.sqrt(acceleration * radius))

    def leg(distance: float, acceleration: float) -> float:
        ramps = (speed - corner) / acceleration + speed / acceleration
        passed = (speed**2 - corner**2) / (2 * acceleration) + speed**2 / (2 * acceleration)
        return ramps + (distance - passed) / speed

    second = ACCELERATION * length / max(abs(x), abs(y))
    assert bench.until_rest() == pytest.approx(leg(10, ACCELERATION) + leg(length, second), abs=1e-9)


def test_without_a_deviation_every_corner_is_a_stop() -> None:
    bench = Bench({11: 0})
    bench.write("G1X10F1200\nY10\n")
    bench.wait(0.001)
    assert bench.until_rest() == pytest.approx(2 * (10 / 20 + 20 / ACCELERATION))


@pytest.mark.parametrize("plane", ["G17", "G18", "G19"])
@pytest.mark.parametrize("turn", ["G2", "G3"])
def test_an_arc_is_a_circle(plane: str, turn: str) -> None:
    bench = Bench()
    first, second, other = {"G17": (0, 1, 2), "G18": (2, 0, 1), "G19": (1, 2, 0)}[plane]
    letters, offsets = "XYZ", "IJK"
    radius = 2.5
    bench.send(f"{plane}{turn}{letters[first]}0{offsets[first]}-{radius}F600")
    begin = begin_of_move(bench)
    bench.until_rest()
    places = path(bench, begin, bench.now, 2000)
    around = np.stack([places[:, first] + radius, places[:, second]])
    np.testing.assert_allclose(np.hypot(*around), radius, atol=1e-9, rtol=0)
    np.testing.assert_array_equal(places[:, other], 0.0)
    angle = np.unwrap(np.arctan2(around[1], around[0]))
    step = np.diff(angle) * (1 if turn == "G3" else -1)
    assert (step > -1e-12).all()  # time's rounding
    assert abs(angle[-1]) == pytest.approx(2 * np.pi)
    # At an even speed in between.
    middle = step[200:-200]
    assert middle.max() - middle.min() < 1e-8


def test_quarter_arcs_are_one_circle_at_an_even_speed() -> None:
    bench = Bench()
    bench.send("G1X2F600", "G3X0Y2I-2", "X-2Y0J-2", "X0Y-2I2", "X2Y0J2", "X0Y2I-2")
    begin = begin_of_move(bench)
    bench.until_rest()
    places = path(bench, begin + 1.0, begin + 1.5, 500)
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1]), 2, atol=1e-9, rtol=0)
    step = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert step.max() - step.min() < 1e-9


@pytest.mark.parametrize(
    ("line", "centre", "sweep"),
    [
        ("G2X3Y4R5", (4, -3 + 0), None),
        ("G2X10Y0R5", (5, 0), -math.pi),
        ("G3X10Y0R5", (5, 0), math.pi),
        ("G3X5Y5R5", (0, 5), math.pi / 2),
        ("G3X5Y5R-5", (5, 0), 3 * math.pi / 2),
        ("G2X5Y5R5", (5, 0), -math.pi / 2),
        ("G2X5Y5R-5", (0, 5), -3 * math.pi / 2),
    ],
)
def test_an_arc_by_its_radius_is_the_shorter_one_unless_that_is_negative(
    line: str, centre: tuple[float, float], sweep: float | None
) -> None:
    bench = Bench()
    bench.send(line + "F1200")
    begin = begin_of_move(bench)
    bench.until_rest()
    places = path(bench, begin, bench.now, 500)
    if sweep is None:  # known by its ends only: the radius is what was asked for
        x, y = 3.0, 4.0
        half = math.sqrt(25 - 25 / 4) / 5
        centre = (x / 2 + half * y, y / 2 - half * x)
    around = places[:, :2] - centre
    np.testing.assert_allclose(np.hypot(*around.T), 5, atol=1e-9)
    if sweep is not None:
        angle = np.unwrap(np.arctan2(around[:, 1], around[:, 0]))
        assert angle[-1] - angle[0] == pytest.approx(sweep, abs=1e-9)


def test_a_helix_rises_evenly() -> None:
    bench = Bench()
    bench.send("G3X0Y0Z3I2F600")
    begin = begin_of_move(bench)
    bench.until_rest()
    places = path(bench, begin, bench.now, 400)
    angle = np.unwrap(np.arctan2(places[:, 1], places[:, 0] - 2)) - np.pi
    np.testing.assert_allclose(places[:, 2], 3 * angle / (2 * np.pi), atol=1e-9)


def test_arcs_whose_ends_are_rounded_are_continuous() -> None:
    bench = Bench()
    radius, count = 2.5, 7
    points = [(radius * math.cos(a), radius * math.sin(a)) for a in np.arange(count + 1) * 2 * np.pi / count]
    bench.send("G1X2.5F900")
    x, y = 2.5, 0.0
    for u, v in points[1:]:
        bench.send(f"G3X{u:.3f}Y{v:.3f}I{-x:.3f}J{-y:.3f}")
        x, y = round(u, 3), round(v, 3)
    begin = bench.now - 0.002
    bench.until_rest()
    places = path(bench, begin + 0.3, bench.now, 3000)[:, :2]
    assert np.abs(np.hypot(*places.T) - radius).max() < 2e-3
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 1.001 * 15 * (bench.now - begin) / 2999


def test_an_arc_whose_ends_do_not_fit_is_continuous_all_the_same() -> None:
    bench = Bench()
    bench.send("G3X-2.004I-1F600")  # from a radius of 1 to one of 1.004
    begin = begin_of_move(bench)
    bench.until_rest()
    for at in (begin, bench.now):
        near = [bench.place(at + step) for step in (-1e-5, 1e-5)]
        assert math.dist(*near) < 1e-5
    assert bench.place() == pytest.approx((-2.004, 0, 0))


def test_moves_that_are_added_while_it_slows_down_wait_for_the_resume() -> None:
    bench = Bench()
    bench.send("G1X10F1200")
    bench.wait(0.2)
    bench.write("!")
    bench.wait(0.005)
    assert bench.send("X20") == ["ok"]
    bench.wait(1)
    assert bench.machine.state == "Hold:0"
    assert bench.place()[0] < 10
    bench.write("~")
    bench.until_rest()
    assert bench.place()[0] == 20


@pytest.mark.parametrize("line", ["G1X10F1200", "G2X0Y0I4F1200"])
def test_a_hold_takes_the_distance_of_even_slowing(line: str) -> None:
    bench = Bench()
    bench.send(line)
    begin = begin_of_move(bench)
    bench.wait(0.2)
    speed = bench.machine.speed()
    before = bench.place()
    bench.write("!")
    assert bench.machine.state == "Hold:1"
    rest = bench.machine.next_event()
    bench.wait(rest - bench.now)
    assert bench.machine.state == "Hold:0"
    acceleration = speed / (rest - begin - 0.2 - 0.0005)
    if line.startswith("G1"):
        assert speed == pytest.approx(20)
        assert acceleration == pytest.approx(ACCELERATION)
        gone = bench.place()[0] - before[0]
    else:  # a share of the acceleration points to the centre
        assert acceleration == pytest.approx(math.sqrt(ACCELERATION**2 - (speed**2 / 4) ** 2))
        a, b = (math.atan2(y, x - 4) for x, y, _ in (before, bench.place()))
        gone = 4 * abs(a - b)
    assert gone == pytest.approx(speed**2 / (2 * acceleration), abs=1e-9)
    held = bench.place()
    bench.wait(5)
    assert bench.place() == held


def test_a_hold_slows_down_over_the_ends_of_moves() -> None:
    bench = Bench()
    bench.write("G1X5F1200\n" + "".join(f"X{5 + n / 10:.1f}\n" for n in range(1, 10)))
    bench.wait(0.01 + 4.9 / 20)
    begin, before = bench.now, bench.place()[0]
    bench.write("!")
    bench.wait(1)
    assert bench.place()[0] - before == pytest.approx(20**2 / 2 / ACCELERATION, abs=1e-9)
    assert bench.machine.moving(begin + 20 / ACCELERATION - 1e-6)
    assert not bench.machine.moving(begin + 20 / ACCELERATION + 1e-6)


def test_what_was_held_goes_on_to_its_end() -> None:
    bench = Bench()
    bench.send("G1X10F1200")
    bench.wait(0.2)
    bench.write("!")
    bench.wait(1)
    left = 10 - bench.place()[0]
    bench.write("~")
    assert bench.machine.state == "Run"
    assert bench.until_rest() == pytest.approx(left / 20 + 20 / ACCELERATION)
    assert bench.place() == pytest.approx((10, 0, 0), abs=1e-12)
    assert bench.machine.state == "Idle"


def test_the_past_is_not_forgotten_while_it_is_in_memory() -> None:
    bench = Bench()
    bench.send("G1X10F1200")
    bench.wait(0.2)
    bench.write("!")
    bench.wait(0.1)
    times = np.linspace(bench.now - 0.4, bench.now, 50)
    seen = [bench.place(at) for at in times]
    bench.write("~")
    bench.send("X-5", "G2X-5Y0I1")
    bench.wait(0.3)
    bench.write("\x18")
    bench.wait(300)
    assert [bench.place(at) for at in times] == seen
    assert bench.place(0.0) == (0, 0, 0)


def test_what_is_long_past_is_forgotten() -> None:
    bench = Bench(memory=3.0)
    for _ in range(600):
        bench.send("G91G0X0.1", "X-0.1")
        bench.until_rest()
    spans = bench.machine._controller.planner._spans
    assert bench.now - 1000 > 20
    assert len(spans) < 1600  # of 2400
    assert spans[0].start > 1001
    assert spans[0].start < bench.now - 3
    assert bench.place(1000.0) == bench.place(spans[0].start)


def moves() -> st.SearchStrategy[list[str]]:
    number = st.integers(-6, 6)
    line = st.tuples(st.sampled_from(["G0", "G1"]), number, number, number).map(
        lambda v: f"G90{v[0]}X{v[1]}Y{v[2]}Z{v[3]}"
    )
    arc = st.tuples(st.sampled_from(["G2", "G3"]), number, number.filter(bool), st.integers(-2, 2)).map(
        lambda v: f"G91{v[0]}X{v[2]}Y{v[1]}Z{v[3]}R{math.hypot(v[1], v[2]):.3f}"
    )
    circle = st.tuples(st.sampled_from(["G2", "G3"]), number.filter(bool)).map(
        lambda v: f"G91{v[0]}X0I{v[1]}"
    )
    return st.lists(st.one_of(line, arc, circle), min_size=1, max_size=25)


@settings(max_examples=25, deadline=None)
@given(
    moves(),
    st.sampled_from([300, 900, 3000]),
    st.lists(st.tuples(st.floats(0.01, 0.6), st.sampled_from("!~")), max_size=6),
    st.lists(st.floats(0.0, 0.3), min_size=1, max_size=5),
)
def test_any_program_keeps_to_the_limits_of_speed_and_acceleration(
    program: list[str], feed: int, wishes: list[tuple[float, str]], pauses: list[float]
) -> None:
    limits = {110: 1800, 111: 1200, 112: 600, 120: 500, 121: 300, 122: 200}
    bench = Bench(limits | {11: 0})
    rate = np.array([limits[110 + n] / 60 for n in range(3)])
    acceleration = np.array([limits[120 + n] for n in range(3)])
    begin = bench.now
    oks = bench.send(f"F{feed}").count("ok")
    seen = []
    for number, line in enumerate(program):
        while bench.machine._controller.planner.free < 3:  # wait as a host would for the answers
            bench.wait(0.05)
            bench.write("~")
        bench.write(line + "\n")
        bench.wait(pauses[number % len(pauses)] + 0.0015)
        seen.append((bench.now, bench.place()))
        oks += bench.hear().count("ok")
    for pause, wish in wishes:
        bench.wait(pause)
        bench.write(wish)
    bench.wait(1)
    bench.write("~")
    bench.until_rest()
    oks += bench.hear().count("ok")
    assert oks == len(program) + 1
    assert bench.machine.state == "Idle"
    np.testing.assert_allclose(bench.place(), bench.machine._controller.program.place, atol=1e-9)
    assert all(bench.place(at) == place for at, place in seen)

    step = max(0.003, (bench.now - begin) / 6000)
    places = path(bench, begin, bench.now, int((bench.now - begin) / step))
    step = (bench.now - begin) / (len(places) - 1)
    speeds = np.abs(np.diff(places, axis=0))
    assert (speeds <= rate * step * (1 + 1e-6) + 1e-9).all()
    # What is nearly straight on is no corner: 1.5 thousandths of the speed may change at once.
    change = np.abs(np.diff(places, n=2, axis=0))
    assert (change <= acceleration * step**2 + 1.5e-3 * rate.max() * step + 1e-9).all()
