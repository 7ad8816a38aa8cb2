"""After any fault of a GRBL controller or its line the stage stops, and the message states the cause."""

from __future__ import annotations

import math
import random
import subprocess
import sys
from pathlib import Path

import pytest
from scripted_grbl import ScriptedGrbl

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.stage import Position

SOON = 0.1  # seconds in which everything that happens in motion is noticed


@pytest.fixture
def moving(opened):
    """A stage half way to somewhere."""
    stage, port = opened()
    stage.move(Position(-4.5), 0.5)
    return stage, port


def failure(stage, within=SOON):
    """What `wait` raises, in some seconds at most."""
    begun = stage._link.clock.now()
    with pytest.raises(HardwareError) as caught:
        stage.wait()
    assert stage.error is not None
    assert stage._link.clock.now() - begun <= within
    return str(caught.value)


@pytest.mark.parametrize("report_rate", [0.2, 20.0, 100.0])
@pytest.mark.parametrize("silence", [0.07, 0.2])
def test_silence_in_motion_stops_it_however_seldom_it_is_asked_at_rest(opened, clock, report_rate, silence):
    stage, port = opened(report_rate=report_rate, silence=silence)
    stage.move(Position(-4.5), 0.5)
    clock.sleep(0.5)
    port.silent, begun = True, clock.now()
    assert "no longer answers" in failure(stage, silence + SOON)
    assert silence < port.held_at - begun < silence + 0.06
    port.until(lambda: port.reset_at)


def test_silence_at_rest_is_borne_for_the_timeout(opened, clock):
    stage, port = opened(timeout=0.7)
    port.silent, begun = True, clock.now()
    port.until(lambda: port.held_at)
    assert 0.7 < port.held_at - begun < 0.8
    assert "no longer answers" in str(stage.error)


@pytest.mark.parametrize("noise", [random.Random(3).randbytes(100_000), b"a\n" * 500_000])
def test_noise_stops_it_and_delays_no_caller(moving, noise):
    stage, port = moving
    port.inject(noise)
    assert "garbled" in failure(stage)
    port.until(lambda: port.held_at and port.reset_at, 1.0)
    assert port.bytes.count(b"!") < 100, "it is not told at each piece"


def test_a_little_noise_is_borne(moving):
    stage, port = moving
    for _ in range(5):
        port.inject(b"\xff\x00z\n")
        port.inject(b"<Idle|MPos:0.0")
        asked = port.bytes.count(b"?")
        port.until(lambda asked=asked: port.bytes.count(b"?") > asked)
    assert stage.error is None
    assert stage.report().state == "run"


def test_an_unplugged_stage_is_reported_at_once(moving):
    stage, port = moving
    port.unplug()
    text = failure(stage, 0.0)
    assert "the connection is lost" in text
    assert "switch it off" in text
    stage.stop()
    for ask in (stage.report, stage.wait, lambda: stage.move(Position())):
        with pytest.raises(HardwareError, match="connection is lost"):
            ask()


def _in_alarm(port):
    port.state = "Alarm"
    port.plan.clear()


def _jump(*place):
    def jump(port):
        port.place[:] = place
        port.plan[:] = [(list(place), 60.0)]

    return jump


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lambda port: port.alarm(1), "ALARM:1"),
        (lambda port: port.alarm(99), "ALARM:99"),
        (_in_alarm, "in alarm"),  # whose line was lost
        (lambda port: port.reset(), "was reset"),
        (lambda port: port.say("ok"), "answered a line that this program did not send"),
        (lambda port: port.say("error:9"), "answered a line that this program did not send"),
        (lambda port: setattr(port, "state", "Hold:0"), "the state hold by itself"),
        (lambda port: setattr(port, "state", "Door:1"), "the state door by itself"),
        (_jump(30, 40, 6.7), "beyond the limits"),
        (_jump(30, 40, 15.1), "beyond the limits"),
        (_jump(34, 44, 10), "beyond the limits"),
    ],
)
def test_what_happens_in_motion_is_reported(moving, fault, message):
    stage, port = moving
    fault(port)
    assert message in failure(stage)
    assert message in str(stage.error)
    assert port.held_at
    with pytest.raises(HardwareError, match=message):
        stage.report()


