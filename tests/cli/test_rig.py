"""Rig files on the command line: templates, and checks on an emulated controller and a film."""

import io
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from commands import refused, run
from simulated import write_film_rig

from mirrorskin.cli.commands import rig as command
from mirrorskin.hw import load_rig
from mirrorskin.hw.rig.check import CheckResult
from mirrorskin.twin.emulator.port import GrblLine, GrblMachine

RIG = """
[stage]
port = "{port}"
home = {home}
press = 2.0
[stage.travel]
letter = "Z"
direction = -1
zero = -5.0
limits = [-5.0, 3.0]
speed = 10.0
[stage.pitch]
letter = "X"
limits = [-5.0, 5.0]
speed = 30.0
[stage.roll]
letter = "Y"
limits = [-5.0, 5.0]
speed = 30.0
"""
MACHINE = {24: 600.0, 25: 3000.0, 26: 10.0, 27: 0.3, 132: 10.0} | dict.fromkeys((110, 111, 112), 1800.0)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def controller(folder, simulated, monkeypatch):
    """Plug in a controller with these settings, and write its rig file."""

    def plug_in(home=False, **settings):
        settings_set = (
            MACHINE | {22: float(home)} | {int(name[1:]): value for name, value in settings.items()}
        )
        line = GrblLine(GrblMachine(settings_set, start=dict.fromkeys("XYZ", -1.0), clock=simulated))
        monkeypatch.setattr("mirrorskin.hw.stages.grbl.open_port", lambda *_: line.open())
        write_film_rig(folder, RIG.format(port=line.url, home=str(home).lower()))
        return line

    return plug_in


def test_a_sound_rig_is_printed_in_a_table_and_nothing_moves(controller):
    machine = controller().machine
    before = machine.position()
    ended = run("rig check rig.toml")
    assert (ended.code, ended.said) == (0, "")
    assert machine.position() == before
    assert ended.out.split("\n")[0].split() == ["part", "what", "found", "remedy"]
    for text in (
        "stage +firmware +.*1[.]1",
        "stage +state +idle",
        "roll -?0.000 deg",
        "camera +pictures +8 x 6 uint8",
    ):
        assert re.search(f"^ok +.*{text}", ended.out, re.MULTILINE), ended.out


def test_a_rig_that_homes_and_moves_is_printed_in_json_and_ends_where_it_homed(controller):
    machine = controller(home=True).machine
    ended = run("rig check rig.toml --move --json")
    report = json.loads(ended.out)
    assert (ended.code, ended.said, report["sound"], report["rig"]) == (0, "", True, "rig")
    moves = {finding["what"]: finding["found"] for finding in report["findings"] if finding["part"] == "move"}
    assert list(moves) == ["homing", "travel (Z)", "pitch (X)", "roll (Y)"]
    assert moves["travel (Z)"] == "+0.5 mm and back, off by 0.0000 mm"
    assert machine.position()["Z"] == pytest.approx(-0.3, abs=0.01)
    assert not machine.moving()


def test_a_failure_is_printed_in_a_line_and_nothing_is_moved(controller):
    port = controller(home=True, s22=0.0)
    before = port.machine.position()
    ended = run("rig check rig.toml --move")
    assert ended.code == 1
    assert ended.said.startswith(
        "mirrorskin: rig.toml: stage, homing ($22): off: the file requires homing; set stage.home"
    )
    assert ended.said.count("\n") == 1
    assert "not tried" in ended.out
    assert port.machine.position() == before


def test_what_soft_limits_do_not_allow_is_refused_before_anything_moves(controller):
    port = controller(home=True, s20=1.0)
    before = port.machine.position()
    message = refused("", "rig check rig.toml --move")
    assert re.fullmatch(r"stage .*: stage.pitch.limits are -5 to 5 .* allow -\d+ to 0: .*", message)
    assert port.machine.position() == before


def test_a_stage_is_moved_by_hand_within_its_limits(controller):
    machine = controller().machine
    ended = run("rig jog rig.toml travel --by 0.5mm")
    assert (ended.code, ended.said) == (0, "")
    assert ended.out.startswith("rig: travel -4.500 mm, pitch 0.000 deg")
    assert machine.position() == pytest.approx({"X": -1.0, "Y": -1.0, "Z": -1.5})
    refused("beyond the axis", "rig jog rig.toml travel --by -1mm")
    assert run("rig jog rig.toml twist --by 1deg").said.startswith(
        "mirrorskin: rig.toml has no [stage.twist]"
    )


