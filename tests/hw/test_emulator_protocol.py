"""The emulated controller speaks as GRBL 1.1 does: what it answers to what."""

from __future__ import annotations

import re
from itertools import pairwise

import pytest
from grbl_bench import Bench
from hypothesis import given, settings
from hypothesis import strategies as st

from mirrorskin.hw.emulator.gcode import GrblError
from mirrorskin.hw.emulator.port import GrblMachine

BANNER = ["", "Grbl 1.1h ['$' for help]"]


def test_it_greets() -> None:
    assert Bench().greeting == BANNER


def test_with_homing_it_is_locked_until_it_is_homed_or_told_otherwise() -> None:
    bench = Bench({22: 1})
    assert bench.greeting == [*BANNER, "[MSG:'$H'|'$X' to unlock]"]
    assert bench.send("G0X1") == ["error:9"]
    assert bench.send("$J=X1F100") == ["error:8"]
    assert bench.send("$G")[-1] == "ok"
    assert bench.send("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert bench.send("G0X1") == ["ok"]


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        ("", "ok"),
        ("(nothing but a comment)", "ok"),
        ("; and another", "ok"),
        (" g0 x1 (in small letters) y2 ; and spaces", "ok"),
        ("N10 G1 X1 F100", "ok"),
        ("/G0X1", "ok"),
        ("G21G90G94G54G17G40G49G91.1G61", "ok"),
        ("G20", "ok"),
        ("M3S1000", "ok"),
        ("M4", "ok"),
        ("M5M9", "ok"),
        ("M7", "ok"),
        ("M8", "ok"),
        ("M1", "ok"),
        ("T3", "ok"),
        ("G53G0X1", "ok"),
        ("G80", "ok"),
        ("G92X1", "ok"),
        ("G92.1", "ok"),
        ("G10L2P1X1Y2Z3", "ok"),
        ("G10L20P0X0", "ok"),
        ("G4P0", "ok"),
        ("G1", "error:22"),
        ("1", "error:1"),
        ("G0 X1 #", "error:1"),
        ("GX", "error:2"),
        ("G0X", "error:2"),
        ("G0X--1", "error:2"),
        ("G0X.", "error:2"),
        ("F-1", "error:4"),
        ("G4P-1", "error:4"),
        ("G5", "error:20"),
        ("G28", "error:20"),
        ("G38.2X1F1", "error:20"),
        ("G93", "error:20"),
        ("M6", "error:20"),
        ("G0A1", "error:20"),
        ("H1", "error:20"),
        ("G1.5X1", "error:20"),
        ("G0G1X1F1", "error:21"),
        ("G90G91", "error:21"),
        ("G54G55", "error:21"),
        ("G1X1", "error:22"),
        ("G1X1F0", "error:22"),
        ("G2X1I1", "error:22"),
        ("G10L2P1G1X1F1", "error:24"),
        ("G0X1X2", "error:25"),
        ("F1F2", "error:25"),
        ("G2F100", "error:26"),
        ("G92", "error:26"),
        ("G10L2P1", "error:26"),
        ("N99999999", "error:27"),
        ("G4", "error:28"),
        ("G10L2X1", "error:28"),
        ("G10P1X1", "error:28"),
        ("G10L2P7X1", "error:29"),
        ("G53G2X1I1F1", "error:30"),
        ("G80X1", "error:31"),
        ("G2Z1I1F100", "error:32"),
        ("G2X10I1F100", "error:33"),
        ("G2X0Y0R1F100", "error:33"),
        ("G2X10R1F100", "error:34"),
        ("G2X1Y1F100", "error:35"),
        ("G2X1Y1K1F100", "error:35"),
        ("G1X1F100I5", "error:36"),
        ("G0X1P2", "error:36"),
        ("G2X2I1P3F100", "error:36"),
        ("T256", "error:38"),
        ("G0X1" + "0" * 76, "error:11"),
        ("$", "ok"),
        ("$5", "error:3"),
        ("$99=1", "error:3"),
        ("$10=", "error:2"),
        ("$10=abc", "error:2"),
        ("$FOO", "error:2"),
        ("$10=-1", "error:4"),
        ("$110=0", "error:4"),
        ("$0=2", "error:6"),
        ("$20=1", "error:10"),
        ("$H", "error:5"),
        ("$J", "error:3"),
        ("$X1", "error:3"),
        ("$HX", "error:3"),
        ("$RST=*", "error:3"),
        ("$J=X1", "error:22"),
        ("$J=F100", "error:26"),
        ("$J=G1X1F100", "error:16"),
        ("$J=G53G92X1F100", "error:21"),
        ("$J=M3X1F100", "error:16"),
        ("$J=X1F100S1", "error:36"),
        ("$J=G91G20X1F100", "ok"),
        ("$J=G53X1F100", "ok"),
    ],
)
def test_a_line_is_answered(line: str, reply: str) -> None:
    assert Bench().send(line)[-1] == reply


