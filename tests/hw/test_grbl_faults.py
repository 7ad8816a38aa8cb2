from __future__ import annotations

import math
import random
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from scripted_grbl import ScriptedGrbl, stage_settings

from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl import link
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.stage import Position

SOON = 30.0  # seconds: a limit for a busy machine; most takes a fraction of a second


@pytest.fixture
def moving():
    """A stage half way to somewhere."""
    port = ScriptedGrbl()
    stage = GrblStage(stage_settings(), port)
    stage.move(Position(-4.5), 0.5)
    yield stage, port
    begun = time.monotonic()
    stage.close()
    assert time.monotonic() - begun < SOON
    assert port.closed


def failure(stage):
    """What `wait` raises, and after how many seconds."""
    begun = time.monotonic()
    with pytest.raises(HardwareError) as caught:
        stage.wait()
    assert stage.error is not None
    return str(caught.value), time.monotonic() - begun


def until(condition, seconds=SOON):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def test_silence_in_motion_stops_it_however_seldom_it_is_asked_at_rest():
    port = ScriptedGrbl()
    with GrblStage(stage_settings(report_rate=0.2, silence=0.07), port) as stage:
        stage.move(Position(-4.5), 0.5)
        before = port.bytes.count(b"?")
        until(lambda: port.bytes.count(b"?") > before + 3)
        port.silent, begun = True, time.monotonic()
        told, seconds = failure(stage)
        assert "no longer answers" in told
        assert seconds < SOON
        assert port.held_at - begun < SOON
        until(lambda: port.reset_at)


def test_silence_at_rest_is_borne_for_the_timeout():
    port = ScriptedGrbl()
    with GrblStage(stage_settings(timeout=0.3), port) as stage:
        port.silent, begun = True, time.monotonic()
        until(lambda: port.held_at)
        assert port.held_at - begun > 0.3
        assert "no longer answers" in str(stage.error)


@pytest.mark.parametrize("noise", [random.Random(3).randbytes(100_000), b"a\n" * 500_000])
def test_noise_stops_it_and_keeps_nobody_waiting(moving, noise):
    stage, port = moving
    port.inject(noise)
    told, seconds = failure(stage)
    assert "garbled" in told
    assert seconds < SOON
    until(lambda: port.held_at and port.reset_at)
    assert port.bytes.count(b"!") < 100, "it is not told at each piece"


def test_a_little_noise_is_borne(moving):
    stage, port = moving
    for _ in range(5):
        port.inject(b"\xff\x00z\n")
        port.inject(b"<Idle|MPos:0.0")
        asked = port.bytes.count(b"?")
        until(lambda asked=asked: port.bytes.count(b"?") > asked)
    assert stage.error is None
    assert stage.report().state == "run"


def test_an_unplugged_stage_says_so_at_once(moving):
    stage, port = moving
    port.gone = True
    told, seconds = failure(stage)
    assert "the line is lost" in told
    assert "switch it off" in told
    assert seconds < SOON
    stage.stop()
    for ask in (stage.report, stage.wait, lambda: stage.move(Position())):
        with pytest.raises(HardwareError, match="line is lost"):
            ask()


@pytest.mark.parametrize("code", [1, 99])
def test_an_alarm_ends_the_wait(moving, code):
    stage, port = moving
    port.alarm(code)
    told, _ = failure(stage)
    assert f"ALARM:{code}" in told
    with pytest.raises(HardwareError, match=f"ALARM:{code}"):
        stage.report()


def test_an_alarm_whose_line_was_lost_shows_in_the_reports(moving):
    stage, port = moving
    port.state = "Alarm"
    port._plan.clear()
    assert "in alarm" in failure(stage)[0]


def test_a_reset_by_others_is_told(moving):
    stage, port = moving
    with port._lock:
        port.reset()
    assert "was reset" in failure(stage)[0]


@pytest.mark.parametrize("answer", ["ok", "error:9"])
def test_an_answer_to_another_program_is_told(moving, answer):
    stage, port = moving
    port.say(answer)
    assert "it answered a line that nobody here sent" in failure(stage)[0]


@pytest.mark.parametrize("state", ["Hold:0", "Door:1"])
def test_a_state_that_nobody_asked_for_is_told(moving, state):
    stage, port = moving
    port.state = state
    assert f"the state {state.split(':')[0].lower()} unasked" in failure(stage)[0]


