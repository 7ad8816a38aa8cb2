"""Memory of arrays is reused, its amount is limited, and no two arrays share it."""

import threading

import numpy as np
import pyopencl as cl
import pytest

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


def test_no_more_memory_is_kept_than_is_reported(monkeypatch):
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


@pytest.mark.parametrize("writeable", [True, False])
def test_what_can_be_written_is_not_read_only_to_a_device(device, writeable):
    """Intel's runtime copies what is read-only and not aligned, however large, before each kernel."""
    values = np.arange(65_636, dtype=np.uint8)[4:-96]
    values.flags.writeable = writeable
    if device.info.shares_memory:
        borrowed = device.borrow("values", values)
        assert bool(borrowed.buffer.flags & cl.mem_flags.READ_ONLY) == (not writeable)
    seen = device.share("values", values)
    copied = device.array("copied", values.shape, np.uint8)
    source = "__kernel void copy(__global const uchar *from, __global uchar *to)"
    kernel = device.kernel(
        f"{source} {{ int i = get_global_id(0); if (i < {values.size}) to[i] = from[i]; }}", "copy"
    )
    kernel(values.size, moved=2 * values.nbytes, **{"from": seen, "to": copied})
    np.testing.assert_array_equal(copied.read(), values)
