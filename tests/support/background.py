"""Programs started from a terminal, and servers that outlive the command that started them."""

from __future__ import annotations

import os
import re
import select
import signal
import sys
from pathlib import Path

_PATIENCE = 60_000  # ms, for a busy machine


def install(folder: Path) -> dict[str, str]:
    """Put the program ``mirrorskin`` into a folder, and return an environment that finds it there."""
    folder.mkdir(parents=True)
    program = folder / "mirrorskin"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -P -m mirrorskin.cli.main "$@"\n')
    program.chmod(0o755)
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}


def process_of(printed: str) -> int:
    """Return the process that ``twin serve --background`` says how to end."""
    number = re.search(r"end it with 'kill (\d+)'", printed)
    assert number is not None, printed
    return int(number[1])


def end(process: int, number: int = signal.SIGTERM) -> None:
    """Send a signal to a process, which need not be a child, and wait until it has ended."""
    handle = os.pidfd_open(process)
    try:
        ended = select.poll()
        ended.register(handle, select.POLLIN)
        signal.pidfd_send_signal(handle, number)
        assert ended.poll(_PATIENCE), f"process {process} goes on"
    finally:
        os.close(handle)
