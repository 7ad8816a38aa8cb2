"""An emulated rig behind its file, for tests of commands: emulators that may be late."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mirrorskin.hw.emulator import rig as emulators
from mirrorskin.hw.emulator.rig import EmulatedRig
from mirrorskin.hw.grbl import link as links
from mirrorskin.hw.rig import rig as rigs
from mirrorskin.hw.rig_file import CameraSettings

LATE = 5.0
"""Seconds that an emulator may be late; a rig file allows no more."""

_LATER = 60.0  # seconds, where no rig file sets a limit


def allow_delays(patch: pytest.MonkeyPatch) -> None:
    """Accept that threads and emulators are late while other programs use the processors."""
    for name in ("_SILENCE", "_STALL"):
        patch.setattr(emulators, name, LATE)
    patch.setattr(emulators, "_TIMEOUT", _LATER)
    patch.setattr(links, "_WRITE", _LATER)
    for name in ("_PAUSE", "_PATIENCE"):
        patch.setattr(rigs, name, _LATER)


@contextmanager
def served_rig(
    folder: Path, shape: tuple[int, int], rate: float, delay: float, **scene: Any
) -> Iterator[tuple[EmulatedRig, Path]]:
    """Run the emulators, and give them and the rig's file."""
    with (
        pytest.MonkeyPatch.context() as patch,
        EmulatedRig(shape=shape, pixel_size=0.2, rate=rate, delay=delay, **scene) as rig,
        rig.serve() as server,
    ):
        allow_delays(patch)
        patch.setattr(CameraSettings, "streamed", False)  # so that the delay need not be measured
        file = rig.write(folder, server.url)
        text = file.read_text().replace("[camera]", f"[camera]\ndelay = {delay}\ndark = 16")
        file.write_text(text.replace("report_rate = 20.0", "report_rate = 50.0"))
        yield rig, file
