"""How the emulated controller stops: holds, resets, jogs cut short, limits, homing and alarms."""

from __future__ import annotations

import pytest
from grbl_bench import Bench

BANNER = ["", "Grbl 1.1h ['$' for help]"]
LOCKED = "[MSG:'$H'|'$X' to unlock]"
HOMED = {22: 1, 24: 60, 25: 600, 26: 10, 27: 0.5, 130: 20, 131: 30, 132: 10}


def homed(settings: dict[int, float] | None = None, **options: float) -> Bench:
    bench = Bench({**HOMED, **(settings or {})}, **options)
    bench.send("$H")
    bench.until_rest()
    assert bench.hear() == ["ok"]
    return bench


def test_a_reset_in_a_move_stops_dead_and_locks() -> None:
    bench = Bench()
    bench.send("G92Y3", "G1X10F600")
    bench.wait(0.3)
    place = bench.place()
    assert bench.machine.moving()
    bench.write("\x18")
    assert not bench.machine.moving()
    assert bench.hear() == ["ALARM:3", *BANNER, LOCKED]
    bench.wait(10)
    assert bench.place() == place
    assert bench.machine.state == "Alarm"
    assert bench.send("G0X0") == ["error:9"]
    assert bench.send("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert bench.send("G91G0X1") == ["ok"]  # and G92 is forgotten
    bench.until_rest()
    assert bench.place() == pytest.approx((place[0] + 1, 0, 0))
    assert "[G92:0.000,0.000,0.000]" in bench.send("$#")


def test_a_reset_at_rest_or_held_is_no_alarm() -> None:
    bench = Bench()
    bench.write("\x18")
    assert bench.hear() == BANNER
    bench.send("G1X10F600")
    bench.wait(0.3)
    bench.write("!")
    bench.wait(0.1)
    place = bench.place()
    bench.write("\x18")
    assert bench.hear() == BANNER
    assert bench.machine.state == "Idle"
    assert bench.status()["MPos"].startswith(f"{place[0]:.3f},")
    bench.until_rest()
    assert bench.place() == place


def test_a_reset_while_it_slows_down_is_an_alarm() -> None:
    bench = Bench()
    bench.send("G1X10F1200")
    bench.wait(0.2)
    bench.write("!")
    bench.wait(0.01)
    bench.write("\x18")
    assert bench.hear()[0] == "ALARM:3"


def test_a_reset_forgets_what_waits_and_answers_the_line_at_work() -> None:
    bench = Bench()
    for _ in range(15):
        bench.send("G91G1X1F60")
    assert bench.send("X1") == []
    bench.write("X1\nX1\nX")
    bench.write("\x18")
    assert bench.hear() == ["ALARM:3", "ok", *BANNER, LOCKED]
    assert bench.send("$X")[-1] == "ok"
    bench.until_rest()
    assert bench.place()[0] < 0.1


def test_of_a_question_before_a_reset_nothing_is_left() -> None:
    bench = Bench()
    bench.write("?\x18")
    assert bench.hear() == BANNER


def test_a_hold_at_rest_holds_too() -> None:
    bench = Bench()
    bench.write("!")
    assert bench.status()[""] == "Hold:0"
    assert bench.send("G0X1") == []
    bench.wait(1)
    bench.write("~")
    bench.wait(1)
    assert bench.hear() == ["ok"]
    assert bench.place() == (1, 0, 0)


def test_a_resume_is_not_heard_while_it_slows_down() -> None:
    bench = Bench()
    bench.send("G1X10F1200")
    bench.wait(0.2)
    bench.write("!~")
    bench.wait(1)
    assert bench.machine.state == "Hold:0"


@pytest.mark.parametrize("byte", [b"!", b"\x85"])
def test_a_jog_is_cut_short_and_the_others_forgotten(byte: bytes) -> None:
    bench = Bench()
    assert bench.send("$J=X10F600", "$J=X20F600") == ["ok"]
    assert bench.status()[""] == "Jog"
    assert bench.send("G0X1") == ["error:9"]
    bench.wait(0.2)
    before = bench.place()[0]
    bench.write(byte)
    bench.until_rest()
    assert bench.machine.state == "Idle"
    assert bench.place()[0] == pytest.approx(before + 10**2 / 2 / 500)
    rest = bench.place()[0]
    assert bench.send("G91G0X1") == ["ok"]
    bench.until_rest()
    assert bench.place()[0] == pytest.approx(rest + 1)


def test_a_jog_that_waits_for_room_is_forgotten_too() -> None:
    bench = Bench()
    for _ in range(15):
        bench.send("$J=G91X1F60")
    assert bench.send("$J=G91X1F60") == []
    bench.write(b"\x85")
    bench.until_rest()
    assert bench.hear() == ["ok"]
    assert bench.place()[0] < 0.2


def test_a_jog_cancel_does_nothing_to_a_program() -> None:
    bench = Bench()
    bench.send("G1X1F600")
    bench.write(b"\x85")
    bench.until_rest()
    assert bench.place() == (1, 0, 0)


def test_homing_finds_the_corner_and_takes_its_time() -> None:
    bench = Bench(HOMED, start={"X": -15, "Y": -3, "Z": -9})
    assert bench.place() == (-15, -3, -9)
    assert bench.status()["MPos"] == "0.000,0.000,0.000"
    begin = bench.now
    assert bench.send("$H") == []
    bench.write("?G0")
    assert bench.hear() == []
    assert bench.machine.state == "Home"
    bench.until_rest()
    replies = bench.hear()
    assert [line for line in replies if not line.startswith("<")] == ["ok"]
    (report,) = [line for line in replies if line.startswith("<")]
    assert report.startswith("<Idle|MPos:-0.500,-0.500,-0.500|")

    def there(distance: float, speed: float) -> float:
        return distance / speed + speed / 500

    each = 2 * (0.5 / 10 + 10 / 500) + there(0.5, 1) + 4 * 0.010
    expected = sum(there(distance, 10) + each for distance in (15, 3, 9))
    assert bench.now - begin == pytest.approx(expected + 0.001, abs=1e-6)
    assert bench.place() == pytest.approx((-0.5, -0.5, -0.5))
    # Z goes first, and all of the way is continuous.
    assert bench.place(begin + 0.2)[:2] == (-15, -3)
    assert bench.place(begin + 0.2)[2] > -9
    assert max(bench.place(begin + n * 0.001)[0] for n in range(8000)) == pytest.approx(0, abs=1e-6)


def test_an_axis_may_home_the_other_way() -> None:
    bench = homed({23: 0b010}, start={"X": -15, "Y": -3, "Z": -9})
    assert bench.place() == pytest.approx((-0.5, -29.5, -0.5))
    assert bench.status()["MPos"] == "-0.500,-29.500,-0.500"


def test_a_switch_that_is_pressed_already_is_only_left() -> None:
    bench = Bench(HOMED, start={"X": 0.3, "Y": -3, "Z": -9})
    begin = bench.now
    bench.send("$H")
    bench.until_rest()
    xs = [bench.place(begin + n * 0.01)[0] for n in range(int((bench.now - begin) * 100))]
    assert xs[0] == 0.3
    pulled = xs.index(min(xs))
    assert xs[:pulled] == sorted(xs[:pulled], reverse=True)
    assert bench.place() == pytest.approx((-0.5, -0.5, -0.5))


def test_a_switch_that_is_too_far_away_is_an_alarm() -> None:
    bench = Bench(HOMED, start={"Z": -16.0})
    bench.send("$H")
    bench.until_rest()
    assert bench.hear() == ["ALARM:9", "ok", *BANNER, LOCKED]
    assert bench.place()[2] == pytest.approx(-1)


def test_a_reset_while_homing_is_an_alarm() -> None:
    bench = Bench(HOMED, start={"Z": -8.0})
    bench.send("$H")
    bench.wait(0.2)
    bench.write("!")
    bench.wait(0.01)
    assert bench.machine.moving()  # a hold is not heard now
    bench.write("\x18")
    assert bench.hear() == ["ALARM:6", "ok", *BANNER, LOCKED]
    assert not bench.machine.moving()


def test_a_hold_while_homing_is_heard_afterwards() -> None:
    bench = Bench(HOMED, start={"Z": -8.0})
    bench.send("$H")
    bench.wait(0.2)
    bench.write("!")
    bench.until_rest()
    assert bench.machine.state == "Hold:0"
    bench.write("~")
    assert bench.machine.state == "Idle"


def test_a_move_beyond_the_soft_limits_stops_the_machine_before_it() -> None:
    bench = homed({20: 1})
    bench.send("G53G1X-5F600")
    bench.wait(0.2)
    assert bench.machine.moving()
    assert bench.send("G53X-20.1") == []
    bench.wait(0.1)
    assert bench.hear() == ["ALARM:2", "[MSG:Reset to continue]"]
    assert not bench.machine.moving()
    place = bench.place()
    assert -5 < place[0] < -2
    bench.write("?")
    assert bench.send("$X") == []
    bench.write("\x18")
    assert bench.hear() == ["ok", *BANNER, LOCKED]
    assert bench.send("$X")[-1] == "ok"
    assert bench.status()["MPos"].startswith(f"{place[0]:.3f}")


@pytest.mark.parametrize(
    ("line", "allowed"),
    [
        ("G0X-20", True),
        ("G0X-20.001", False),
        ("G0X0", True),
        ("G0X0.001", False),
        ("G0Z-10.1", False),
        ("G2X-0.5Y-0.5I-3J-3F900", False),  # touches both walls
        ("G2X-0.5Y-0.5I-3F900", False),
        ("G2X-0.5Y-0.5J-3F900", False),
        ("G3X-6.5I-3F900", False),  # a half circle on the wrong side
        ("G2X-6.5I-3F900", True),
    ],
)
def test_the_soft_limits_look_at_the_whole_way(line: str, allowed: bool) -> None:
    bench = homed({20: 1})
    bench.send(line)
    bench.until_rest()
    assert (bench.machine.state == "Alarm") != allowed


def test_a_jog_beyond_the_soft_limits_is_refused() -> None:
    bench = homed({20: 1})
    assert bench.send("$J=X-30F600") == ["error:15"]
    assert bench.machine.state == "Idle"
    assert bench.send("$J=G91X-1F600") == ["ok"]
    bench.until_rest()
    assert bench.place()[0] == pytest.approx(-1.5)


@pytest.mark.parametrize(
    ("line", "met"),
    [("G0X5", (0, -0.5)), ("G0X-50", (-20, -0.5)), ("G2X-0.5Y-0.5I-3J-3F900", (-6, 0)), ("G0X-19", None)],
)
def test_a_hard_limit_stops_the_machine_dead(line: str, met: tuple[float, float] | None) -> None:
    bench = homed({21: 1})
    bench.send(line)
    bench.until_rest()
    if met is None:
        assert bench.machine.state == "Idle"
        return
    assert bench.hear()[-2:] == ["ALARM:1", "[MSG:Reset to continue]"]
    if line.startswith("G0"):
        assert bench.place()[:2] == pytest.approx(met, abs=1e-6)
    bench.write("\x18")
    bench.send("$X")
    bench.send("G53G0X-10Y-10")
    bench.until_rest()
    assert bench.place()[:2] == pytest.approx((-10, -10))


def test_a_hard_limit_is_met_at_full_speed_by_the_time_it_takes() -> None:
    bench = homed({21: 1})
    begin = bench.now + 0.001
    bench.send("G1X-100F900")
    bench.until_rest()
    way, speed = 19.5, 15.0
    assert bench.now - begin == pytest.approx(way / speed + speed / 2 / 500, abs=1e-6)
    assert not bench.machine.moving(bench.now)
    assert bench.machine.speed(bench.now - 1e-4) == pytest.approx(speed)


@pytest.mark.parametrize("code", [1, 2, 3, 8])
def test_an_alarm_can_be_raised_at_any_time(code: int) -> None:
    bench = Bench()
    bench.send("G1X10F600")
    bench.wait(0.2)
    bench.machine.alarm(code)
    heard = bench.hear()
    assert heard[0] == f"ALARM:{code}"
    assert heard[1:] == (["[MSG:Reset to continue]"] if code < 3 else [*BANNER, LOCKED])
    assert not bench.machine.moving()
    assert bench.machine.state == "Alarm"


def test_an_alarm_that_asks_for_a_reset_leaves_all_else_unanswered() -> None:
    bench = Bench()
    bench.machine.alarm(1)
    bench.hear()
    bench.write("?~!")
    assert bench.send("$X") == []
    bench.write("\x18")
    assert bench.hear() == [*BANNER, LOCKED]


def test_a_machine_without_power_is_dead() -> None:
    bench = Bench()
    bench.send("G1X10F600")
    bench.wait(0.2)
    bench.machine.cut_power()
    place = bench.place()
    bench.write("?\x18G0X1\n")
    bench.machine.alarm(1)
    bench.wait(10)
    assert bench.hear() == []
    assert bench.place() == place
    assert bench.machine.next_event() == float("inf")