@pytest.mark.parametrize("line", ["G10L2P1X5P2Z", "G92X5I1", "G91G21X1P1", "F500X1X1", "M3S5I1"])
def test_a_line_that_is_refused_changes_nothing(line: str) -> None:
    bench = Bench()
    bench.send("G1F100", "G92Y1", "G0X1")
    bench.until_rest()
    before = (bench.send("$G"), bench.send("$#"), bench.place())
    assert bench.send(line)[-1].startswith("error:")
    assert (bench.send("$G"), bench.send("$#"), bench.place()) == before


def test_each_end_of_line_is_answered_as_the_firmware_does() -> None:
    bench = Bench()
    bench.write("G21\r\n\r")
    bench.wait(0.01)
    assert bench.hear() == ["ok", "ok", "ok"]


def test_settings_are_listed_and_set() -> None:
    bench = Bench()
    assert bench.send("$110=1234.5") == ["ok"]
    assert bench.send("$10=3") == ["ok"]
    lines = bench.send("$$")
    assert lines[-1] == "ok"
    assert all(re.fullmatch(r"\$\d+=[\d.]+", line) for line in lines[:-1])
    assert {"$10=3", "$11=0.010", "$110=1234.500", "$132=200.000"} < set(lines)
    assert bench.send("$22=1", "$20=1") == ["ok"]
    bench.send("$22=0")
    assert "$20=0" in bench.send("$$")


def test_settings_that_cannot_be_are_refused_at_once() -> None:
    with pytest.raises(GrblError, match="error:3"):
        GrblMachine({77: 1})
    with pytest.raises(GrblError, match="error:10"):
        GrblMachine({20: 1})
    GrblMachine({20: 1, 22: 1})


