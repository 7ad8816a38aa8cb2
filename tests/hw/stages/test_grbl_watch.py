from __future__ import annotations

import math

import pytest

from mirrorskin.hw.stages.link import HOLDING, Stopping
from mirrorskin.hw.stages.report_times import ReportTimes


def answered(watch, asked, trip):
    watch.ask(asked)
    return watch.answer(asked + trip)


def test_an_answer_is_valid_for_the_middle_between_question_and_answer():
    watch = ReportTimes(0.05)
    assert watch.due(10.0)
    watch.ask(10.0)
    answer = watch.answer(10.02)
    assert (answer.asked, answer.time, answer.sure) == (10.0, pytest.approx(10.01), True)
    assert not watch.due(10.04)
    assert watch.due(10.06)


def test_an_answer_that_comes_late_is_not_trusted():
    watch = ReportTimes(0.1)
    assert all(answered(watch, float(k), 0.002).sure for k in range(5))
    late = answered(watch, 5.0, 0.03)
    assert not late.sure
    assert late.asked == 5.0
    assert answered(watch, 6.0, 0.003).sure


def test_an_answer_to_one_of_two_questions_has_no_time_until_all_is_quiet():
    watch = ReportTimes(0.05)
    answered(watch, 0.5, 0.001)
    watch.ask(1.0)
    assert watch.due(1.045)
    watch.ask(1.045)
    for late in 1.06, 1.09:
        answer = watch.answer(late)
        assert (answer.asked, answer.sure) == (-math.inf, False)
        assert not watch.due(late + 0.045)
    assert watch.due(1.17)
    assert answered(watch, 1.17, 0.001).sure


def test_silence_counts_only_while_a_question_is_open():
    watch = ReportTimes(0.05)
    watch.listened(0.99, 1.01)
    assert watch.silence(1.01) == 0
    watch.ask(1.02)
    watch.listened(1.01, 1.03)
    watch.listened(1.03, 1.05)
    assert watch.silence(1.06) == pytest.approx(0.03)
    watch.answer(1.06)
    assert watch.silence(1.07) == 0


def test_a_question_that_was_not_sent_yet_hears_no_silence():
    watch = ReportTimes(0.05)
    watch.ask(1.0)
    for k in range(50):
        watch.listened(1.0 + 0.01 * k, 1.01 + 0.01 * k)
    watch.sent(1.5)
    assert watch.silence(1.5) == 0
    watch.listened(1.5, 1.52)
    assert watch.silence(1.52) == pytest.approx(0.02)


def test_a_reader_who_sleeps_hears_no_silence():
    watch = ReportTimes(0.05)
    watch.ask(1.0)
    assert watch.silence(1.3) == 0, "nobody listened"
    for k in range(3):
        watch.listened(1.0 + 0.1 * k, 1.1 + 0.1 * k)
    assert watch.silence(1.3) < 0.05, "the computer was busy"
    assert watch.silence(1.5) > 0.45, "but nobody is as busy as that"


@pytest.mark.parametrize("trip", [0.03, 0.045, 0.06, 0.085])
def test_a_line_that_becomes_slow_is_trusted_again(trip):
    now, watch, coming, sure = 0.0, ReportTimes(0.025), [], []
    while now < 5:
        now += 0.005
        while coming and coming[0][1] <= now:
            asked, came = coming.pop(0)
            answer = watch.answer(came)
            sure.append(answer.sure)
            assert answer.asked in (asked, -math.inf), "it is meant for that question"
        if watch.due(now):
            watch.ask(now)
            coming.append((now, now + (trip if now > 1 else 0.002)))
    assert len(sure) > 50
    assert all(sure[-10:])


def test_a_stop_resets_once_the_machine_has_reported_rest_since():
    stopping = Stopping()
    assert not stopping.begun
    stopping.begin(5.0)
    stopping.begin(5.2)
    assert not stopping.reset(5.1, 4.99, False)
    assert stopping.reset(5.1, 5.05, False)
    assert not stopping.reset(5.1, 5.05, False), "it is reset once"
    stopping.finish(5.11, False)
    assert not stopping.over
    stopping.finish(5.12, True)
    assert stopping.over


def test_a_stop_waits_neither_for_a_rest_nor_for_an_answer_for_long():
    stopping = Stopping()
    stopping.begin(5.0)
    assert not stopping.reset(5.0 + 0.9 * HOLDING, -math.inf, False)
    assert stopping.reset(5.0 + 1.1 * HOLDING, -math.inf, False)
    stopping.finish(5.0 + stopping.longest, False)
    assert not stopping.over
    stopping.finish(5.0 + 1.1 * stopping.longest, False)
    assert stopping.over


def test_a_stop_on_a_line_that_is_gone_does_not_wait():
    stopping = Stopping()
    stopping.begin(5.0)
    assert stopping.reset(5.0, -math.inf, True)
