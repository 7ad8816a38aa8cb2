"""The first line of an emulated rig's file, which identifies the emulating process."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from mirrorskin.io.base.system import open_regular

_HEADING = re.compile(r"# Emulated rig: port (\S+), process (\d+), started at (\d+)\.")
_FILE_SIZE_MAX = 1 << 20  # maximum size of a rig file, bytes
_STARTED = 18  # index, after state, of the start time in /proc/PID/stat; see proc(5)


@dataclass(frozen=True, slots=True)
class Emulator:
    """The process that emulates a rig.

    Attributes
    ----------
    port : str
        Serial port of the emulated controller.
    process : int
        Process id.
    started : int
        Start of the process, in clock ticks since boot; it distinguishes processes that had the same id.
    """

    port: str
    process: int
    started: int

    @classmethod
    def here(cls, port: str) -> Self:
        """Return this process, as the emulator behind ``port``."""
        process = os.getpid()
        return cls(port, process, _start_of(process) or 0)

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """Return the emulator that wrote a rig file.

        None if the twin did not write the file, or if its port was changed: the file then belongs to the
        user.
        """
        with open_regular(path) as file:
            text = file.read(_FILE_SIZE_MAX).decode("utf-8-sig", errors="replace")
        match = _HEADING.match(text)
        if match is None or f'\nport = "{match[1]}"\n' not in text:
            return None
        return cls(match[1], int(match[2]), int(match[3]))

    @property
    def heading(self) -> str:
        """The first line of the rig file."""
        return (
            f"# Emulated rig: port {self.port}, process {self.process}, started at {self.started}."
            " The file is removed when the process ends.\n"
        )

    @property
    def running(self) -> bool:
        """Whether the process is still running."""
        return _start_of(self.process) == self.started


def _start_of(process: int) -> int | None:
    """Return when a process started, in clock ticks since boot; None if there is no such process."""
    with suppress(OSError):
        status = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
        state, *fields = status.rpartition(")")[2].split()
        return None if state == "Z" else int(fields[_STARTED])
    return None