def test_offsets_and_modes_are_told() -> None:
    bench = Bench()
    bench.send("G10L2P2X1.5Y-2", "G55G91G1F250M3S99T2", "G92Z3")
    assert bench.send("$G") == ["[GC:G1 G55 G17 G21 G91 G94 M3 M9 T2 F250 S99]", "ok"]
    lines = bench.send("$#")
    assert {"[G54:0.000,0.000,0.000]", "[G55:1.500,-2.000,0.000]", "[G92:0.000,0.000,-3.000]"} < set(lines)
    assert [line.split(":")[0] for line in lines[:-1]] == [
        *("[G54", "[G55", "[G56", "[G57", "[G58", "[G59", "[G28", "[G30", "[G92", "[TLO", "[PRB")
    ]
    assert bench.send("$I")[0].startswith("[VER:1.1h.")
    assert bench.send("$I")[1] == "[OPT:VM,15,128]"
    assert bench.send("$N") == ["$N0=", "$N1=", "ok"]
    assert bench.send("$")[0].startswith("[HLP:")


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        (["G0X1Y2Z3"], (1, 2, 3)),
        (["G91", "G0X1", "X1Y-1"], (2, -1, 0)),
        (["G20", "G0X1Y-2"], (25.4, -50.8, 0)),
        (["G10L2P1X10Y20", "G0X1Y1"], (11, 21, 0)),
        (["G10L2P1X10", "G53G0X1"], (1, 0, 0)),
        (["G0X5", "G10L20P1X1", "G0X2"], (6, 0, 0)),
        (["G0X5", "G92X1", "G0X2Y2"], (6, 2, 0)),
        (["G0X5", "G92X1", "G92.1", "G0X2"], (2, 0, 0)),
        (["G10L2P3Z-4", "G56G0Z1"], (0, 0, -3)),
        (["G1F600X1", "X2", "G0Y1"], (2, 1, 0)),
        (["G1X1F6", "F600X0", "X3"], (3, 0, 0)),
        (["G18G3X2Z0I1F600"], (2, 0, 0)),
        (["G0X1", "G2X1I1F900"], (1, 0, 0)),
        (["$J=G91X3F600"], (3, 0, 0)),
        (["G91", "$J=G90X3F600", "$J=X1F600"], (4, 0, 0)),
        (["G20", "$J=G21X3F600", "$J=X2F100"], (50.8, 0, 0)),
        (["G10L2P1X7", "$J=X1F900", "$J=G53Y3F900"], (8, 3, 0)),
        (["G0Z+1.", "Y.5"], (0, 0.5, 1)),
    ],
)
def test_a_program_leads_to_its_place(lines: list[str], place: tuple[float, float, float]) -> None:
    bench = Bench()
    for line in lines:
        assert bench.send(line) == ["ok"], line
        bench.until_rest()
    assert bench.place() == pytest.approx(place, abs=1e-9)


def test_more_axes_than_three_go_along() -> None:
    bench = Bench(axes="XYZAB")
    assert bench.send("G0A2B-1X1") == ["ok"]
    bench.until_rest()
    assert bench.machine.position() == pytest.approx({"X": 1, "Y": 0, "Z": 0, "A": 2, "B": -1})
    assert bench.status()["MPos"] == "1.000,0.000,0.000,2.000,-1.000"


def test_the_end_of_the_program_sets_the_modes_back() -> None:
    bench = Bench()
    bench.send("G20G91G55G18M3S10G1F10")
    assert bench.send("M30") == ["[MSG:Pgm End]", "ok"]
    assert bench.send("$G")[0] == "[GC:G1 G54 G17 G20 G90 G94 M5 M9 T0 F254 S10]"


def test_a_report_tells_state_place_speed_and_now_and_then_the_offset() -> None:
    bench = Bench()
    bench.send("G10L2P1X1Z-1.5", "G1X30F600")
    bench.wait(0.2)
    report = bench.status()
    assert report[""] == "Run"
    x = bench.place()[0]
    assert report["MPos"] == f"{x:.3f},0.000,0.000"
    assert 1 < x < 3
    assert report["FS"] == "600,0"
    assert report["WCO"] == "1.000,0.000,-1.500"
    seen = [bench.status() for _ in range(90)]
    assert [n for n, one in enumerate(seen) if "WCO" in one] == [29, 59, 89]
    assert "Ov" in seen[0] or "Ov" in seen[1]
    bench.until_rest()
    rest = [bench.status() for _ in range(60)]
    told = [n for n, one in enumerate(rest) if "WCO" in one]
    assert {b - a for a, b in pairwise(told[1:])} == {10}
    bench.send("G92X3")
    assert "WCO" in bench.status()


def test_what_a_report_holds_goes_by_settings() -> None:
    bench = Bench({10: 2})
    bench.send("G10L2P1X1", "G0X3")
    bench.until_rest()
    report = bench.status()
    assert report["WPos"] == "3.000,0.000,0.000"
    assert report["Bf"] == "15,128"
    assert "MPos" not in report
    bench.send("$10=1", "$13=1")
    assert bench.status()["MPos"] == "0.1575,0.0000,0.0000"


