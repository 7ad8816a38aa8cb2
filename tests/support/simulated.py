"""Commands on simulated time: their rigs, stages and cameras."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mirrorskin import hw
from mirrorskin.hw.rig import check
from mirrorskin.hw.rig import rig as rigs
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock


def simulate(
    patch: pytest.MonkeyPatch,
    clock: SimulatedClock,
    open_stage: Callable[..., Any] | None = None,
    open_camera: Callable[..., Any] | None = None,
) -> None:
    """Let commands open what the rig file says, or what these open, on a simulated clock."""
    stage = open_stage or functools.partial(rigs.open_stage, clock=clock)
    camera = open_camera or functools.partial(rigs.open_camera, clock=clock)
    both = {"clock": clock, "open_stage": stage, "open_camera": camera}
    opened = functools.partial(rigs.open_rig, **both)
    for place in (rigs, hw):  # the package keeps what it has given
        patch.setattr(place, "open_rig", opened)
    patch.setattr(check, "check_rig", functools.partial(check.check_rig, **both))
    patch.setattr(rigs, "open_stage", stage)
    patch.setattr(rigs, "open_camera", camera)


@contextmanager
def simulated_rig(
    folder: Path, shape: tuple[int, int], rate: float, delay: float, **scene: Any
) -> Iterator[tuple[EmulatedRig, Path]]:
    """Run an emulated rig on simulated time, give it and its file, and let commands open it."""
    clock = SimulatedClock()
    with (
        pytest.MonkeyPatch.context() as patch,
        EmulatedRig(shape=shape, pixel_size=0.2, rate=rate, delay=delay, clock=clock, **scene) as rig,
    ):
        simulate(patch, clock, rig.open_stage, rig.open_camera)
        file = rig.write(folder, "0")
        text = file.read_text().replace("[camera]", f"[camera]\ndelay = {delay}\ndark = 16")
        file.write_text(text.replace("report_rate = 20.0", "report_rate = 50.0"))
        yield rig, file


FILM = """
[camera]
source = "film.y4m"
size = [8, 6]
rate = 50
dark = 0
delay = 0
"""


def write_film_rig(folder: Path, stage: str) -> None:
    """Write a rig file whose camera is a film of 200 s."""
    (folder / "rig.toml").write_text(stage + FILM)
    frame = b"FRAME\n" + bytes(range(0, 96, 2))
    (folder / "film.y4m").write_bytes(b"YUV4MPEG2 W8 H6 F50:1 Ip A1:1 Cmono\n" + frame * 10_000)


def on_clock(clock: SimulatedClock) -> dict[str, Any]:
    """Return what stands in for the modules ``time`` and ``threading`` in a user's class."""
    return {
        "time": SimpleNamespace(monotonic=clock.now, sleep=clock.sleep),
        "threading": SimpleNamespace(
            Lock=clock.condition, Event=clock.event, Thread=lambda target: clock.thread(target, "user's")
        ),
    }
