"""Rigs that meet with a mishap while they move: what can happen, and what must hold afterwards."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import structs

from mirrorskin import io
from mirrorskin.hw.emulator.rig import EmulatedRig
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.rig.plans import AxialPlan, Plan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.sweep import SweepScan

SOON = 0.2
"""Seconds within which a stage must rest after a mishap."""

PATIENCE = 7.0
"""Seconds after which whatever waits must have given up: 5 for a camera's first frame, and 2 for a stage."""

FULL = 2_950_000
"""Bytes that a full disk takes: the maps, what is kept free to the end, and some tens of frames."""

ON_THE_WAY = 0.3
"""Seconds more that a camera may be silent where it does not matter when frames came: 3 times ``stall``."""

_START = 30.0
_LATEST = 1.5  # seconds after the first move that a mishap comes

Mishap = Callable[[EmulatedRig, int], None]


class Outcome(NamedTuple):
    """What came of a capture that met with a mishap."""

    error: BaseException | None
    moved_at: bool  # whether the stage still moved so soon after
    seconds: float  # from the mishap to the end
    happened: bool  # whether it came before the capture's end


INSIDE: dict[str, Mishap] = {
    "serial silence": lambda rig, seed: rig.port.silence(),
    "garbage": lambda rig, seed: rig.port.garble(100_000, seed),
    "unplugged": lambda rig, seed: rig.port.unplug(),
    "camera stalls": lambda rig, seed: rig.camera.stall(),
    "camera lost": lambda rig, seed: rig.camera.lose(),
    "Ctrl-C": lambda rig, seed: os.kill(os.getpid(), signal.SIGINT),
}
"""What happens within a process."""


def make_rig(seed: int, rate: float) -> EmulatedRig:
    """Return an emulated rig with a small picture."""
    return EmulatedRig("sphere", shape=(120, 160), pixel_size=0.08, rate=rate, seed=seed)


def make_plan(chance: random.Random) -> Plan:
    """Return a press or a rotation of about two seconds."""
    if chance.random() < 0.5:
        return VerticalPlan(0.0, 2.0, speed=1.0)
    return AxialPlan(1.0, np.radians(2.5), turns=2.0, rate=1.0)


def capture_with(mishap: Mishap, seed: int, path: Path) -> Outcome:
    """Capture, let a mishap come at a random moment in some move, and tell how it ended."""
    chance, error = random.Random(seed), None
    with ExitStack() as stack:
        emulated = stack.enter_context(make_rig(seed, rate=60.0))
        emulated.camera.take(1, _START)
        settings = emulated.settings
        settings = replace(settings, camera=structs.replace(settings.camera, delay=0.0))
        over = threading.Event()
        trouble = _Trouble(emulated, mishap, seed, chance.uniform(0, _LATEST), over)
        try:
            with Rig(GrblStage(settings.stage), emulated.camera, settings) as rig:
                trouble.start()
                _drain(rig, make_plan(chance), path)
                over.set()
        except (HardwareError, io.InputError, KeyboardInterrupt) as caught:
            error = caught
        ended = time.monotonic()
        with suppress(KeyboardInterrupt):  # if it came after all was done
            over.set()
            trouble.join()
        happened = trouble.at is not None and trouble.at < ended and error is not None
        at = trouble.at or ended
        soon = at + SOON + (ON_THE_WAY if mishap is INSIDE["camera stalls"] else 0)
        while time.monotonic() < soon:
            time.sleep(0.01)
        return Outcome(error, emulated.machine.moving(soon), ended - at, happened)


def _drain(rig: Rig, plan: Plan, path: Path) -> None:
    with io.StreamRecorder(SweepScan(rig, plan), path) as recorder:
        room = np.empty((8, *recorder.shape[1:]), recorder.dtype)
        while recorder.read(room) is not None:
            pass


class _Trouble(threading.Thread):
    """Waits for a first move, and so many seconds longer; then it happens."""

    def __init__(
        self, rig: EmulatedRig, mishap: Mishap, seed: int, delay: float, over: threading.Event
    ) -> None:
        super().__init__(name="trouble")
        self.at: float | None = None
        self._rig, self._mishap, self._seed, self._delay, self._over = rig, mishap, seed, delay, over

    def run(self) -> None:
        deadline = time.monotonic() + _START
        while not self._rig.machine.moving() and time.monotonic() < deadline:
            time.sleep(0.002)
        if self._over.wait(self._delay):
            return
        while not self._rig.machine.moving() and not self._over.is_set():  # in mid-move
            time.sleep(0.002)
        if not self._over.is_set():
            self.at = time.monotonic()
            self._mishap(self._rig, self._seed)


class Child:
    """``mirrorskin capture`` as a process, on an emulated rig of this one."""

    def __init__(self, folder: Path, rig_file: Path, words: list[str], limit: int | None = None) -> None:
        self.recording = folder / "cut.h5"
        unmeasured = "from mirrorskin.hw.rig_file import CameraSettings; CameraSettings.streamed = False"
        program = f"{unmeasured}; from mirrorskin.cli.main import main; main()"
        if limit is not None:
            program = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit},) * 2); {program}"
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-P", "-c", program, "capture", *words),
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


def starved(said: str) -> bool:
    """Return whether a capture ended because this machine was too busy to emulate a rig in time."""
    return any(words in said for words in ("no longer answers", "gave no frame", "stood still"))


def state_of(path: Path) -> str | None:
    """Return the state of a recording, which must be readable; None if nothing was written, or too little."""
    if not path.exists():
        return None
    try:
        with io.open_recording(path) as recording:
            room = np.empty(recording.shape, recording.dtype)
            assert recording.read(room) is not None
            return recording.state
    except io.InputError as error:
        if "at least 2 are needed" not in str(error):
            raise
        return None


def frames_of(path: Path) -> np.ndarray:
    """Return the frames of a recording, which can be read."""
    with io.open_recording(path) as recording:
        room = np.empty(recording.shape, recording.dtype)
        block = recording.read(room)
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
