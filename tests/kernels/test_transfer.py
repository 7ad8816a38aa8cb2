"""Copies through staging buffers, of any size and layout, from several threads; kept device memory."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from injected_faults import lost

from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels import transfer
from mirrorskin.kernels.array import fetch
from mirrorskin.kernels.errors import DeviceError


@pytest.fixture
def opened(device, monkeypatch):
    """The device as one with memory of its own, with staging buffers of 4 KiB that threads fill."""
    monkeypatch.setattr(transfer, "SLOT", 2**12)
    monkeypatch.setattr(transfer, "SMALL", 2**10)
    monkeypatch.setattr(transfer, "_MIN_BYTES_PER_THREAD", 2**8)
    monkeypatch.setattr(transfer, "THREADS", 3)
    opened = device_layer.Device(device.context.devices[0])
    opened.info, opened.layout = replace(device.info, shares_memory=False), device.layout
    return opened


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, "V24"])
@pytest.mark.parametrize("shape", [(3,), (5, 7), (2, 9000), (3, 50, 41), (40, 1, 300)])
def test_arrays_of_any_size_arrive_and_return(opened, shape, dtype):
    raw = np.random.default_rng(1).integers(0, 256, (*shape, np.dtype(dtype).itemsize), np.uint8)
    values = raw.view(dtype).reshape(shape)
    array = opened.array("values", shape, dtype, zeroed=False)
    array.write(values)
    assert array.read().tobytes() == values.tobytes()
    assert array.read().tobytes() == values.tobytes()


@pytest.mark.parametrize("part", [np.s_[:, 5:35], np.s_[:, :, 3:], np.s_[::2], np.s_[::-1, ::-1]])
def test_frames_that_are_not_contiguous_arrive(opened, part):
    values = np.random.default_rng(1).random((9, 40, 50), np.float32)[part]
    assert np.array_equal(opened.from_host("values", values).read(), values)
    assert np.array_equal(opened.from_host("values", values, np.float64).read(), values)


def test_values_may_be_overwritten_as_soon_as_they_were_written(opened):
    values = np.empty((4, 3000), np.int32)
    arrays = []
    for number in range(20):
        values[...] = number
        arrays.append(opened.from_host("values", values, np.int32))
    assert [set(array.read().ravel().tolist()) for array in arrays] == [{number} for number in range(20)]


def test_threads_share_the_staging_buffers_while_they_are_freed(opened):
    def work(number):
        for step in range(20):
            arrays = [opened.from_host("values", np.full(n, number + step), np.int32) for n in (5, 3000, 40)]
            for values in fetch([(array, slice(None)) for array in arrays]):
                assert np.all(values == number + step)
        return number

    with ThreadPoolExecutor(4) as pool:
        answers = pool.map(work, range(0, 400, 100))
        for _ in range(20):
            opened.free()
        assert list(answers) == [0, 100, 200, 300]


def test_device_memory_is_kept_until_it_is_freed(opened):
    def allocations():
        opened.profile.clear()
        opened.array("kept", (1000, 10), np.float32)
        opened.from_host("other", np.ones(10))
        return sum(record.runs for record in opened.profile.records() if record.name == "allocation")

    assert [allocations(), allocations()] == [2, 0]
    opened.free()
    assert allocations() == 2
    assert opened.from_host("values", np.arange(3000), np.int32).read()[-1] == 2999


def test_staging_buffers_that_are_lost_to_an_error_are_replaced(opened, monkeypatch):
    array = opened.from_host("values", np.arange(30_000), np.int32)
    wait, failures = opened.profile.wait, iter(range(5))

    def fail(name, event):
        wait(name, event)
        if name == "values" and next(failures, None) is not None:
            raise lost()

    monkeypatch.setattr(opened.profile, "wait", fail)
    for _ in range(5):
        with pytest.raises(DeviceError, match="cannot hold or copy values"):
            array.read()
    assert np.array_equal(array.read(), np.arange(30_000))
