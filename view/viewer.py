"""rerun's viewer: started on this machine and accessible from it only, or a file to be viewed later."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mirrorskin.io import InputError, check_output

WINDOW, BROWSER = "window", "browser"
"""Where pictures can be shown, in addition to a file."""

_HERE = "127.0.0.1"
_SUFFIX = ".rrd"
_START = 20.0  # seconds to wait until the viewer listens
_MEMORY = "1GB"  # of pictures that the viewer keeps, the newest ones
_VIEWERS: list[subprocess.Popen[bytes]] = []  # viewers outlive the streams


def load_rerun() -> Any:
    """Return the module rerun, or raise InputError with the remedy."""
    if find_spec("rerun") is None:
        raise InputError("live pictures need rerun: pip install 'mirrorskin[live]'")
    import rerun

    return rerun


def open_stream(where: str | Path, option: str) -> Any:
    """Open a stream of pictures to a viewer or a file."""
    check_place(where, option)
    stream = load_rerun().RecordingStream("mirrorskin", send_properties=False)
    if str(where) in (WINDOW, BROWSER):
        stream.connect_grpc(f"rerun+http://{_HERE}:{_start(str(where), option)}/proxy")
    else:
        stream.save(where)
    return stream


def check_place(where: str | Path, option: str) -> None:
    """Raise InputError if nothing can be shown there, before any work is done; see ``open_stream``."""
    load_rerun()
    if str(where) in (WINDOW, BROWSER):
        return
    if Path(where).suffix.lower() != _SUFFIX:
        raise InputError(f"{option} {where}: give {WINDOW}, {BROWSER} or a FILE{_SUFFIX}")
    check_output(Path(where))


def close_stream(stream: Any, patience: float) -> None:
    """Wait up to ``patience`` seconds for the last pictures to arrive; the viewer stays open."""
    with suppress(RuntimeError, ValueError):  # the viewer was closed
        stream.flush(timeout_sec=patience)
    with suppress(RuntimeError, ValueError):
        stream.disconnect()


def _start(where: str, option: str) -> int:
    """Start a viewer, wait until it listens, and return its port."""
    port = _free_port()
    # Not through the command "rerun", which takes most of a second to import.
    words = [sys.executable, "-P", "-m", "rerun_cli", "--bind", _HERE, "--port", str(port)]
    words += ["--server-memory-limit", _MEMORY, "--memory-limit", _MEMORY]
    if where == BROWSER:
        words += ["--web-viewer", "--web-viewer-port", str(_free_port())]
    quiet = subprocess.DEVNULL
    # In its own session, because Ctrl-C should end the run but keep the viewer.
    viewer = subprocess.Popen(words, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    _VIEWERS.append(viewer)
    deadline = time.monotonic() + _START
    while not _listens(port):
        if viewer.poll() is not None or time.monotonic() > deadline:
            with suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGKILL)  # the module starts another process
            viewer.wait()
            remedy = f"take {option} {BROWSER}, or {option} FILE.rrd" if where == WINDOW else "see 'rerun'"
            raise InputError(f"rerun's viewer does not start here: {remedy}")
        time.sleep(0.05)
    return port


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_HERE, 0))
        return int(probe.getsockname()[1])


def _listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection((_HERE, port), timeout=0.2):
        return True
    return False
