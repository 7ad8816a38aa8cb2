"""Operations in several threads: one pushes, others look on, and every answer is that of one thread."""

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from functools import cached_property, partial

import numpy as np
import operations
import pytest

from mirrorskin import engine
from mirrorskin.engine import live
from mirrorskin.engine.live.status import STAGES, Monitor
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError


class Pushes:
    """How an object is made, the pushes that it gets, and what other threads call meanwhile."""

    def __init__(self, make, pieces, reads=("result",), every=True, looks=10**6):
        self.make, self.pieces, self.reads, self.every, self.looks = make, pieces, reads, every, looks


def pushes(name):
    """Return the pushes of an operation, two frames each; slow results are asked for less often."""
    case, slow = operations.CASES[name], name in ("Slip", "LastTurn")
    pieces = [
        (
            (case.frames[start : start + 2],),
            {one: values[start : start + 2] for one, values in case.positions.items()},
        )
        for start in range(0, len(case.frames), 2)
    ]
    return Pushes(case.make, pieces, ("result", "room"), every=not slow, looks=10 if slow else 10**6)


def live_pushes(name):
    """Return the pushes of an operation that runs live."""
    case, offline = operations.CASES[name], pushes(name)
    return Pushes(
        lambda: live.LiveOperation(case.source(), case.make()),
        offline.pieces,
        ("result", "maps"),
        offline.every,
        offline.looks,
    )


def slopes(number):
    return (0.01 * number * np.ones(SHAPE), np.linspace(0, 0.02 * number, SHAPE[1]) * np.ones(SHAPE))


SHAPE = operations.SHAPE
ONCE = [name for name, case in operations.CASES.items() if case.make().passes == 1]
CASES = {
    **{name: pushes(name) for name in ONCE},
    **{f"live {name}": live_pushes(name) for name in ("Strokes", "LastTurn", "MovingNormals", "Slip")},
    "Integrator": Pushes(partial(engine.Integrator, SHAPE, 0.1), [(slopes(n), {}) for n in range(60)]),
}


def parts_of(answer):
    """Yield all numbers of an answer as bytes, but for the date in ``process``."""
    if isinstance(answer, np.ndarray):
        yield np.ascontiguousarray(answer).tobytes()
    elif is_dataclass(answer):
        for field in fields(answer):
            if field.name != "process":
                yield from parts_of(getattr(answer, field.name))
    elif isinstance(answer, Mapping):
        for name, one in sorted(answer.items()):
            yield name.encode()
            yield from parts_of(one)
    elif isinstance(answer, tuple | list):
        for one in answer:
            yield from parts_of(one)
    else:
        yield repr(answer).encode()


def digest(answer):
    return hash(b"|".join(parts_of(answer)))


def read(estimator, name):
    """Return what a method or property gives, or None where there are too few frames yet."""
    try:
        member = getattr(estimator, name)
        return member() if callable(member) else member
    except InputError:
        return None


@pytest.mark.parametrize("name", CASES)
def test_each_answer_beside_pushes_is_that_of_a_single_thread(name):
    case = CASES[name]
    alone = case.make()
    known = {digest(read(alone, "result"))}
    for args, named in case.pieces:
        alone.push(*args, **named)
        if case.every:
            known.add(digest(read(alone, "result")))
    expected = digest(alone.result())

    shared, start, done = case.make(), threading.Barrier(3), threading.Event()

    def push():
        start.wait()
        try:
            for args, named in case.pieces:
                shared.push(*args, **named)
        finally:
            done.set()

    def look_on():
        kept = []
        start.wait()
        for _ in range(case.looks):
            if done.is_set():
                break
            for one in case.reads:
                answer = read(shared, one)
                if one == "result" and answer is not None:
                    kept = [*kept[:2], *kept[-2:], (answer, digest(answer))]
                    assert not case.every or kept[-1][1] in known
        return kept

    with ThreadPoolExecutor(3) as pool:
        pushing, *looking = pool.submit(push), pool.submit(look_on), pool.submit(look_on)
        pushing.result()
        kept = [one for each in looking for one in each.result()]
    assert digest(shared.result()) == expected
    assert all(digest(answer) == before for answer, before in kept)  # nothing wrote to them later