@pytest.mark.parametrize("place", [(30, 40, 6.7), (30, 40, 15.1), (34, 44, 10)])
def test_a_report_from_beyond_the_limits_stops_it(moving, place):
    stage, port = moving
    with port._lock:
        port.place[:] = place
        port._plan[:] = [(list(place), 60.0)]
    assert "beyond its limits" in failure(stage)[0]
    assert "beyond its limits" in str(stage.error)
    assert port.held_at


def test_a_stage_that_begins_beyond_its_limits_can_come_back_but_go_no_farther():
    port = ScriptedGrbl(place=(30.0, 40.0, 17.0))
    with GrblStage(stage_settings(), port) as stage:
        stage.move(Position(-4.0))
        assert stage.wait().position.travel == pytest.approx(-4)
    port = ScriptedGrbl(place=(30.0, 40.0, 17.0))
    with GrblStage(stage_settings(), port) as stage:
        port.on_move = lambda: port._plan.append(([30.0, 40.0, 19.0], 0.5))
        stage.move(Position(-7 + 2.01))
        assert "beyond its limits" in failure(stage)[0]


def test_homing_may_end_beyond_the_limits():
    port = ScriptedGrbl(settings={22: 1})
    with GrblStage(stage_settings(home=True), port) as stage:
        stage.move(Position(1.0))
        stage.wait()
        port.place[2] = 17.0
        stage.home()
        assert stage.report().position.travel == pytest.approx(-7)
        stage.move(Position(-1.0))
        stage.wait()


def test_a_stage_that_rests_elsewhere_than_it_was_sent_says_so():
    port = ScriptedGrbl()
    with GrblStage(stage_settings(), port) as stage:
        port.on_move = lambda: port._plan.__setitem__(-1, ([30.0, 40.0, 8.0], 0.1))
        stage.move(Position(1.0), 10.0)
        told, _ = failure(stage)
        assert "rests 1 mm or degrees from where it was sent" in told
        assert str(stage.error) == told


def test_the_steps_of_a_coarse_axis_are_no_fault():
    port = ScriptedGrbl(settings={101: 10})
    with GrblStage(stage_settings(), port) as stage:
        port.on_move = lambda: port._plan.__setitem__(-1, ([30.05, 40.0, 9.0], 0.1))
        stage.move(Position(1.0), 10.0)
        stage.wait()


def test_a_work_offset_that_changes_stops_it():
    port = ScriptedGrbl(work=True)
    with GrblStage(stage_settings(), port) as stage:
        port.offset[2] += 0.001
        until(lambda: stage.error)
        assert "work offset was changed" in str(stage.error)
        with pytest.raises(HardwareError, match="work offset"):
            stage.move(Position(1))


def test_a_refused_move_stops_the_stage():
    port = ScriptedGrbl()
    with GrblStage(stage_settings(), port) as stage:
        stage.move(Position(-1), 4.0)
        port._run = lambda line: port.say("error:15")
        with pytest.raises(HardwareError, match="error:15") as caught:
            stage.move(Position(2), 20.0)
        assert "G53G1Z8" in str(caught.value)
        assert port.held_at


def test_an_answer_that_was_lost_is_told():
    port = ScriptedGrbl()
    with GrblStage(stage_settings(), port) as stage:
        port._run = lambda line: port.say("o")
        with pytest.raises(HardwareError, match="without having answered"):
            stage.move(Position(1))


def test_a_stage_that_does_not_come_to_rest_in_time_is_stopped(moving):
    stage, port = moving
    with pytest.raises(HardwareError, match="did not come to rest within"):
        stage.wait(0.1)
    assert port.held_at
    assert "stopped" in str(stage.error)


def test_a_stop_goes_out_at_once_and_ends_others_waits(moving):
    stage, port = moving
    told = []
    other = threading.Thread(target=lambda: told.append(failure(stage)[0]))
    other.start()
    time.sleep(0.1)
    begun = time.monotonic()
    stage.stop()
    assert port.held_at is not None
    other.join(SOON)
    assert "was stopped" in told[0]
    assert time.monotonic() - begun < SOON
    until(lambda: port.reset_at)
    assert port.bytes.rindex(b"!") < port.bytes.index(b"\x18")
    stage.stop()
    stage.stop()
    assert port.state == "Idle"


