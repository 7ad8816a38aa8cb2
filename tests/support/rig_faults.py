"""Faults of a rig during capture, and how a capture ends; as a program, it prints a table.

``python tests/support/rig_faults.py [PROGRAM ...]`` has every fault on the emulated controller, on simulated
time, and on each real firmware whose program is given.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from firmware import Firmware, is_hal
from msgspec import structs

from mirrorskin import io
from mirrorskin.hw.base.clock import SYSTEM
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.rig.plans import VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.twin.emulator.rig import MACHINE, EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

LATE = 5.0
"""Seconds after which everybody must have been told."""

_PAUSE, _ATTEMPTS = 2.0, 5  # seconds
_SHAPE, _STEPS = (24, 32), 250.0
_SILENT = "silence", "killed", "paused for 2 s"


def _says(words: bytes) -> Callable[[EmulatedRig], None]:
    """Another program sends something to the controller."""
    return lambda emulated: emulated.machine.receive(words)


def _interrupt(emulated: EmulatedRig) -> None:
    if isinstance(emulated.clock, SimulatedClock):
        emulated.clock.interrupt()
        return
    os.kill(os.getpid(), signal.SIGINT)
    threading.Event().wait(LATE)


FAULTS: dict[str, tuple[Callable[[EmulatedRig], Any], str]] = {
    "silence": (lambda emulated: emulated.port.silence(), "no longer answers"),
    "garbage": (lambda emulated: emulated.port.garble(100_000), ""),
    "killed": (lambda emulated: emulated.machine.cut_power(), "no longer answers"),
    "paused for 2 s": (lambda emulated: emulated.machine.pause(_PAUSE), "no longer answers"),
    "plug pulled": (lambda emulated: emulated.port.unplug(), ""),
    "soft reset by another program": (_says(b"\x18"), ""),
    "hold by another program": (_says(b"!"), "hold"),
    "door by another program": (_says(b"\x84"), "door"),
    "G92 by another program": (_says(b"G92Z1\n"), "offset"),
    "G10 by another program": (_says(b"G10L2P1Z1\n"), ""),
    "move by another program": (_says(b"G91\nG1Z-1F60\nG90\n"), ""),
    "camera stalls": (lambda emulated: emulated.camera.stall(), "delivered no frame"),
    "camera lost": (lambda emulated: emulated.camera.lose(), "was lost"),
    "Ctrl-C": (_interrupt, "stopped by the user"),
    "none": (lambda emulated: None, ""),
}
"""What happens to a rig in the middle of a press, and words of what is said of it."""


FIRMWARE_ONLY = {"paused for 2 s"}
"""What the emulator does not know."""

AFTERWARDS = {"move by another program"}
"""Those that end with what was under way: nothing asked the stage to stop before."""

SETTINGS: dict[str, tuple[dict[int, float], str]] = {
    "reports in inches ($13=1)": ({13: 1}, "set $13=0"),
    "work position in reports ($10)": ({10: 510}, ""),  # bits beyond the second are grblHAL's
    "axis slower than asked ($112)": ({112: 30}, "at most 0.5 mm/s"),
    "steps per mm changed ($102)": ({102: 500}, "$102 is 500 steps where the rig file has 250"),
    "axis shorter than asked ($132, $20)": ({22: 1, 20: 1, 132: 4}, "soft limits"),
}
"""What is set in the controller before a rig is opened, and words of what is said; "" if it works."""

HAL_SETTINGS: dict[str, tuple[dict[int, float], str]] = {
    "no work offset in reports ($10=1)": ({10: 1}, "switch it on in $10"),
    "feeds of linear axes alone ($701=1)": ({701: 1}, "set $701=0"),
    "reports unasked, every 0.1 s ($481)": ({481: 100}, ""),
}
"""The same of grblHAL alone."""


@dataclass
class Ending:
    """How a capture ended."""

    error: BaseException | None
    moved: float  # seconds that the stage went on
    reported: float  # seconds until the reader was told
    count: int  # frames that can be read
    state: str


class TooBusyError(Exception):
    """The rig failed by itself before its fault came."""


@contextmanager
def _rig(controller: str, folder: Path, changed: Mapping[int, float]) -> Iterator[EmulatedRig]:
    """Run the twin on the "emulator", or on a firmware's program, with some settings changed."""
    with ExitStack() as stack:
        machine, clock = None, SYSTEM
        if controller == "emulator":
            assert not changed
            clock = SimulatedClock()
        else:
            machine = stack.enter_context(Firmware(controller, folder, {**MACHINE, 20: 0, 22: 0, **changed}))
        emulated = EmulatedRig(
            shape=_SHAPE, pixel_size=0.2, rate=50.0, delay=0.01, machine=machine, clock=clock
        )
        stack.enter_context(emulated).camera.take(1, 30.0)
        yield emulated