def test_questions_that_come_together_are_answered_once() -> None:
    bench = Bench()
    bench.write("???")
    assert len(bench.hear()) == 1


def test_realtime_bytes_are_no_part_of_a_line() -> None:
    bench = Bench()
    bench.write(b"G0?X\x90\x851~0\xff\n")
    bench.wait(0.01)
    assert bench.hear()[-1] == "ok"
    bench.until_rest()
    assert bench.place() == (10, 0, 0)


def test_the_sixteenth_move_is_answered_when_the_first_has_ended() -> None:
    bench = Bench({10: 3})
    heard = [bench.send("G91G1X1F60") for _ in range(15)]
    assert heard == [["ok"]] * 15
    assert bench.status()["Bf"] == "0,128"
    assert bench.send("X1") == []
    first = 1 / 1 + 0.5 / 500  # it need not slow down at the end
    begun = 1000.001
    bench.wait(begun + first - bench.now - 1e-6)
    assert bench.hear() == []
    bench.wait(2e-6)
    assert bench.hear() == ["ok"]


def test_what_the_receive_buffer_has_no_room_for_is_lost() -> None:
    bench = Bench({10: 3})
    for _ in range(16):
        bench.send("G91G1X10F600")
    assert bench.status()["Bf"] == "0,128"
    line = "X-1.00000\n"  # 10 bytes
    bench.write(line * 12 + "X-1.000")
    assert bench.status()["Bf"] == "0,1"
    bench.write("00\n")  # only the first byte finds room
    assert bench.status()["Bf"] == "0,0"
    bench.write(line * 3)
    bench.until_rest()
    bench.write("\n")
    bench.wait(0.01)
    bench.until_rest()
    assert bench.hear() == ["ok"] * 14  # the line that waited, 12 whole ones, one cut short
    assert bench.place()[0] == pytest.approx(160 - 13)


def test_a_host_that_counts_characters_loses_nothing() -> None:
    bench = Bench()
    bench.send("G91F1800")
    lines = [f"G1X{0.05 * (-1) ** (n // 10):.2f}\n" for n in range(200)]
    sent: list[int] = []
    waiting, answered = list(lines), 0
    while answered < len(lines):
        while waiting and sum(sent) + len(waiting[0]) <= 128:
            sent.append(len(waiting[0]))
            bench.write(waiting.pop(0))
        bench.wait(0.001)
        for reply in bench.hear():
            assert reply == "ok"
            del sent[0]
            answered += 1
        assert bench.now < 1100
    bench.until_rest()
    assert bench.place()[0] == pytest.approx(0, abs=1e-9)


def test_a_host_that_does_not_count_loses_lines() -> None:
    bench = Bench()
    bench.write("".join(f"G91G1X{n % 2 + 1}F1800\n" for n in range(100)))
    bench.until_rest()
    assert 0 < len(bench.hear()) < 100


def test_a_dwell_is_answered_when_its_time_has_passed() -> None:
    bench = Bench()
    bench.send("G1X1F600")
    end = 1000.001 + 0.1 + 10 / 500
    assert bench.send("G4P0.5") == []
    bench.wait(end + 0.49 - bench.now)
    assert bench.hear() == []
    assert bench.machine.state == "Idle"
    bench.wait(0.02)
    assert bench.hear() == ["ok"]


def test_a_hold_stretches_a_dwell() -> None:
    bench = Bench()
    bench.send("G4P0.5")
    bench.wait(0.2)
    bench.write("!")
    assert bench.machine.state == "Hold:0"
    bench.wait(10)
    bench.write("~")
    bench.wait(0.28)
    assert bench.hear() == []
    bench.wait(0.02)
    assert bench.hear() == ["ok"]


def test_a_change_of_offset_waits_for_the_motion() -> None:
    bench = Bench()
    bench.send("G1X1F600")
    assert bench.send("G92X0") == []
    bench.wait(0.2)
    assert bench.hear() == ["ok"]


