"""Simulated time: the order of threads is reproducible, and an endless wait is an error."""

from __future__ import annotations

import random
import threading
import time

import pytest

from mirrorskin.hw.base.clock import SYSTEM
from mirrorskin.twin.emulator.simulated_clock import DeadlockError, SimulatedClock


@pytest.fixture(params=["system", "simulated"])
def any_clock(request):
    return SYSTEM if request.param == "system" else SimulatedClock()


# What both clocks do


def test_a_wait_ends_with_its_event_or_with_its_time(any_clock):
    event, began = any_clock.event(), any_clock.now()
    assert not event.wait(0.02)
    assert any_clock.now() - began > 0.019
    any_clock.thread(event.set, "sets").start()
    assert event.wait(60.0)
    assert event.is_set()


def test_a_condition_hands_over_a_value_and_its_lock_is_taken_twice(any_clock):
    condition, values = any_clock.condition(), []

    def give():
        with condition, condition:
            values.append(5)
            condition.notify()

    with condition, condition:
        any_clock.thread(give, "gives").start()
        any_clock.sleep(0.01)
        assert values == [], "the lock is held"
        while not values:
            assert condition.wait(60.0)
        assert not condition.wait(0.01)
        assert condition.wait_for(lambda: sum(values), 30.0) == 5
        assert not condition.wait_for(lambda: len(values) > 1, 0.01)


def test_a_thread_can_be_waited_for_and_has_a_name(any_clock):
    names, go_on = [], any_clock.event()

    def work():
        go_on.wait(60.0)
        names.append(threading.current_thread().name)

    thread = any_clock.thread(work, "worker")
    assert not thread.is_alive()
    thread.start()
    thread.join(0.01)
    assert thread.is_alive()
    go_on.set()
    thread.join(60.0)
    assert not thread.is_alive()
    assert names == ["worker"]


# What the simulated one does


def test_a_day_takes_no_time(clock):
    began, real = clock.now(), time.monotonic()
    ticks = []

    def tick():
        for _ in range(1440):
            clock.sleep(60)
            ticks.append(clock.now())

    thread = clock.thread(tick, "ticks")
    thread.start()
    thread.join()
    assert clock.now() - began == 86400
    assert ticks == [began + 60 * (k + 1) for k in range(1440)]
    assert time.monotonic() - real < 600


def test_the_time_does_not_pass_while_a_thread_works(clock):
    times = []
    clock.thread(lambda: (time.sleep(0.01), times.append(clock.now())), "works").start()
    began = clock.now()
    clock.sleep(1e-9)
    assert times == [began]


def test_rounding_does_not_keep_the_time_from_passing(clock):
    began = clock.now()
    clock.event().wait(1e-20)
    assert clock.now() > began


def play(seed):
    """Let five threads meet at random, and tell all that they did, with the times."""
    clock, chance, log = SimulatedClock(), random.Random(seed), []
    shared, event = clock.condition(), clock.event()

    def work(name):
        for number in range(30):
            clock.sleep(chance.choice([0.0, 0.001, 0.002, 0.005]))
            with shared:
                log.append((name, number, clock.now()))
                if chance.random() < 0.5:
                    shared.notify()
                elif chance.random() < 0.5:
                    log.append((name, shared.wait(chance.choice([0.001, 0.01])), clock.now()))
                clock.sleep(0.001)
        event.set()

    threads = [clock.thread(lambda name=name: work(name), name) for name in "abcde"]
    for thread in threads:
        thread.start()
    log.append(event.wait())
    for thread in threads:
        thread.join()
    return log


def test_threads_always_meet_in_the_same_order():
    first = play(7)
    assert len({entry[0] for entry in first if entry is not True}) == 5
    assert all(play(7) == first for _ in range(50))
    assert play(8) != first


def test_who_waited_longer_comes_first(clock):
    order, lock = [], clock.condition()

    def work(name):
        with lock:
            order.append(name)

    with lock:
        threads = [clock.thread(lambda name=name: work(name), name) for name in "abc"]
        for thread in threads:
            thread.start()
        clock.sleep(1.0)
    for thread in threads:
        thread.join()
    assert order == ["a", "b", "c"]


def test_a_wait_for_what_never_comes_names_all_who_wait(clock):
    event, condition = clock.event(), clock.condition()

    def wait():
        with condition:
            condition.wait()

    thread = clock.thread(wait, "reader")
    thread.start()
    with pytest.raises(DeadlockError, match="MainThread for an event; reader for a notification"):
        event.wait()
    with condition:
        condition.notify_all()
    thread.join()


def test_locks_taken_in_both_orders_are_noticed(clock):
    first, other = clock.condition(), clock.condition()

    def take():
        with other:
            clock.sleep(1.0)
            with first:
                pass

    thread = clock.thread(take, "other")
    thread.start()
    with first:
        clock.sleep(0.5)
        with pytest.raises(DeadlockError, match="other for a lock"), other:
            pass
    thread.join()


def test_something_is_done_at_an_exact_instant(clock):
    began, finished = clock.now(), []
    threads = [clock.later(delay, lambda: finished.append(clock.now() - began)) for delay in (0.3, 0.1, 0.2)]
    clock.sleep(0.25)
    assert finished == pytest.approx([0.1, 0.2])
    for thread in threads:
        thread.join()
    assert finished == pytest.approx([0.1, 0.2, 0.3])


def test_an_interrupt_comes_where_the_first_thread_waits(clock):
    began, event = clock.now(), clock.event()
    thread = clock.later(0.5, clock.interrupt)
    with pytest.raises(KeyboardInterrupt):
        event.wait(2.0)
    assert clock.now() - began == 0.5
    thread.join()
    with pytest.raises(KeyboardInterrupt):
        clock.interrupt()


def test_a_foreign_thread_cannot_wait(clock):
    lines = []

    def work():
        try:
            clock.sleep(1.0)
        except RuntimeError as error:
            lines.append(str(error))

    stranger = threading.Thread(target=work, name="stranger")
    stranger.start()
    stranger.join()
    assert lines == ["stranger cannot wait on a simulated clock that did not create it"]


def test_looking_at_the_time_without_end_is_an_error(clock):
    def poll():
        while clock.now() < 2000.0:
            pass

    with pytest.raises(DeadlockError, match="MainThread reads the clock but never waits"):
        poll()
    clock.sleep(1.0)


def test_a_condition_is_waited_for_with_its_lock(clock):
    with pytest.raises(RuntimeError, match="must hold the lock"):
        clock.condition().wait(1.0)