def capture(
    fault: str, controller: str, folder: Path, changed: Mapping[int, float] = MappingProxyType({})
) -> Ending:
    """Press slowly on the "emulator" or a firmware's program, and have a fault after some frames.

    A firmware that is late, where other programs have the processors, is borne if the fault is another.
    """
    at, error, path = None, None, folder / "cut.h5"
    with _rig(controller, folder, changed) as emulated:
        settings, clock = emulated.settings, emulated.clock
        stage = structs.replace(settings.stage, travel=structs.replace(settings.stage.travel, steps=_STEPS))
        if controller == "emulator":
            stage = settings.stage
        camera = structs.replace(settings.camera, delay=0.01, dark=16.0)
        if controller != "emulator" and not fault.startswith("camera"):
            camera = structs.replace(camera, stall=LATE)
        if controller != "emulator" and fault not in _SILENT:
            stage = structs.replace(stage, silence=LATE)
        try:
            stated = replace(settings, camera=camera, stage=stage)
            with Rig(emulated.open_stage(stage), emulated.camera, stated, clock) as rig:
                scan = SweepScan(rig, VerticalPlan(0.0, 3.0, speed=0.6))
                with io.StreamRecorder(scan, path) as recorder:
                    buffer = np.empty((4, *scan.shape[1:]), scan.dtype)
                    while recorder.read(buffer) is not None:
                        if at is None and recorder.count > 8:
                            at = clock.now()
                            FAULTS[fault][0](emulated)
        except (HardwareError, io.InputError, KeyboardInterrupt) as caught:
            error = caught
        reported = clock.now()
        if changed and at is None:
            return Ending(error, 0.0, 0.0, 0, "")
        if at is None:
            raise TooBusyError(str(error))
        clock.sleep(0.3)
        moved = [
            instant - at for instant in np.arange(at, clock.now(), 0.01) if emulated.machine.moving(instant)
        ]
    with io.open_recording(path) as recording:
        count, state = recording.shape[0], recording.state
    return Ending(error, max(moved, default=0.0), reported - at, count, state)


def try_capture(fault: str, controller: str, changed: Mapping[int, float] = MappingProxyType({})) -> Ending:
    """Capture, some times at most, until the fault comes."""
    for _ in range(_ATTEMPTS):
        with suppress(TooBusyError), tempfile.TemporaryDirectory() as folder:
            return capture(fault, controller, Path(folder), changed)
    raise TooBusyError(f"{fault}: {controller} is late in each of {_ATTEMPTS} attempts")


def main() -> None:
    """Print the table."""
    programs = sys.argv[1:]
    print("| fault | controller | it moved on for | told after | said | frames kept |")
    print("|---|---|---|---|---|---|")
    for fault in FAULTS:
        for controller in ["emulator", *programs]:
            if controller != "emulator" or fault not in FIRMWARE_ONLY:
                _print(fault, controller, try_capture(fault, controller))
    for program in programs:
        for fault, (changed, _) in (SETTINGS | (HAL_SETTINGS if is_hal(program) else {})).items():
            _print(fault, program, try_capture("none", program, changed))


def _print(fault: str, controller: str, ending: Ending) -> None:
    name = controller if controller == "emulator" else "grblHAL" if is_hal(controller) else "GRBL"
    message = (
        "stopped by the user" if isinstance(ending.error, KeyboardInterrupt) else str(ending.error or "-")
    )
    message = re.sub(r"stage /dev/\S+: | \(device reports.*\?\)\)", "", message)
    times = f"{ending.moved:.2f} s | {ending.reported:.2f} s" if ending.count else "- | -"
    print(f"| {fault} | {name} | {times} | {message} | {ending.count or '-'} |", flush=True)


if __name__ == "__main__":
    main()
