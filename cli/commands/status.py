"""Status of live work: rates and latencies on a terminal, pictures in a viewer."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from mirrorskin.engine.live import Status, Update
    from mirrorskin.view.live import LiveView

_JOIN = 5.0  # seconds for a viewer to show the last picture
_LOOK = 0.2  # seconds after which a waiting viewer looks whether it is over


class Newest:
    """Passes updates to a viewer in a separate thread; a slow viewer misses some, and delays nothing."""

    def __init__(self, viewer: LiveView) -> None:
        self._viewer = viewer
        self._change = threading.Condition()
        self._next: tuple[Update, Status] | None = None
        self._over = False
        self.error: Exception | None = None
        # A viewer that hangs must not keep the program from ending.
        self._thread = threading.Thread(target=self._show, name="viewer", daemon=True)
        self._thread.start()

    def show(self, update: Update, status: Status) -> None:
        """Replace the update that is shown next."""
        with self._change:
            self._next = update, status
            self._change.notify()

    def close(self) -> None:
        """Show the last update, and wait for it, some seconds at most."""
        with self._change:
            self._over = True
            self._change.notify()
        self._thread.join(_JOIN)

    def _show(self) -> None:
        try:
            while (coming := self._wait()) is not None:
                self._viewer.show(*coming)
        except Exception as error:  # told at the end: the run goes on without pictures
            self.error = error
        finally:
            self._viewer.close()

    def _wait(self) -> tuple[Update, Status] | None:
        """Return the update that is shown next, or None at the end."""
        with self._change:
            while self._next is None and not self._over:
                self._change.wait(_LOOK)
            coming, self._next = self._next, None
            return coming


class Board:
    """The status as a table."""

    def __init__(self) -> None:
        self._status: Status | None = None

    def tell(self, status: Status) -> None:
        """Receive a status, from any thread."""
        self._status = status

    def render(self) -> Table:
        """Return the table."""
        from rich.table import Table

        table = Table(box=None, show_header=False, pad_edge=False)
        if (status := self._status) is None:
            table.add_row("waiting for the first frames")
            return table
        table.add_row("frames", f"{status.frames} at {status.rate:.1f} Hz, {status.used} used")
        table.add_row("lost", f"{status.skipped} skipped, {status.dropped} dropped")
        table.add_row("updates", f"{status.updates}, {_per_second(status.updates, status):.1f} Hz")
        for stage, latency in status.latency.items():
            if not math.isnan(latency.median):
                table.add_row(stage, f"{1e3 * latency.median:.1f} ms, 99 % below {1e3 * latency.p99:.1f} ms")
        return table


@contextmanager
def show_status() -> Iterator[Callable[[Status], None]]:
    """Show a status on a terminal, and nothing in a pipe."""
    board = Board()
    if not sys.stderr.isatty():
        yield board.tell
        return
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    with Live(get_renderable=board.render, console=console, transient=True, refresh_per_second=4):
        yield board.tell


def summary(status: Status) -> str:
    """Return a line about how well the work kept up with the camera."""
    from mirrorskin.engine.live import SHOWN

    line = (
        f"{status.frames} frames at {_per_second(status.frames - 1, status):.4g} Hz: {status.used} used,"
        f" {status.skipped} skipped, {status.dropped} dropped; {status.updates} updates"
    )
    shown = status.latency.get(SHOWN)
    if shown is None or math.isnan(shown.median):
        return line
    return f"{line}, {1e3 * shown.median:.1f} ms from frame to map (99 % below {1e3 * shown.p99:.1f} ms)"


def _per_second(count: int, status: Status) -> float:
    return count / status.seconds if status.seconds > 0 else 0.0
