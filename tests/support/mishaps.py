"""Mishaps of rigs in motion: their list, and the conditions that must hold afterwards."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import structs
from rig_faults import AFTERWARDS, FAULTS, FIRMWARE_ONLY

from mirrorskin import io
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.rig.plans import AxialPlan, Plan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SOON = 0.2
"""Seconds within which a stage must rest after a mishap."""

PATIENCE = 7.0
"""Seconds after which whatever waits must have given up: 5 for a camera's first frame, and 2 for a stage."""

FULL = 2_950_000
"""Bytes that a full disk takes: the maps, what is kept free to the end, and some tens of frames."""

ON_THE_WAY = 0.3
"""Seconds more that a camera may be silent where it does not matter when frames came: 3 times ``stall``."""

_START = 60.0
_LATEST = 3.0  # seconds after the first move that a mishap comes


class Outcome(NamedTuple):
    """What came of a capture that met with a mishap."""

    error: BaseException | None
    moved_at: bool  # whether the stage still moved so soon after
    seconds: float  # from the mishap to the end
    happened: bool  # whether it came before the capture's end


INSIDE = [name for name in FAULTS if name not in FIRMWARE_ONLY | AFTERWARDS | {"none"}]
"""What happens within a process."""


def make_rig(seed: int, rate: float, clock: Clock = SYSTEM) -> EmulatedRig:
    """Return an emulated rig with a small picture."""
    return EmulatedRig("sphere", shape=(120, 160), pixel_size=0.08, rate=rate, seed=seed, clock=clock)


def make_plan(chance: random.Random) -> Plan:
    """Return a press or a rotation of about two seconds."""
    if chance.random() < 0.5:
        return VerticalPlan(0.0, 2.0, speed=1.0)
    return AxialPlan(1.0, np.radians(2.5), turns=2.0, rate=1.0)


def capture_with(fault: str, seed: int, path: Path) -> Outcome:
    """Capture on simulated time, let a fault come at a random moment of a move, and tell how it ended."""
    chance, error, clock, came = random.Random(seed), None, SimulatedClock(), list[float]()
    with make_rig(seed, 60.0, clock) as emulated:
        settings = emulated.settings
        settings = replace(settings, camera=structs.replace(settings.camera, delay=0.0))
        delay, over = chance.uniform(0, _LATEST), clock.event()

        def trouble() -> None:
            while not emulated.machine.moving() and not over.wait(0.001):
                pass
            over.wait(delay)
            while not emulated.machine.moving() and not over.wait(0.001):  # in mid-move
                pass
            if not over.is_set():
                came.append(clock.now())
                FAULTS[fault][0](emulated)

        thread = clock.thread(trouble, "trouble")
        thread.start()
        try:
            with Rig(emulated.open_stage(settings.stage), emulated.camera, settings, clock) as rig:
                _drain(rig, make_plan(chance), path)
        except (HardwareError, io.InputError, KeyboardInterrupt) as caught:
            error = caught
        ended = clock.now()
        over.set()
        thread.join()
        at = came[0] if came else ended
        soon = at + SOON + (ON_THE_WAY if fault == "camera stalls" else 0)
        clock.sleep(max(0.0, soon - ended))
        return Outcome(error, emulated.machine.moving(soon), ended - at, bool(came))


def _drain(rig: Rig, plan: Plan, path: Path) -> None:
    with io.StreamRecorder(SweepScan(rig, plan), path) as recorder:
        buffer = np.empty((8, *recorder.shape[1:]), recorder.dtype)
        while recorder.read(buffer) is not None:
            pass


class Child:
    """``mirrorskin capture`` as a process, on an emulated rig of this one."""

    def __init__(self, folder: Path, rig_file: Path, words: list[str], limit: int | None = None) -> None:
        self.recording = folder / "cut.h5"
        unmeasured = "from mirrorskin.hw.base.rig_file import CameraSettings; CameraSettings.streamed = False"
        program = f"{unmeasured}; from mirrorskin.cli.main import main; main()"
        if limit is not None:
            program = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit},) * 2); {program}"
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-B", "-P", "-c", program, "capture", *words),
                *("--rig", str(rig_file), "-o", str(self.recording)),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait(self) -> str:
        """Wait for its end, and return what it complained of."""
        return self.process.communicate(timeout=_START)[1]


def starved(message: str) -> bool:
    """Return whether a capture ended because this machine was too busy to emulate a rig in time."""
    return any(words in message for words in ("no longer answers", "delivered no frame", "stood still"))


def state_of(path: Path) -> str | None:
    """Return the state of a recording, which must be readable; None if nothing was written, or too little."""
    if not path.exists():
        return None
    try:
        with io.open_recording(path) as recording:
            buffer = np.empty(recording.shape, recording.dtype)
            assert recording.read(buffer) is not None
            return recording.state
    except io.InputError as error:
        if "at least 2 are needed" not in str(error):
            raise
        return None


def frames_of(path: Path) -> np.ndarray:
    """Return the frames of a recording, which can be read."""
    with io.open_recording(path) as recording:
        buffer = np.empty(recording.shape, recording.dtype)
        block = recording.read(buffer)
        assert block is not None
        return block.frames


def words(chance: random.Random) -> list[str]:
    """Return the options of a press or a rotation of about two seconds."""
    if chance.random() < 0.5:
        return ["vertical", "--stop", "2mm", "--speed", "1mm/s"]
    return ["axial", "--press", "1mm", "--turns", "2", "--rate", "1"]


def has_frames(child: Child) -> bool:
    """Wait until a capture has some frames on disk; False if it ended before."""
    deadline = time.monotonic() + _START
    while state_of(child.recording) is None:
        if child.process.poll() is not None:
            return False
        assert time.monotonic() < deadline, "the capture does not come to work"
        time.sleep(0.02)
    return True


def rest(rig: EmulatedRig) -> None:
    """Wait until a stage that nobody stopped has come to its end."""
    deadline = time.monotonic() + _START
    while rig.machine.moving():
        assert time.monotonic() < deadline
        time.sleep(0.02)
