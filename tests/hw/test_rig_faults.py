"""What goes wrong on the emulated rig while it captures: the stage stops, and what was taken is kept."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pytest
from msgspec import structs

from mirrorskin import io
from mirrorskin.hw.emulator.rig import EmulatedRig
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.rig.plans import VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.sweep import SweepScan

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

SOON = 1.0  # seconds; it is 0.2 on a machine that has nothing else to do
LATE = 5.0


def interrupt(emulated):
    raise KeyboardInterrupt


# What is done to the rig, and what the recording says of it then; more is done in tests/soak/test_mishaps.py.
FAULTS = {
    "silence": (lambda emulated: emulated.port.silence(), "no longer answers"),
    "alarm": (lambda emulated: emulated.port.alarm(1), "ALARM:1"),
    "stalled": (lambda emulated: emulated.camera.stall(), "gave no frame"),
    "Ctrl-C": (interrupt, "stopped by the user"),
}


@dataclass
class Mishap:
    """How a capture ended."""

    error: BaseException
    moved: float  # seconds that the stage went on
    lasted: float  # seconds until the reader was told
    count: int
    state: str


def capture(name, path):
    """Press slowly, and have the fault after some frames."""
    at = None
    with EmulatedRig(shape=(24, 32), pixel_size=0.2, rate=50.0, delay=0.01) as emulated:
        settings = emulated.settings
        settings = replace(settings, camera=structs.replace(settings.camera, delay=0.01, dark=16.0))
        try:
            with Rig(GrblStage(settings.stage), emulated.camera, settings) as rig:
                # Emulators are late where other programs have the processors; that is no fault here.
                if name != "stalled":
                    rig._stall = LATE
                if name != "silence":
                    rig.stage._link._limit = lambda: LATE
                scan = SweepScan(rig, VerticalPlan(0.0, 3.0, speed=0.6))
                with io.StreamRecorder(scan, path) as recorder:
                    room = np.empty((4, *scan.shape[1:]), scan.dtype)
                    while recorder.read(room) is not None:
                        if at is None and recorder.count > 8:
                            at = time.monotonic()
                            FAULTS[name][0](emulated)
        except (HardwareError, KeyboardInterrupt) as caught:
            error = caught
        told = time.monotonic()
        moved = [late for late in np.arange(0, LATE, 0.01) if emulated.machine.moving(min(at + late, told))]
    with io.open_recording(path) as recording:
        count, state = recording.shape[0], recording.state
    return Mishap(error, max(moved, default=0.0), told - at, count, state)


@pytest.fixture(scope="module")
def mishaps(tmp_path_factory):
    """All faults at once: most of the time nothing is to be done."""
    folder = tmp_path_factory.mktemp("faults")
    with ThreadPoolExecutor(len(FAULTS)) as pool:
        tasks = {name: pool.submit(capture, name, folder / f"{name}.h5") for name in FAULTS}
        return {name: task.result() for name, task in tasks.items()}


@pytest.mark.parametrize("name", FAULTS)
def test_the_stage_stops_and_the_reader_is_told(mishaps, name):
    mishap = mishaps[name]
    assert mishap.moved < SOON
    assert mishap.lasted < LATE
    if name != "Ctrl-C":
        assert FAULTS[name][1] in str(mishap.error)
        assert "\n" not in str(mishap.error)


@pytest.mark.parametrize("name", FAULTS)
def test_what_was_taken_is_kept_and_says_why_it_ends(mishaps, name):
    mishap = mishaps[name]
    assert mishap.count >= 8
    assert mishap.state.startswith("cut short: ")
    assert FAULTS[name][1] in mishap.state
