"""Memory of arrays is used again, no more of it is kept than allowed, and no two arrays share it."""

import threading

import numpy as np

from mirrorskin import engine
from mirrorskin.kernels import memory


def test_memory_is_used_again():
    engine.free_memory()
    first = memory.take(300_000, zeroed=False)
    address = first.ctypes.data
    view = first[10:20].view(np.uint16)
    view[:] = 7
    del first
    assert memory.take(300_000, zeroed=False).ctypes.data != address  # the view still needs it
    del view
    again = memory.take(290_000, zeroed=True)
    assert again.ctypes.data == address
    assert not again.any()
    del again
    engine.free_memory()
    assert not memory._kept


def test_no_more_memory_is_kept_than_is_said(monkeypatch):
    monkeypatch.setattr(memory, "KEPT", 1_000_000)
    engine.free_memory()
    taken = [memory.take(300_000, zeroed=False) for _ in range(5)]
    last = taken[-1].ctypes.data
    while taken:
        del taken[0]
        assert sum(map(len, memory._kept)) <= 1_000_000
    assert memory.take(300_000, zeroed=False).ctypes.data == last


def test_threads_do_not_get_each_others_memory():
    def work(number):
        for _ in range(200):
            mine = memory.take(100_000 + 1000 * number, zeroed=False)
            mine[:] = number
            wrong.extend(mine[mine != number])

    wrong = []
    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
