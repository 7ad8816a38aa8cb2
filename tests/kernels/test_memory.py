"""Memory of arrays is reused, its amount is limited, and no two arrays share it."""

import mmap
import threading

import numpy as np
import pyopencl as cl
import pytest

from mirrorskin import engine
from mirrorskin.kernels import memory
from mirrorskin.kernels.array import SLACK


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


def test_memory_at_the_end_of_its_last_page_is_not_borrowed(device):
    """A kernel may load up to 64 bytes after the last sample, which no page may contain."""
    values = np.frombuffer(mmap.mmap(-1, memory.PAGE), np.uint8)
    assert device.borrow("values", values[:-63]) is None


@pytest.mark.parametrize(
    "values",
    [np.zeros((40, 50), np.float32)[:, ::2], np.zeros(400, np.uint8)[1:201].view(np.float32)],
    ids=["with gaps", "not aligned"],
)
def test_values_that_a_kernel_cannot_read_in_place_are_not_borrowed(device, values):
    assert device.borrow("values", values) is None


def test_a_buffer_contains_the_bytes_that_follow_its_array(device):
    """A kernel loads the last word of an array as a whole, on a device with its own memory as well."""
    array = device.array("values", (10,), np.uint8)
    assert array.buffer.size == 10 + SLACK


def test_a_buffer_of_own_memory_contains_the_bytes_that_follow_its_array(card):
    array = card.array("values", (10,), np.uint8)
    assert array.buffer.size == 10 + SLACK


@pytest.mark.parametrize("writeable", [True, False])
def test_what_can_be_written_is_not_read_only_to_a_device(device, writeable):
    """Intel's runtime copies what is read-only and not aligned, however large, before each kernel."""
    values = np.arange(65_636, dtype=np.uint8)[4:-96]
    values.flags.writeable = writeable
    if device.info.shares_memory:
        borrowed = device.borrow("values", values)
        assert bool(borrowed.buffer.flags & cl.mem_flags.READ_ONLY) == (not writeable)
    shared = device.share("values", values)
    copied = device.array("copied", values.shape, np.uint8)
    source = "__kernel void copy(__global const uchar *from, __global uchar *to)"
    kernel = device.kernel(
        f"{source} {{ int i = get_global_id(0); if (i < {values.size}) to[i] = from[i]; }}", "copy"
    )
    kernel(values.size, moved=2 * values.nbytes, **{"from": shared, "to": copied})
    np.testing.assert_array_equal(copied.read(), values)