def test_a_stop_needs_nobody_elses_lock(moving):
    stage, port = moving
    taken, done = threading.Event(), threading.Event()

    def keep():
        with stage._link.lock:
            taken.set()
            done.wait(SOON)

    other = threading.Thread(target=keep)
    other.start()
    taken.wait(SOON)
    stage.stop()
    assert port.held_at is not None
    assert other.is_alive(), "it waited for the lock"
    done.set()
    other.join(SOON)


def test_nothing_more_is_sent_after_a_stop():
    port = ScriptedGrbl()
    with GrblStage(stage_settings(), port) as stage:
        lean = math.radians(2.5)
        stage.move(Position(0, lean))
        stage.wait()
        stage.precess(lean, 50.0, 5.0)
        stage.stop()
        until(lambda: port.reset_at)
        time.sleep(0.1)
        assert b"G" not in port.bytes[port.bytes.index(b"\x18") :]
        assert not port.moving()


def test_a_machine_that_never_holds_is_reset_all_the_same(moving):
    stage, port = moving
    port._hold = lambda: None
    stage.stop()
    until(lambda: port.reset_at)
    assert port.state == "Alarm"


@pytest.mark.parametrize("what", ["lost", "undone"])
def test_a_hold_that_is_lost_or_undone_is_told_again(moving, what):
    stage, port = moving
    hold, told = port._hold, []

    def once(*_):
        told.append(port.state)
        if what == "undone" or len(told) > 1:
            hold()
        if what == "undone" and len(told) == 1:
            port.state = "Run"

    port._hold = once
    stage.stop()
    until(lambda: port.reset_at)
    assert len(told) > 1
    assert port.state == "Idle", "it was held when it was reset"


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_whatever_interrupts_a_wait_stops_the_stage(moving, monkeypatch, error):
    stage, port = moving

    def interrupted(*_):
        raise error

    monkeypatch.setattr(stage, "_arrived", interrupted)
    with pytest.raises(error):
        stage.wait()
    assert port.held_at is not None
    assert "was stopped" in str(stage.error)


def test_a_move_that_is_interrupted_stops_the_stage():
    port = ScriptedGrbl()
    with GrblStage(stage_settings(), port) as stage:
        stage.move(Position(-0.1), 0.5)
        port.on_move = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            stage.move(Position(1), 0.5)
        assert port.held_at is not None


def test_a_stop_in_homing_resets_without_waiting_for_a_hold():
    port = ScriptedGrbl(settings={22: 1})
    with GrblStage(stage_settings(home=True), port) as stage:
        port.answers["$H"] = "[MSG:under way]"
        told = []
        other = threading.Thread(target=lambda: told.append(_home(stage)))
        other.start()
        until(lambda: "$H" in port.lines)
        stage.stop()
        assert port.reset_at is not None
        other.join(SOON)
        assert "was stopped" in told[0]


def test_homing_that_is_interrupted_is_reset_at_once(monkeypatch):
    port = ScriptedGrbl(settings={22: 1})
    with GrblStage(stage_settings(home=True), port) as stage:

        def interrupted(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(stage._link, "until", interrupted)
        with pytest.raises(KeyboardInterrupt):
            stage.home()
        assert port.reset_at is not None


def test_closing_that_is_interrupted_leaves_nothing_open(moving, monkeypatch):
    stage, port = moving
    before = threading.active_count()

    def sleep(seconds):
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        time.sleep(seconds)

    monkeypatch.setattr(link, "time", SimpleNamespace(sleep=sleep, monotonic=time.monotonic))
    with pytest.raises(KeyboardInterrupt):
        stage.close()
    assert port.held_at is not None
    assert port.closed
    assert threading.active_count() == before - 2


def _home(stage):
    with pytest.raises(HardwareError) as caught:
        stage.home()
    return str(caught.value)


FORGETFUL = """
from scripted_grbl import ScriptedGrbl, stage_settings
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.stage import Position

class Loud(ScriptedGrbl):
    def write(self, data):
        if data in (b"!", b"\\x18"):
            print(data, flush=True)
        return super().write(data)

stage = GrblStage(stage_settings(), Loud())
stage.move(Position(-4), 0.5)
raise RuntimeError("forgot to close it")
"""


def test_a_program_that_ends_without_closing_stops_the_stage():
    support = Path(__file__).parents[1] / "support"
    ended = subprocess.run(
        [sys.executable, "-c", FORGETFUL],
        env={"PYTHONPATH": str(support)},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert "forgot to close it" in ended.stderr
    said = ended.stdout.split()
    assert said[0] == "b'!'"
    assert r"b'\x18'" in said
