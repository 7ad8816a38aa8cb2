"""A picture divided among devices has the answer of one device; one that fails stops the others."""

import os
import subprocess
import sys
from concurrent.futures import Future

import h5py
import numpy as np
import pytest
from operations import CASES, assert_same
from presses import LEVELS, random_press

from mirrorskin import engine, io
from mirrorskin.engine.base.tiling import for_each_band, split_into_bands
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.errors import DeviceError

FRAMES = random_press("uint8", 30, (23, 31), seed=5)
TRAVEL = np.arange(30) * 0.1


def like(device):
    """Return another device on the same hardware, that holds memory in the same way."""
    opened = Device(device.context.devices[0])
    opened.info, opened.layout = device.info, device.layout
    return opened


@pytest.fixture(scope="module")
def devices(device):
    """Three devices of a kind."""
    return [device, like(device), like(device)]


@pytest.mark.parametrize("name", CASES)
def test_several_devices_have_the_answer_of_one(devices, name):
    case = CASES[name]
    assert_same(case.whole([1, 7, 20], device=devices), case.whole(device=devices[0]))


@pytest.mark.filterwarnings("ignore:.*matt surface:mirrorskin.io.MirrorskinWarning")  # a turn, as of lamps
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.function])
def test_functions_on_arrays_take_several_devices(devices, name):
    case = CASES[name]
    options = {**case.options, **case.given}
    result = case.function(case.frames, **options, device=devices)
    assert_same(result, case.function(case.frames, **options, device=devices[0]))


def kernels_run(device):
    return sum(record.runs for record in device.profile.records() if record.kind == "kernel")


def test_all_devices_work(devices):
    before = [kernels_run(device) for device in devices]
    engine.find_onset(FRAMES, TRAVEL, **LEVELS["uint8"], device=devices[1:])
    after = [kernels_run(device) for device in devices]
    assert [new > old for new, old in zip(after, before, strict=True)] == [False, True, True]


def test_a_device_with_less_memory_divides_its_rows_further(devices):
    small = like(devices[0])
    small.max_allocation = 3 * 64 * 4  # three planes of frame numbers of one row
    onset = engine.find_onset(FRAMES, TRAVEL, **LEVELS["uint8"], device=[devices[0], small])
    assert_same(onset, engine.find_onset(FRAMES, TRAVEL, **LEVELS["uint8"], device=devices[0]))


def test_more_devices_than_rows_are_not_all_used(devices):
    onset = engine.find_onset(FRAMES[:, :2], TRAVEL, **LEVELS["uint8"], device=devices)
    assert_same(onset, engine.find_onset(FRAMES[:, :2], TRAVEL, **LEVELS["uint8"], device=devices[0]))


def test_the_error_of_a_device_names_it(devices, monkeypatch):
    def fail(*names, **defines):
        raise DeviceError("it cannot run")

    monkeypatch.setattr(devices[1], "kernel", fail)
    with pytest.raises(DeviceError, match=rf"^device {devices[1].number}: it cannot run$"):
        engine.find_onset(FRAMES, TRAVEL, **LEVELS["uint8"], device=devices)


def bands_of(devices):
    return split_into_bands(devices, FRAMES.shape[1:], FRAMES.dtype, {}, 1)


def test_a_device_stops_before_its_next_frames_if_another_one_fails(devices):
    bands, staged = bands_of(devices[:2]), []

    def work(band):
        if band is bands[0]:
            raise DeviceError("it cannot run")
        for part in (FRAMES[:1], FRAMES[1:2]):
            for block in band.stage(part, whole=True):
                staged.append(block)
                assert band.stop.wait(60)

    with pytest.raises(DeviceError, match="it cannot run"):
        for_each_band(bands, work)
    assert len(staged) <= 1


def test_devices_can_be_used_again_after_one_failed(devices):
    bands, broken = bands_of(devices), [True]

    def work(band):
        if band is bands[0] and broken:
            raise DeviceError("it cannot run")
        return next(band.stage(FRAMES, whole=True)).frames.start

    with pytest.raises(DeviceError):
        for_each_band(bands, work)
    broken.clear()
    assert for_each_band(bands, work) == [0, 0, 0]


def test_ctrl_c_stops_all_devices(devices, monkeypatch):
    def interrupt(future):
        raise KeyboardInterrupt

    stopped = []
    monkeypatch.setattr(Future, "exception", interrupt)  # where the main thread waits
    with pytest.raises(KeyboardInterrupt):
        for_each_band(bands_of(devices), lambda band: stopped.append(band.stop.wait(60)))
    assert stopped == [True] * 3


def test_frames_on_a_device_are_not_divided_among_several(devices):
    frames = devices[0].from_host("frames", FRAMES, FRAMES.dtype)
    for choice in ("all", devices):
        with pytest.raises(io.InputError, match="several devices are chosen: leave device out"):
            engine.find_onset(frames, TRAVEL, **LEVELS["uint8"], device=choice)


def test_a_chain_of_steps_takes_several_devices(devices):
    press = {"travel": TRAVEL, "pixel_size": 0.05, "dark": 20.0, "bright": 220.0}
    result = engine.reconstruct(FRAMES, **press, device=devices)
    assert_same(result, engine.reconstruct(FRAMES, **press, device=devices[0]))
    assert result.process["device"] == f"3 x {devices[0].info.title}"


@pytest.fixture(scope="module")
def two_processors():
    """Variables for a process in which PoCL offers two devices."""
    if "Portable Computing Language" not in open_device().info.platform:
        pytest.skip("only PoCL can offer a processor as several devices")
    return {**os.environ, "POCL_DEVICES": "pthread pthread"}


def test_the_command_line_divides_a_picture_among_all_devices(tmp_path, two_processors):
    with h5py.File(tmp_path / "press.h5", "w") as file:
        file["frames"] = FRAMES
    for choice in ("0", "all"):
        words = [
            "reconstruct",
            "press.h5",
            "--motion",
            "vertical",
            "--travel-step",
            "0.1mm",
            "--device",
            choice,
        ]
        subprocess.run(
            [sys.executable, "-m", "mirrorskin.cli.main", *words, "-o", f"{choice}.h5"],
            cwd=tmp_path, env=two_processors, check=True, timeout=300,
        )  # fmt: skip
    single, both = (io.open_result(tmp_path / f"{choice}.h5") for choice in ("0", "all"))
    assert_same(both, single)
    assert both.process["device"] == f"2 x {single.process['device']}"
