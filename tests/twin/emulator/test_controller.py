"""The emulated controller replies and moves like GRBL 1.1 on a real machine."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mirrorskin.twin.emulator.port import GrblMachine
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

RATE, ACCELERATION = 30.0, 500.0  # the defaults, mm/s and mm/s^2
BANNER = ["", "Grbl 1.1h ['$' for help]"]
LOCKED = "[MSG:'$H'|'$X' to unlock]"
HOMED = {22: 1, 24: 60, 25: 600, 26: 10, 27: 0.5, 130: 20, 131: 30, 132: 10}


class Bench:
    """A controller on a table: lines in, lines out."""

    def __init__(self, settings: dict[int, float] | None = None, **options) -> None:
        self._clock = SimulatedClock()
        self.machine = GrblMachine(settings, clock=self._clock, **options)
        self.greeting = self.hear()

    @property
    def now(self) -> float:
        return self._clock.now()

    def wait(self, seconds: float) -> None:
        self._clock.sleep(seconds)

    def hear(self) -> list[str]:
        return self.machine.take().decode("ascii").splitlines()

    def write(self, text: str | bytes) -> None:
        self.machine.receive(text.encode("ascii") if isinstance(text, str) else text)

    def send(self, *lines: str) -> list[str]:
        """Send lines, give each the time to be read, and return what is said to the last."""
        heard: list[str] = []
        for line in lines:
            self.write(line + "\n")
            self.wait(0.0015)
            heard = self.hear()
        return heard

    def until_rest(self) -> float:
        """Let the time pass until nothing is due any more; return how long it took."""
        began = self.now
        while (due := self.machine.next_event()) < float("inf"):
            self.wait(max(0.0, due - self.now))
        return self.now - began

    def place(self, at: float | None = None) -> tuple[float, ...]:
        return tuple(self.machine.position(at).values())

    def path(self, begin: float, end: float, count: int) -> NDArray[np.float64]:
        return np.array([self.place(at) for at in np.linspace(begin, end, count)])

    def status(self) -> dict[str, str]:
        """Ask for a report; the state is under ""."""
        self.hear()
        self.write("?")
        (line,) = self.hear()
        state, *fields = line.strip("<>").split("|")
        return {"": state} | dict(field.split(":", 1) for field in fields)


def homed(changes: dict[int, float] | None = None, **options) -> Bench:
    bench = Bench({**HOMED, **(changes or {})}, **options)
    bench.send("$H")
    bench.until_rest()
    assert bench.hear() == ["ok"]
    return bench


# Lines and answers


def test_it_greets_and_with_homing_is_locked_until_unlocked() -> None:
    assert Bench().greeting == BANNER
    bench = Bench({22: 1})
    assert bench.greeting == [*BANNER, LOCKED]
    assert bench.send("G0X1") == ["error:9"]
    assert bench.send("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert bench.send("G0X1") == ["ok"]


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        ("", "ok"),
        ("g21 g90 g94", "ok"),
        ("G53G1X1Y-.5Z+2.F600", "ok"),
        ("G0 X1 #", "error:1"),
        ("G0X--1", "error:2"),
        ("G20", "error:20"),
        ("G0A1", "error:20"),
        ("M3S1", "error:20"),
        ("G90G91", "error:21"),
        ("G1X1", "error:22"),
        ("G0X1X2", "error:25"),
        ("G2F100", "error:26"),
        ("G2X2Z1I1F100", "error:20"),
        ("G2X10I1F100", "error:33"),
        ("G2X1Y1F100", "error:35"),
        ("G0X1" + "0" * 76, "error:11"),
        ("$H", "error:5"),
        ("$FOO", "error:2"),
    ],
)
def test_a_line_is_answered(line: str, reply: str) -> None:
    assert Bench().send(line)[-1] == reply


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        (["G0X1Y2Z3"], (1, 2, 3)),
        (["G91", "G0X1", "X1Y-1"], (2, -1, 0)),
        (["G91", "G53G0X1", "G53X1"], (1, 0, 0)),
        (["G1F600X1", "X2", "G0Y1"], (2, 1, 0)),
        (["G18G3X2Z0I1F600"], (2, 0, 0)),
        (["G0X1", "G2X1I1F900"], (1, 0, 0)),
        (["G1X1F600", "G0X5X6", "Y1"], (1, 1, 0)),  # what is refused changes nothing
    ],
)
def test_a_program_leads_to_its_place(lines: list[str], place: tuple[float, float, float]) -> None:
    bench = Bench()
    bench.send(*lines)
    bench.until_rest()
    assert bench.place() == pytest.approx(place, abs=1e-9)


def test_settings_and_build_are_reported() -> None:
    lines = Bench({110: 1234.5, 27: 0.5}).send("$$")
    assert lines[-1] == "ok"
    assert {"$110=1234.500", "$27=0.5", "$13=0", "$132=200.000"} < set(lines)
    assert Bench().send("$I") == ["[VER:1.1h.20190830:]", "[OPT:V,15,128]", "ok"]


def test_a_report_contains_state_place_speed_and_now_and_then_the_offset() -> None:
    bench = Bench()
    bench.send("G1X30F600")
    bench.wait(0.5)
    first = bench.status()
    assert (first[""], first["FS"], first["WCO"]) == ("Run", "600,0", "0.000,0.000,0.000")
    assert float(first["MPos"].split(",")[0]) == pytest.approx(bench.place()[0], abs=5e-4)
    assert ["WCO" in bench.status() for _ in range(20)] == [False] * 9 + [True] + [False] * 9 + [True]
    bench.write("???")  # questions that come together are answered once
    assert len(bench.hear()) == 1


def test_realtime_bytes_are_no_part_of_a_line() -> None:
    bench = Bench()
    bench.write(b"G0?X1~0\xff\n")
    bench.wait(1)
    assert bench.hear()[-1] == "ok"
    assert bench.place() == (10, 0, 0)


def test_the_sixteenth_move_is_answered_when_the_first_has_ended() -> None:
    bench = Bench()
    assert [bench.send("G91G1X1F60") for _ in range(15)] == [["ok"]] * 15
    assert bench.send("X1") == []
    bench.wait(1.1)
    assert bench.hear() == ["ok"]


@pytest.mark.parametrize("counts", [True, False])
def test_only_a_host_that_counts_characters_loses_nothing(counts: bool) -> None:
    bench = Bench()
    bench.send("G91F1800")
    lines = [f"G1X{0.05 * (-1) ** (n // 10):.2f}\n" for n in range(100)]
    sent: list[int] = []
    answered = 0
    for line in lines:
        while counts and sum(sent) + len(line) > 128:
            bench.wait(0.01)
            for _ in bench.hear():
                answered += 1
                sent.pop(0)
        bench.write(line)
        sent.append(len(line))
    bench.until_rest()
    answered += len(bench.hear())
    assert (answered == len(lines)) == counts


# Motion


@pytest.mark.parametrize(("distance", "speed"), [(10.0, 20.0), (0.5, 20.0), (-7.0, 5.0), (0.001, 20.0)])
def test_a_line_depends_on_its_trapezoid(distance: float, speed: float) -> None:
    bench = Bench()
    bench.send(f"G1X{distance}F{speed * 60}")
    begin, size = bench.now - 0.0005, abs(distance)
    top = min(speed, math.sqrt(size * ACCELERATION))
    ramp, duration = top / ACCELERATION, size / top + top / ACCELERATION
    bench.until_rest()
    assert bench.now - begin == pytest.approx(duration, abs=1e-9)
    time = np.linspace(0, duration, 333)
    expected = np.where(time < ramp, ACCELERATION * time**2 / 2, top * (time - ramp / 2))
    late = duration - time
    expected = np.where(late < ramp, size - ACCELERATION * late**2 / 2, expected)
    gone = bench.path(begin, begin + duration, 333)[:, 0] * np.sign(distance)
    np.testing.assert_allclose(gone, expected, atol=1e-9)
    assert bench.machine.speed(begin + duration / 2) == pytest.approx(top)
    assert [bench.machine.moving(begin + at) for at in (-1e-6, 1e-6, duration - 1e-6, duration)] == [
        0,
        1,
        1,
        0,
    ]


def test_the_slowest_axis_limits_a_line_over_several() -> None:
    bench = Bench({110: 1800, 111: 600, 112: 1800, 120: 500, 121: 500, 122: 50})
    bench.send("G0X3Y4Z12")  # a unit vector of 3/13, 4/13, 12/13
    begin = bench.now - 0.0005
    acceleration = min(500 * 13 / 3, 500 * 13 / 4, 50 * 13 / 12)
    bench.until_rest()
    assert bench.now - begin == pytest.approx(2 * math.sqrt(13 / acceleration))  # a triangle


def test_lines_in_line_are_one_line_and_a_corner_is_a_stop() -> None:
    bench, other = Bench(), Bench()
    bench.write("G1F1200\nX0.1Y0.1\nX9Y9\nX10Y10\n")
    other.write("G1F1200\nX10Y10\n")
    assert bench.until_rest() == pytest.approx(other.until_rest(), abs=1e-9)
    bench = Bench()
    bench.write("G1X10F1200\nY10\n")
    bench.wait(0.001)
    assert bench.until_rest() == pytest.approx(2 * (10 / 20 + 20 / ACCELERATION))


@pytest.mark.parametrize(("plane", "turn"), [("G17", "G2"), ("G18", "G3"), ("G19", "G2")])
def test_an_arc_is_a_circle_at_an_even_speed(plane: str, turn: str) -> None:
    bench = Bench()
    first, second, other = {"G17": (0, 1, 2), "G18": (2, 0, 1), "G19": (1, 2, 0)}[plane]
    letters, offsets, radius = "XYZ", "IJK", 2.5
    bench.send(f"{plane}{turn}{letters[first]}0{offsets[first]}-{radius}F600")
    begin = bench.now - 0.0005
    bench.until_rest()
    places = bench.path(begin, bench.now, 2000)
    around = np.stack([places[:, first] + radius, places[:, second]])
    np.testing.assert_allclose(np.hypot(*around), radius, atol=1e-9, rtol=0)
    np.testing.assert_array_equal(places[:, other], 0.0)
    angle = np.unwrap(np.arctan2(around[1], around[0]))
    step = np.diff(angle) * (1 if turn == "G3" else -1)
    assert (step > -1e-12).all()  # time's rounding
    assert abs(angle[-1]) == pytest.approx(2 * np.pi)
    assert np.ptp(step[200:-200]) < 1e-8


def test_half_arcs_with_rounded_ends_are_one_circle() -> None:
    bench = Bench()
    bench.send("G1X2.5F900", "G3X-2.4998Y0.001I-2.5", "X2.5Y0I2.4999J-0.001")
    begin = bench.now - 0.002
    bench.until_rest()
    places = bench.path(begin + 0.4, bench.now, 3000)[:, :2]
    assert np.abs(np.hypot(*places.T) - 2.5).max() < 2e-3
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 1.001 * 15 * (bench.now - begin) / 2999


def moves() -> st.SearchStrategy[list[str]]:
    number = st.integers(-6, 6)
    line = st.tuples(st.sampled_from(["G0", "G1"]), number, number, number).map(
        lambda v: f"G90{v[0]}X{v[1]}Y{v[2]}Z{v[3]}"
    )
    arc = st.tuples(st.sampled_from(["G2", "G3"]), number, number.filter(bool)).map(
        lambda v: f"G91{v[0]}X{2 * v[2]}Y{2 * v[1]}I{v[2]}J{v[1]}"
    )
    return st.lists(st.one_of(line, arc), min_size=1, max_size=15)


@settings(max_examples=15, deadline=None)
@given(moves(), st.lists(st.tuples(st.floats(0.01, 0.6), st.sampled_from("!~")), max_size=6))
def test_any_program_keeps_to_the_limits_of_speed_and_acceleration(
    program: list[str], wishes: list[tuple[float, str]]
) -> None:
    limits = {110: 1800, 111: 1200, 112: 600, 120: 500, 121: 300, 122: 200}
    bench = Bench(limits)
    rate = np.array([limits[110 + n] / 60 for n in range(3)])
    acceleration = np.array([limits[120 + n] for n in range(3)])
    begin = bench.now
    bench.send("F900")
    bench.send(*program)
    for pause, wish in wishes:
        bench.wait(pause)
        bench.write(wish)
    bench.wait(1)
    bench.write("~")
    bench.until_rest()
    assert bench.machine.state == "Idle"
    step = max(0.003, (bench.now - begin) / 4000)
    places = bench.path(begin, bench.now, int((bench.now - begin) / step))
    step = (bench.now - begin) / (len(places) - 1)
    assert (np.abs(np.diff(places, axis=0)) <= rate * step * (1 + 1e-6) + 1e-9).all()
    # What is nearly straight on is no corner: 1.5 thousandths of the speed may change at once.
    change = np.abs(np.diff(places, n=2, axis=0))
    assert (change <= acceleration * step**2 + 1.5e-3 * rate.max() * step + 1e-9).all()


def test_what_is_long_past_is_forgotten() -> None:
    bench = Bench(memory=3.0)
    bench.send("G91G0X0.1")
    bench.until_rest()
    here = bench.place(1000.005)
    for _ in range(600):
        bench.send("X0.1", "X-0.1")
        bench.until_rest()
    assert bench.place(1000.005) != here
    assert bench.place(bench.now) == pytest.approx((0.1, 0, 0))


# Stops


@pytest.mark.parametrize("line", ["G1X10F1200", "G2X0Y0I4F1200"])
def test_a_hold_slows_down_evenly_and_a_resume_goes_on(line: str) -> None:
    bench = Bench()
    bench.send(line)
    bench.wait(0.2)
    begin, speed = bench.now, bench.machine.speed()
    bench.write("!~")  # a resume is not heard while it slows down
    assert bench.machine.state == "Hold:1"
    bench.wait(1)
    assert bench.machine.state == "Hold:0"
    fraction = 1.0 if line.startswith("G1") else math.sqrt(1 - (speed**2 / 4 / ACCELERATION) ** 2)
    rest = begin + speed / (fraction * ACCELERATION)  # on an arc a part points to the centre
    assert bench.machine.moving(rest - 1e-6)
    assert not bench.machine.moving(rest + 1e-6)
    held = bench.place()
    assert bench.send("G0Y1") == []
    assert bench.place() == held
    bench.write("~")
    bench.until_rest()
    assert bench.place()[1] == 1
    assert bench.hear() == ["ok"]


def test_a_reset_in_a_move_stops_dead_and_locks() -> None:
    bench = Bench()
    for _ in range(15):
        bench.send("G91G1X1F600")
    assert bench.send("X1") == []
    bench.write("X1\nX1\nX")
    place = bench.place()
    bench.write("?\x18")  # of what waits nothing is left; the line at work counts as done
    assert bench.hear() == ["ALARM:3", "ok", *BANNER, LOCKED]
    bench.wait(10)
    assert bench.place() == place
    assert bench.status()[""] == "Alarm"
    assert bench.send("$X", "G91G0X1") == ["ok"]
    bench.until_rest()
    assert bench.place() == pytest.approx((place[0] + 1, 0, 0))


def test_a_reset_at_rest_or_held_is_not_an_alarm() -> None:
    bench = Bench()
    bench.write("\x18")
    assert bench.hear() == BANNER
    bench.send("G1X10F600")
    bench.wait(0.3)
    bench.write("!")
    bench.wait(0.1)
    bench.write("\x18")
    assert bench.hear() == BANNER
    assert bench.machine.state == "Idle"


def test_homing_finds_the_corner_and_takes_its_time() -> None:
    bench = homed(start={"X": -5.0, "Y": -8.0, "Z": -3.0})
    assert bench.place() == pytest.approx((-0.5, -0.5, -0.5))
    assert bench.status()["MPos"] == "-0.500,-0.500,-0.500"
    seek = sum(gone / 10 for gone in (5.0, 8.0, 3.0))  # at 600 a minute
    assert bench.now - 1000 > seek + 3 * (2 * 0.5 / 10 + 0.5)


def test_homing_can_fail_and_be_reset() -> None:
    bench = Bench(HOMED, start={"X": -31.0})
    bench.send("$H")
    bench.until_rest()
    assert "ALARM:9" in bench.hear()
    bench = Bench(HOMED, start={"X": -5.0})
    bench.send("$H")
    bench.wait(0.1)
    bench.write("?\x18")
    assert bench.hear()[0] == "ALARM:6"
    assert not bench.machine.moving()


@pytest.mark.parametrize(
    ("line", "allowed"),
    [
        ("G0X-19Y-29", True),
        ("G0X-20.1", False),
        ("G0Z0.1", False),
        ("G2X-4.5I-2F900", True),
        ("G3X-4.5I-2F900", False),  # its ends are within, its way is not
    ],
)
def test_the_soft_limits_look_at_the_whole_way(line: str, allowed: bool) -> None:
    bench = homed({20: 1})
    assert (bench.send(line)[0] == "ok") == allowed
    assert (bench.machine.state == "Alarm") != allowed


def test_a_move_beyond_the_soft_limits_stops_the_machine_before_it() -> None:
    bench = homed({20: 1})
    bench.send("G1X-15F600")
    bench.wait(0.3)
    assert bench.send("X-25") == []
    bench.wait(1)
    assert bench.hear() == ["ALARM:2", "[MSG:Reset to continue]"]
    assert -15 < bench.place()[0] < -3
    assert bench.send("?", "$X") == []  # it waits for a reset
    bench.write("\x18")
    assert bench.hear()[-2:] == [BANNER[1], LOCKED]


@pytest.mark.parametrize("code", [1, 3])
def test_an_alarm_can_be_raised_at_any_time(code: int) -> None:
    bench = Bench()
    bench.send("G1X10F600")
    bench.wait(0.3)
    bench.machine.alarm(code)
    assert bench.hear()[0] == f"ALARM:{code}"
    assert not bench.machine.moving()
    assert bench.machine.state == "Alarm"


def test_a_machine_without_power_is_dead() -> None:
    bench = Bench()
    bench.send("G1X10F600")
    bench.wait(0.3)
    place = bench.place()
    bench.machine.cut_power()
    bench.write("\x18?")
    bench.wait(5)
    assert (bench.hear(), bench.place()) == ([], place)
