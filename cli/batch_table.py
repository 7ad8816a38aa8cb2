"""What a batch shows while it runs: a table on a terminal, a line for each file in a pipe."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rich.console import RenderableType

    from mirrorskin.engine.batch.jobs import Job
    from mirrorskin.engine.batch.work import Outcome

_ROWS = 12  # of files that have ended
# What other commands have as options, a batch has in its settings.
_OPTIONS = re.compile("--(dataset|motion|travel-step|travel-start|phase-step|pixel-size)(?![a-z-])")


@contextmanager
def show_batch(total: int, as_json: bool) -> Iterator[Show]:
    """Show how a batch of so many files goes."""
    if sys.stderr.isatty() and (as_json or sys.stdout.isatty()):
        from rich.console import Console
        from rich.live import Live

        table = _Table(total)
        console = Console(stderr=True)
        with Live(get_renderable=table.render, console=console, transient=True, refresh_per_second=4):
            yield table
    else:
        yield Show(not as_json)


def problem(outcome: Outcome) -> str:
    """Tell in a line what is wrong, and with which file."""
    name, message = str(outcome.job.source), " ".join(outcome.message.split())
    message = _OPTIONS.sub(r"\1 in [stack] of --settings", message)
    return printable(message if name in message else f"{name}: {message}")


def printable(text: str) -> str:
    """Return a text of one line that any output takes: a file's name may be any bytes."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    known = text.encode(encoding, "replace").decode(encoding)
    return "".join(letter if letter.isprintable() else "?" for letter in known)


class Show:
    """Shows how a batch goes: a line for each file, if wanted."""

    def __init__(self, wanted: bool) -> None:
        self._wanted = wanted

    def under_way(self, job: Job, frames: int, /) -> None:
        """Take note, from any thread, that so many frames of a job were read."""

    def ended(self, outcome: Outcome, /) -> None:
        """Take note of what became of a job."""
        if not self._wanted:
            return
        line = f"{outcome.state}: {printable(str(outcome.job.source))}"
        if outcome.state == "failed":
            line = f"failed: {problem(outcome)}"
        elif outcome.state == "done":
            line += f" in {outcome.seconds:.3g} s, {_speed(outcome)} MB/s: {outcome.message}"
        typer.echo(line)


class _Table(Show):
    """The files under way, the last that ended, and a bar of all."""

    def __init__(self, total: int) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._lock = threading.Lock()
        self._running: dict[Job, tuple[float, int]] = {}
        self._last: deque[Outcome] = deque(maxlen=_ROWS)
        self._states: Counter[str] = Counter()
        columns = BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn()
        self._bar = Progress(*columns)
        self._task = self._bar.add_task("", total=total)

    def under_way(self, job: Job, frames: int, /) -> None:
        with self._lock:
            start, _ = self._running.get(job, (time.monotonic(), 0))
            self._running[job] = start, frames

    def ended(self, outcome: Outcome, /) -> None:
        with self._lock:
            self._running.pop(outcome.job, None)
            self._last.append(outcome)
            self._states[outcome.state] += 1
            counts = ", ".join(f"{count} {state}" for state, count in sorted(self._states.items()))
        self._bar.update(self._task, advance=1, description=counts)

    def render(self) -> RenderableType:
        """Draw it as it is now."""
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False)
        for head in ("file", "motion", "state"):
            table.add_column(head, no_wrap=True, overflow="ellipsis")
        for head in ("seconds", "MB/s"):
            table.add_column(head, justify="right")
        with self._lock:
            last, running = list(self._last), list(self._running.items())
        for one in last:
            state = problem(one) if one.state == "failed" else one.state
            speed = _speed(one) if one.bytes else ""
            cells = printable(str(one.job.source)), one.motion, state, f"{one.seconds:.2f}", speed
            table.add_row(*map(Text, cells))
        for job, (start, frames) in running:
            state = f"{frames} frames" if frames else "begun"
            table.add_row(Text(printable(str(job.source))), "", state, f"{time.monotonic() - start:.2f}", "")
        return Group(table, self._bar)


def _speed(outcome: Outcome) -> str:
    return f"{outcome.bytes / 1e6 / outcome.seconds:.0f}"
