"""The devices of the tests: all that OpenCL finds, with each kind of memory."""

from __future__ import annotations

import dataclasses
import os
import signal

# Threads of BLAS that wait for each other take much processor time. It is read when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from mirrorskin.evaluation.portability.gpu_check import taken_for_gpu
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels import embedded
from mirrorskin.kernels.device import Device, list_devices
from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

# The processes that tests start, a hundred of them, need not each compile all modules anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# A test opens no window, which nobody would close.
os.environ["MPLBACKEND"] = "agg"
# Nor does the developer's own configuration matter.
os.environ["MIRRORSKIN_CONFIG"] = ""
FOUND = list_devices()
if not FOUND:
    raise RuntimeError("no OpenCL device found: the tests need one; 'make test' brings PoCL")

# Any device can be given work in either layout; and one that shares the host's memory can also be treated as
# one that does not.
LAYOUTS = {"cpu": CPU_LAYOUT, "gpu": GPU_LAYOUT}
WAYS = [
    (number, shared, layout)
    for number, info in enumerate(FOUND)
    for shared, layout in [(info.shares_memory, "cpu"), (False, "gpu")]
]


@pytest.fixture(autouse=True)
def _default_interrupt():
    """Shells start what runs in the background deaf to Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """One more than there are cores, as some tests wait for processes that they start."""
    return (os.cpu_count() or 1) + 1


def pytest_report_header():
    """Which processor gave the results, since the last bits of floats depend on it."""
    processor, _ = embedded.compiler()
    return f"OpenCL: {', '.join(info.title for info in FOUND)}; PoCL compiles for {processor}"


def pytest_configure(config):
    config.addinivalue_line("markers", "device: runs on each OpenCL device")
    config.addinivalue_line("markers", "slow: only 'make test-all' runs it")
    config.addinivalue_line(
        "markers", "real_time: it measures time, so that 'make test-all' runs it alone; this makes it slow"
    )


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their markers
def pytest_collection_modifyitems(items):
    for item in items:
        if "device" in item.fixturenames:
            item.add_marker("device")
        if item.get_closest_marker("real_time"):  # 'make test' runs tests beside others
            item.add_marker("slow")


def _way(number, shared, layout):
    name = f"{FOUND[number].kind}{number}-{'shared' if shared else 'copied'}-{layout}"
    return pytest.param(
        (number, shared, layout), id=name, marks=[pytest.mark.slow] if layout != "cpu" else []
    )


@pytest.fixture(scope="session", params=[_way(*way) for way in WAYS])
def device(request):
    """Every OpenCL device, in either layout; memory is shared where it can be."""
    number, shared, layout = request.param
    opened = Device(device_layer._find()[number])
    opened.info = dataclasses.replace(opened.info, shares_memory=shared)
    opened.layout = LAYOUTS[layout]
    return opened


@pytest.fixture(scope="module")
def card():
    """A device that is treated as a GPU with its own memory."""
    opened = Device(device_layer._find()[0])
    taken_for_gpu(opened)
    return opened


@pytest.fixture
def small_device(device):
    """The device with a limit to its buffers that a test may set."""
    limit = device.max_allocation
    yield device
    device.max_allocation = limit


@pytest.fixture
def clock():
    """A clock that jumps from event to event; no thread of it is left when the test ends."""
    made = SimulatedClock()
    yield made
    assert made.threads == []


@pytest.fixture
def simulated(clock, monkeypatch):
    """Let commands open rigs, stages and cameras on simulated time."""
    from simulated import simulate  # which imports all hardware

    simulate(monkeypatch, clock)
    return clock
