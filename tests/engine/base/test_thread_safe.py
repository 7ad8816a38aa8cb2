"""Several threads: calls of one object do not overlap, and every answer equals that of one thread."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.engine.live import STAGES
from mirrorskin.engine.live.status import Monitor
from mirrorskin.io import InputError
from mirrorskin.io.base.threads import ThreadSafe

SHAPE = 24, 32


def slopes(number):
    return (0.01 * number * np.ones(SHAPE), np.linspace(0, 0.02 * number, SHAPE[1]) * np.ones(SHAPE))


def test_results_next_to_pushes_are_those_of_a_single_thread():
    """Of an integrator; operations have a contract."""
    alone, shared, finished = engine.Integrator(SHAPE, 0.1), engine.Integrator(SHAPE, 0.1), threading.Event()
    heights_of_one = set()
    for number in range(60):
        alone.push(*slopes(number))
        heights_of_one.add(alone.result().height.tobytes())

    def push():
        for number in range(60):
            shared.push(*slopes(number))
        finished.set()

    with ThreadPoolExecutor(1) as pool:
        pushing = pool.submit(push)
        while not finished.is_set() and not pushing.done():
            try:
                assert shared.result().height.tobytes() in heights_of_one
            except InputError:
                continue  # nothing was pushed yet
        pushing.result()
    assert shared.result().height.tobytes() == alone.result().height.tobytes()


class Meeting(ThreadSafe):
    """Its members see whether two threads are in them at once."""

    def __init__(self):
        self.inside, self.most = 0, 0

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
        return shared.seen

    with ThreadPoolExecutor(4) as pool:
        futures = [pool.submit(use) for _ in range(4)]
        assert {future.result() for future in futures} == {1}


def test_an_object_does_not_wait_for_another():
    first, other = Meeting(), Meeting()
    with first._thread_lock, ThreadPoolExecutor(1) as pool:
        assert pool.submit(other.push).result(timeout=60) is None


def test_a_status_can_be_read_while_the_loop_counts():
    monitor, start, finished = Monitor(), threading.Barrier(3), threading.Event()

    def count():
        start.wait()
        try:
            for number in range(3000):
                monitor.took(0.01 * number, 1, 1, 0)
                monitor.time(STAGES[0], 0.1)
        finally:
            finished.set()

    def look_on():
        start.wait()
        while not finished.is_set():
            status = monitor.status(fresh=True)
            assert status.frames == status.used

    with ThreadPoolExecutor(3) as pool:
        for future in [pool.submit(count), pool.submit(look_on), pool.submit(look_on)]:
            future.result()
    assert monitor.status(fresh=True).frames == 3000


def test_threads_that_integrate_at_once_get_what_each_gets_alone():
    inputs = [slopes(number) for number in range(1, 7)]
    alone = [engine.integrate(*pair, 0.1).height.tobytes() for pair in inputs]
    with ThreadPoolExecutor(3) as pool:
        heights = list(pool.map(lambda pair: engine.integrate(*pair, 0.1).height.tobytes(), inputs * 3))
    assert heights == alone * 3