def test_a_pause_waits_for_a_resume() -> None:
    bench = Bench()
    bench.send("G1X1F600", "M0")
    assert bench.send("X2") == []
    bench.wait(1)
    assert bench.machine.state == "Hold:0"
    assert bench.hear() == []
    bench.write("~")
    bench.wait(1)
    assert bench.hear() == ["ok", "ok"]
    assert bench.place() == (2, 0, 0)


def test_in_check_mode_nothing_moves() -> None:
    bench = Bench()
    assert bench.send("$C") == ["[MSG:Enabled]", "ok"]
    assert bench.machine.state == "Check"
    assert bench.send("G1X10F100") == ["ok"]
    assert bench.send("G4P5") == ["ok"]
    assert bench.send("G1X1Q") == ["error:2"]
    assert bench.send("G2X1F1") == ["error:35"]
    assert bench.send("$C") == ["[MSG:Disabled]", "ok", *BANNER]
    assert bench.place() == (0, 0, 0)


def test_settings_are_not_for_while_it_runs() -> None:
    bench = Bench()
    bench.send("G1X10F600")
    assert bench.send("$10=1") == ["error:8"]
    assert bench.send("$$") == ["error:8"]
    assert bench.send("$C") == ["error:8"]
    assert bench.send("$H") == ["error:8"]
    assert bench.send("$J=X1F100") == ["error:8"]
    assert bench.send("$G")[-1] == "ok"


def test_it_sleeps_until_a_reset() -> None:
    bench = Bench()
    assert bench.send("$SLP") == ["[MSG:Sleeping]", "ok"]
    assert bench.send("G0X1") == []
    assert bench.status()[""] == "Sleep"
    bench.write("\x18")
    assert bench.hear() == [*BANNER, "[MSG:'$H'|'$X' to unlock]"]


PIECES = st.one_of(
    st.binary(max_size=30),
    st.sampled_from(
        [
            *(
                b"?",
                b"!",
                b"~",
                b"\x18",
                b"\x85",
                b"\n",
                b"\r\n",
                b"$X\n",
                b"$H\n",
                b"$C\n",
                b"$SLP\n",
                b"M0\n",
            ),
            *(b"G0X5\n", b"G1Y-3F600\n", b"G2X1I1F900\n", b"$J=G91X1F500\n", b"G4P0.3\n", b"G92X1\n"),
            *(
                b"G91",
                b"G20",
                b"G53G0Z-99\n",
                b"G10L20P1X0\n",
                b"$20=1\n",
                b"$20=0\n",
                b"$21=1\n",
                b"G1X9999F1",
            ),
        ]
    ),
)
REPLY = re.compile(
    r"|ok|error:\d+|ALARM:\d|Grbl 1\.1h \['\$' for help\]|\[.*\]|\$N?\d+=[\d.]*"
    r"|<(Idle|Run|Hold:[01]|Jog|Alarm|Home|Check|Sleep)\|[MW]Pos:[-\d.,]+\|(Bf:\d+,\d+\|)?FS:\d+,\d+(\|.*)?>"
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(PIECES, st.floats(0, 2)), max_size=40), st.booleans())
def test_whatever_arrives_it_goes_on(events: list[tuple[bytes, float]], homing: bool) -> None:
    bench = Bench({22: homing, 24: 600, 25: 1800, 26: 1})
    for data, pause in events:
        bench.write(data)
        bench.wait(pause)
        for line in bench.hear():
            assert REPLY.fullmatch(line), line
        bench.machine.next_event()
    bench.write("\x18")
    assert BANNER[1] in bench.hear()
    bench.send("$X", "$21=0")
    assert bench.send("$20=0") == ["ok"]
    before = bench.place()
    assert bench.send("G91G0X-1") == ["ok"]
    bench.until_rest()
    assert bench.place() == pytest.approx((before[0] - 1, *before[1:]))