def test_a_leaning_stage_is_lifted_upright(controller, clock):
    port = controller()
    port.machine.receive(b"G53G1X2Y1Z-2F1800\n")
    clock.sleep(1.0)
    assert port.machine.position()["X"] == 1.0
    ended = run("rig", "lift", "rig.toml")
    assert (ended.code, ended.said) == (0, "")
    assert ended.out.startswith("rig: travel -5.000 mm, pitch 0.000 deg, roll 0.000 deg")


def test_an_alarm_is_ended_only_by_unlocking(controller):
    port = controller()
    port.alarm(9)
    message = refused("locked", "rig lift rig.toml")
    assert "'mirrorskin rig unlock'" in message
    assert port.machine.state == "Alarm"
    assert run("rig unlock rig.toml").code == 0
    assert port.machine.state == "Idle"


def test_a_hold_by_another_user_is_left_alone(controller, clock):
    port = controller()
    port.machine.receive(b"G53G1Z-8F10\n")
    clock.sleep(0.05)
    port.machine.receive(b"!")
    clock.sleep(0.2)
    ended = run("rig", "check", "rig.toml")
    assert (ended.code, ended.said.count("\n")) == (2, 1)
    assert "in the state hold" in ended.said
    assert port.machine.state == "Hold:0"


def test_a_stage_with_switches_is_homed_by_hand(controller):
    machine = controller(home=True).machine
    assert run("rig unlock rig.toml").out.endswith("locked: home it with 'mirrorskin rig home'\n")
    assert run("rig home rig.toml").code == 0
    assert machine.position() == pytest.approx({"X": -0.3, "Y": -0.3, "Z": -0.3})


def test_a_missing_camera_is_bad_input_and_the_stage_is_still_reported(controller):
    controller()
    Path("film.y4m").rename("other.y4m")
    ended = run("rig", "check", "rig.toml")
    assert ended.code == 2
    assert "film.y4m" in ended.said
    assert ended.said.count("\n") == 1
    assert "firmware" in ended.out


def test_a_missing_port_is_bad_input(folder):
    write_film_rig(folder, RIG.format(port="/dev/nowhere", home="true"))
    ended = run("rig", "check", "rig.toml", "--json")
    assert (ended.code, ended.out, ended.said.count("\n")) == (2, "", 1)
    assert "/dev/nowhere" in ended.said


def test_on_a_terminal_the_table_has_colours(folder, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stdout", Terminal())
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.delenv("NO_COLOR", raising=False)
    write_film_rig(folder, RIG.format(port="nowhere", home="true"))
    findings = [
        CheckResult("stage", "state", "[b]idle"),
        CheckResult("camera", "rate", "1 Hz", "failed", "mend it"),
    ]
    command._print(load_rig("rig.toml"), findings, True, False)
    text = sys.stdout.getvalue()
    assert "[b]idle" in text
    assert "\x1b[31mfailed\x1b[0m" in text
    assert "mend it" in text


def test_a_new_rig_file_can_be_loaded_and_is_never_written_over_another(folder):
    ended = run("rig new -o mine.toml")
    assert (ended.code, ended.said) == (0, "")
    assert "mirrorskin rig check mine.toml" in ended.out
    assert load_rig("mine.toml").stage.limits.press == 2.0
    before = (folder / "mine.toml").read_bytes()
    ended = run("rig new -o mine.toml")
    assert (ended.code, ended.said) == (
        2,
        "mirrorskin: mine.toml exists and is not replaced: choose another name with -o\n",
    )
    assert (folder / "mine.toml").read_bytes() == before


def test_a_full_disk_leaves_no_half_a_rig_file(tmp_path):
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500));"
        "from mirrorskin.cli.main import main; main()"
    )
    words = [sys.executable, "-B", "-c", code, "rig", "new", "-o", "mine.toml"]  # half a module would stay
    process = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stdout) == (2, "")
    assert process.stderr == (
        "mirrorskin: mine.toml could not be written: File too large; make room, or choose another place with"
        " -o\n"
    )
    assert not list(tmp_path.glob("*.toml"))
    assert not list(tmp_path.glob(".*"))