def test_every_class_that_is_pushed_to_is_thread_safe():
    public = {
        one
        for one in operations.engine_classes()
        if not one.__name__.startswith("_")
        if callable(getattr(one, "push", None)) and callable(getattr(one, "result", None))
    }
    inside = {"NormalWindow", "WarmStartIntegrator", "StackSums", "TurnSums", "WindowSums"}
    # Those are used by one operation each, under its lock.
    assert {one.__name__ for one in public if not issubclass(one, ThreadSafe)} <= inside


class Meeting(ThreadSafe):
    """Its members see whether two threads are in them at once."""

    def __init__(self):
        self.inside, self.most, self.made = 0, 0, 0

    def _meet(self):
        self.inside += 1
        self.most = max(self.most, self.inside)
        threading.Event().wait(0.0005)  # lets other threads run
        self.inside -= 1

    def push(self):
        self._meet()
        _ = self.seen

    @property
    def seen(self):
        self._meet()
        return self.most

    @cached_property
    def room(self):
        self._meet()
        self.made += 1
        return object()

    def fail(self):
        raise InputError("no")


class Later(Meeting):
    def push(self):
        super().push()
        self._meet()


@pytest.mark.parametrize("kind", [Meeting, Later])
def test_no_two_threads_are_in_an_object_at_once(kind):
    shared, start = kind(), threading.Barrier(4)

    def use():
        start.wait()
        for _ in range(20):
            shared.push()
            with pytest.raises(InputError):  # which leaves it to others
                shared.fail()
        return shared.room, shared.seen

    with ThreadPoolExecutor(4) as pool:
        found = [pool.submit(use) for _ in range(4)]
        rooms, seen = zip(*(one.result() for one in found), strict=True)
    assert (set(seen), len(set(rooms)), shared.made) == ({1}, 1, 1)


def test_an_object_does_not_wait_for_another():
    one, other = Meeting(), Meeting()
    with one._thread_lock, ThreadPoolExecutor(1) as pool:
        assert pool.submit(other.push).result(timeout=60) is None


def test_a_status_can_be_read_while_the_loop_counts():
    monitor, start, done = Monitor(), threading.Barrier(3), threading.Event()

    def count():
        start.wait()
        try:
            for number in range(3000):
                monitor.took(0.01 * number, 1, 1, 0)
                monitor.time(STAGES[0], 0.1)
        finally:
            done.set()

    def look_on():
        start.wait()
        while not done.is_set():
            status = monitor.status(fresh=True)
            assert status.frames == status.used

    with ThreadPoolExecutor(3) as pool:
        for one in [pool.submit(count), pool.submit(look_on), pool.submit(look_on)]:
            one.result()
    assert monitor.status(fresh=True).frames == 3000


def test_threads_that_integrate_at_once_get_what_each_gets_alone():
    inputs = [slopes(number) for number in range(1, 7)]
    alone = [digest(engine.integrate(*one, 0.1)) for one in inputs]
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda one: digest(engine.integrate(*one, 0.1)), inputs * 3))
    assert found == alone * 3


@pytest.mark.parametrize("kind", [engine.Onset, engine.press.Strokes])
def test_an_operation_that_refuses_frames_goes_on_as_if_they_had_not_come(kind):
    frames, travel = operations.PRESS, operations.TRAVEL
    search, whole = kind(), kind()
    whole.push(frames, travel=travel)
    search.push(frames[:20], travel=travel[:20])
    back = travel[15::-1]
    refused = ((frames[:16, 1:], back), (frames[:16].astype(np.uint16), back), (frames[:9], [1.0]))
    for wrong, where in refused:
        with pytest.raises(InputError), ThreadPoolExecutor(1) as pool:
            pool.submit(search.push, wrong, travel=where).result()
    search.push(frames[20:], travel=travel[20:])
    assert digest(search.result()) == digest(whole.result())