def test_a_stage_that_begins_beyond_its_limits_can_come_back_but_go_no_farther(opened, clock):
    stage, _ = opened(ScriptedGrbl(clock, place=(30.0, 40.0, 17.0)))
    stage.move(Position(-4.0))
    assert stage.wait().position.travel == pytest.approx(-4)
    stage, port = opened(ScriptedGrbl(clock, place=(30.0, 40.0, 17.0)))
    port.on_move = lambda: port.plan.append(([30.0, 40.0, 19.0], 0.5))
    stage.move(Position(-7 + 2.01))
    assert "beyond the limits" in failure(stage, 1.0)


def test_homing_may_end_beyond_the_limits(opened, clock):
    stage, port = opened(ScriptedGrbl(clock, settings={22: 1}), home=True)
    stage.move(Position(1.0))
    stage.wait()
    port.place[2] = 17.0
    stage.home()
    assert stage.report().position.travel == pytest.approx(-7)
    stage.move(Position(-1.0))
    stage.wait()


def test_a_stage_that_rests_elsewhere_than_it_was_sent_reports_it(opened):
    stage, port = opened()
    port.on_move = lambda: port.plan.__setitem__(-1, ([30.0, 40.0, 8.0], 0.1))
    stage.move(Position(1.0), 10.0)
    text = failure(stage, 0.5)
    assert "rests 1 mm or degrees from its target" in text
    assert str(stage.error) == text


def test_the_steps_of_a_coarse_axis_are_no_fault(opened, clock):
    stage, port = opened(ScriptedGrbl(clock, settings={101: 10}))
    port.on_move = lambda: port.plan.__setitem__(-1, ([30.05, 40.0, 9.0], 0.1))
    stage.move(Position(1.0), 10.0)
    stage.wait()


def test_a_work_offset_that_changes_stops_it(opened, clock):
    stage, port = opened(ScriptedGrbl(clock, work=True))
    port.offset[2] += 0.001
    port.until(lambda: stage.error)
    assert "work offset was changed" in str(stage.error)
    with pytest.raises(HardwareError, match="work offset"):
        stage.move(Position(1))


def test_a_refused_move_stops_the_stage(opened):
    stage, port = opened()
    stage.move(Position(-1), 4.0)
    port.run = lambda line: port.say("error:15")
    with pytest.raises(HardwareError, match=r"error:15") as caught:
        stage.move(Position(2), 20.0)
    assert "G53G1Z8" in str(caught.value)
    assert port.held_at


def test_an_answer_that_was_lost_is_reported(opened):
    stage, port = opened()
    port.run = lambda line: port.say("o")
    with pytest.raises(HardwareError, match="has not answered"):
        stage.move(Position(1))


def test_a_stage_that_does_not_come_to_rest_in_time_is_stopped(moving):
    stage, port = moving
    with pytest.raises(HardwareError, match="did not come to rest within"):
        stage.wait(0.1)
    assert port.held_at
    assert "stopped" in str(stage.error)


def test_a_stop_goes_out_at_once_and_ends_others_waits(moving, clock):
    stage, port = moving
    failures = []
    other = clock.thread(lambda: failures.append(failure(stage, 1.0)), "other")
    other.start()
    clock.sleep(0.1)
    stage.stop()
    assert port.held_at == clock.now()
    other.join()
    assert "was stopped" in failures[0]
    assert clock.now() - port.held_at < SOON
    port.until(lambda: port.reset_at)
    assert port.bytes.rindex(b"!") < port.bytes.index(b"\x18")
    stage.stop()
    stage.stop()
    assert port.state == "Idle"


