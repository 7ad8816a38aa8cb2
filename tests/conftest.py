"""The devices that the tests run on: every one that OpenCL finds, in every way of holding memory."""

from __future__ import annotations

import dataclasses

import pytest

from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import Device, list_devices

FOUND = list_devices()
if not FOUND:
    raise RuntimeError("no OpenCL device found: the tests need one; 'make test' brings PoCL")

# A device that shares the host's memory can also be treated as one that does not, and a core as a lane.
WAYS = [
    (number, shared, tile)
    for number, info in enumerate(FOUND)
    for shared, tile in ([(True, 1024), (False, 1)] if info.shares_memory else [(False, 1)])
]


@pytest.fixture(
    scope="session",
    params=WAYS,
    ids=[f"{FOUND[n].kind}{n}-{'shared' if s else 'copied'}-{t}" for n, s, t in WAYS],
)
def device(request):
    """Every OpenCL device; each that shares the host's memory once more with copies and single pixels."""
    number, shared, tile = request.param
    opened = Device(device_layer._find()[number])
    opened.info = dataclasses.replace(opened.info, shares_memory=shared)
    opened.tile = tile
    return opened


@pytest.fixture
def small_device(device):
    """The device with a limit to its buffers that a test may set."""
    limit = device.max_allocation
    yield device
    device.max_allocation = limit
