"""Threads on one device: answers are not mixed up, and the process does not abort."""

import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyopencl as cl
import pytest

from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import Device

FILL = "__kernel void fill(__global int *values, const int number) { values[get_global_id(0)] = number; }"
SIZE = 256  # items, a multiple of every work group

START = """
import threading
import numpy as np
from mirrorskin.kernels import array as arrays
from mirrorskin.kernels.device import open_device
from mirrorskin.kernels.errors import DeviceError

device = open_device({choice!r})
fill = device.kernel({source!r}, "fill")
"""


def run_script(device, script):
    """Run a script in a separate process, whose abort would be a failure here."""
    start = START.format(choice=device.info.title, source=FILL)
    command = [sys.executable, "-P", "-c", start + script]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_a_kernel_is_compiled_once_for_all_threads(device):
    mine = device.kernel(FILL, "fill")
    device.profile.clear()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(device.kernel, FILL, "fill").result() is mine
    assert not device.profile.records()


def test_devices_that_compile_at_the_same_time_leave_the_filters_of_warnings_as_they_were(monkeypatch):
    both, first_is_built = threading.Barrier(2), threading.Event()
    devices = [Device(device_layer._find()[0]) for _ in range(2)]
    build, ignored = Device._recall_or_compile, []

    def in_turn(device, *arguments):
        both.wait(60)
        if device is devices[1]:
            assert first_is_built.wait(60)
            ignored.append(any(kind is cl.CompilerWarning for _, _, kind, *_ in warnings.filters))
        return build(device, *arguments)

    def compile_on(device):
        device.kernel(FILL, "fill")
        first_is_built.set()

    monkeypatch.setattr(Device, "_recall_or_compile", in_turn)
    before = [*warnings.filters]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(compile_on, devices))
    assert ignored == [True]
    assert warnings.filters == before


OPENED = """
import threading
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from mirrorskin.kernels.device import open_device

start = threading.Barrier(6)

def first_use(number):
    start.wait()
    device = open_device({choice!r})
    values = device.array("values", (256,), np.int32)
    device.kernel({source!r}, "fill")(256, values=values, number=number, moved=0)
    return device, set(values.read().tolist())

with ThreadPoolExecutor(6) as pool:
    devices, values = zip(*pool.map(first_use, range(6)))
print(len(set(devices)), values == tuple({{number}} for number in range(6)))
"""


def test_threads_that_open_a_device_for_the_first_time_share_it(device):
    script = OPENED.format(choice=device.info.title, source=FILL)
    ran = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, timeout=300)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "1 True\n", "")


def test_threads_that_launch_one_kernel_each_get_their_own_answer(device):
    fill, start = device.kernel(FILL, "fill"), threading.Barrier(4)

    def launch(number):
        values = device.array("values", (SIZE,), np.int32)
        start.wait()
        wrong = 0
        for step in range(200):
            fill(SIZE, values=values, number=1000 * number + step, moved=0)
            wrong += np.count_nonzero(values.read() != 1000 * number + step)
        return wrong

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(launch, range(4))) == [0] * 4


def test_memory_of_arrays_that_other_threads_drop_is_not_reused_by_running_kernels(device):
    fill, start = device.kernel(FILL, "fill"), threading.Barrier(3)

    def launch_and_drop(number):
        start.wait()
        wrong = 0
        for _ in range(200):
            fill(2**16, values=device.array("dropped", (2**16,), np.int32, zeroed=False), number=-1, moved=0)
            kept = device.from_host("kept", np.full(2**16, number), np.int32)
            wrong += np.count_nonzero(kept.read() != number)
        return wrong

    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(launch_and_drop, range(3))) == [0] * 3


SHARED = """
values = device.from_host("values", np.zeros(256), np.int32)
start, done, raised = threading.Barrier(3), threading.Event(), []

def read():
    start.wait()
    while not done.is_set():
        try:
            values.read()
        except Exception as error:
            raised.append(error)

readers = [threading.Thread(target=read) for _ in range(2)]
for reader in readers:
    reader.start()
start.wait()
for number in range(1000):
    fill(256, values=values, number=number, moved=0)
done.set()
for reader in readers:
    reader.join()
print(raised, set(values.read().tolist()))
"""


def test_threads_that_read_an_array_while_kernels_write_it_end_no_process(device):
    ran = run_script(device, SHARED)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "[] {999}\n", "")


UNMAPPED = """
import dataclasses

device.info = dataclasses.replace(device.info, kind="gpu")  # memory of a processor need not be mapped
map_buffer = arrays.cl.enqueue_map_buffer

def map_twice(*arguments, **named):  # a release too many, as of a lost device, takes the other map away
    other, _ = map_buffer(*arguments, **named)
    mapped = map_buffer(*arguments, **named)
    other.base.release()
    other.base.release()
    return mapped

values = device.from_host("values", np.zeros(256), np.int32)
fill(256, values=values, number=1, moved=0)
arrays.cl.enqueue_map_buffer = map_twice
{use}
print("alive")
"""
USES = {
    "next kernel": """
np.from_dlpack(values)
try:
    fill(256, values=values, number=1, moved=0)
except DeviceError as error:
    print(error)
""",
    "no more": "np.from_dlpack(values); del values",
    "staging": "from mirrorskin.kernels import transfer; transfer._make_slot(device)",
}


@pytest.mark.parametrize("use", USES)
def test_a_buffer_that_cannot_be_unmapped_ends_no_process(device, use):
    if "Portable" not in device.info.platform:
        pytest.skip("what a second release does is the driver's affair")
    ran = run_script(device, UNMAPPED.format(use=USES[use]))
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.endswith("alive\n")
    if use == "next kernel":
        assert "cannot hold or copy values: clEnqueueUnmapMemObject failed" in ran.stdout


LOOP = """
SPIN = '''__kernel void spin(__global float *values, const int count) {
    float value = get_global_id(0);
    for (int i = 0; i < count; i++) value = fma(value, 0.999f, 0.5f);
    values[get_global_id(0)] = value;
}'''
spin, values = device.kernel(SPIN, "spin"), device.array("values", (256,), np.float32)
begun = threading.Event()

def work():
    while True:
        spin(256, values=values, count=20_000, moved=0)
        begun.set()
        values.read()

thread = threading.Thread(target=work, daemon=True)
"""


def test_the_interpreter_ends_while_a_daemon_thread_waits_for_a_kernel(device):
    ran = run_script(device, LOOP + "thread.start(); begun.wait()")
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")


def test_what_runs_at_exit_may_wait_for_a_daemon_thread_and_use_the_device(device):
    # What was registered before the device was opened runs last.
    script = f"""
import atexit

def end():
    thread.join()
    fill(256, values=values, number=7, moved=0)
    print(set(values.read().view(np.int32).tolist()))

atexit.register(end)
{START.format(choice=device.info.title, source=FILL)}
{LOOP}
thread.start()
begun.wait()
"""
    ran = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, timeout=300)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "{7}\n", "")