def test_a_stop_needs_no_lock_of_other_threads(moving, clock):
    stage, port = moving
    finished = clock.event()

    def keep():
        with stage._link.lock:
            finished.wait()

    other = clock.thread(keep, "other")
    other.start()
    clock.sleep(0.001)
    stage.stop()
    assert port.held_at == clock.now()
    assert other.is_alive(), "it waited for the lock"
    finished.set()
    other.join()


def test_nothing_more_is_sent_after_a_stop(opened, clock):
    stage, port = opened()
    lean = math.radians(2.5)
    stage.move(Position(0, lean))
    stage.wait()
    stage.precess(lean, 50.0, 5.0)
    stage.stop()
    port.until(lambda: port.reset_at)
    clock.sleep(1.0)
    assert b"G" not in port.bytes[port.bytes.index(b"\x18") :]
    assert not port.moving()


def test_a_machine_that_never_holds_is_reset_all_the_same(moving, clock):
    stage, port = moving
    port.hold = lambda: None
    begun = clock.now()
    stage.stop()
    port.until(lambda: port.reset_at)
    assert 0.3 < port.reset_at - begun < 0.32
    assert port.state == "Alarm"


@pytest.mark.parametrize("what", ["lost", "undone"])
def test_a_hold_that_is_lost_or_undone_is_repeated(moving, what):
    stage, port = moving
    hold, failures = port.hold, []

    def once(*_):
        failures.append(port.state)
        if what == "undone" or len(failures) > 1:
            hold()
        if what == "undone" and len(failures) == 1:
            port.state = "Run"

    port.hold = once
    stage.stop()
    port.until(lambda: port.reset_at)
    assert len(failures) > 1
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


@pytest.mark.parametrize("at", [0.0, 0.0003, 0.011, 0.5, 3.0])
def test_ctrl_c_at_any_moment_of_a_wait_stops_it(moving, clock, at):
    stage, port = moving
    begun = clock.now()
    clock.later(at, clock.interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.wait()
    assert port.held_at == clock.now() == pytest.approx(begun + at)


def test_a_move_that_is_interrupted_stops_the_stage(opened):
    stage, port = opened()
    stage.move(Position(-0.1), 0.5)
    port.on_move = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.move(Position(1), 0.5)
    assert port.held_at is not None


@pytest.mark.parametrize("how", ["stop", "interrupt"])
def test_a_stop_in_homing_resets_without_waiting_for_a_hold(opened, clock, how):
    stage, port = opened(ScriptedGrbl(clock, settings={22: 1}, answers={"$H": "[MSG:under way]"}), home=True)
    begun = clock.now()
    clock.later(0.5, stage.stop if how == "stop" else clock.interrupt)
    with pytest.raises(HardwareError if how == "stop" else KeyboardInterrupt):
        stage.home()
    assert "was stopped" in str(stage.error)
    assert port.reset_at == begun + 0.5


def test_closing_that_is_interrupted_leaves_nothing_open(moving, clock):
    stage, port = moving
    begun = clock.now()
    clock.later(0.005, clock.interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.close()
    assert port.held_at == begun
    assert port.closed
    assert clock.threads == []


FORGETFUL = """
from mirrorskin.twin.emulator.port import GrblLine, GrblMachine
from mirrorskin.hw.stages.grbl import GrblStage
from mirrorskin.hw.base.stage import Position
from scripted_grbl import stage_settings

class Loud(GrblLine):
    def write(self, data):
        if data in (b"!", b"\\x18"):
            print(data, flush=True)
        return super().write(data)

stage = GrblStage(stage_settings(timeout=60.0, silence=5.0), Loud(GrblMachine()))
stage.move(Position(-4), 0.5)
raise RuntimeError("forgot to close it")
"""


def test_a_program_that_ends_without_closing_stops_the_stage():
    support = Path(__file__).parents[2] / "support"
    ended = subprocess.run(
        [sys.executable, "-c", FORGETFUL],
        env={"PYTHONPATH": f"{support}:{':'.join(sys.path)}"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "forgot to close it" in ended.stderr
    words = ended.stdout.split()
    assert words[0] == "b'!'"
    assert r"b'\x18'" in words
