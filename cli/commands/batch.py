"""``mirrorskin batch``: compute results of many recordings."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import sys
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option, matches
from mirrorskin.cli.output import printable

if TYPE_CHECKING:
    from rich.console import RenderableType

    from mirrorskin.engine.batch.jobs import Job, Plan
    from mirrorskin.engine.batch.work import Outcome

# Names of results by default.
_RESULTS = ("-result.h5", "-correlation.h5", "-fused.h5")
_SHARD = re.compile("([0-9]{1,6})/([0-9]{1,6})")
_ROWS = 12  # of files that have ended
# Options of other commands that are settings of a batch.
_OPTIONS = re.compile("--(dataset|motion|travel|travel-step|travel-start|phase-step|pixel-size)(?![a-z-])")


def command(
    recordings: Annotated[
        list[str],
        Argument(metavar="FILE...", help="Recordings; '*' and '**' are expanded, also if quoted."),
    ],
    output: Annotated[
        Path, Option("--output", "-o", metavar="DIR", help="Folder for results, created if it is missing.")
    ],
    settings: Annotated[
        Path | None,
        Option(
            metavar="FILE.toml",
            help="Options, in tables [stack], [press], [rotation], [slip], or [stack] and [operation].",
        ),
    ] = None,
    device: Annotated[
        list[str] | None,
        Option(
            metavar="NAME",
            help="Number or part of the name, as in 'mirrorskin devices', or 'all'; may be given again.",
            show_default="the default one, or all GPUs",
        ),
    ] = None,
    workers: Annotated[
        int | None, Option(metavar="N", min=1, help="Number of processes on this machine (Dask).")
    ] = None,
    scheduler: Annotated[
        str | None, Option(metavar="ADDRESS", help="Use a Dask cluster: tcp://node1:8786.")
    ] = None,
    shard: Annotated[
        str | None,
        Option(metavar="K/N", help="Do only the K-th of N parts: 1/4 on one machine, 2/4 on the next, ..."),
    ] = None,
    memory: options.Memory = "256MB",
    strict: options.Strict = False,
    as_json: options.Json = False,
) -> None:
    """Reconstruct many recordings; results that exist are kept, so that a batch can be resumed."""
    from mirrorskin.io import InputError, MirrorskinWarning

    workers_of = {"--device": device, "--workers": workers, "--scheduler": scheduler}
    names = [name for name, value in workers_of.items() if value]
    if len(names) > 1:
        raise InputError(f"{' and '.join(names)} exclude each other. Give one of them")
    part, parts = map(int, match.groups()) if (match := _SHARD.fullmatch(shard or "1/1")) else (0, 0)
    if not 1 <= part <= parts:
        raise InputError(f"--shard {shard}: a part and the number of parts is needed; write e.g. 1/4")
    sources = _find(recordings, output)

    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.cli.settings import read_settings
    from mirrorskin.engine.batch.jobs import make_jobs

    plan = dataclasses.replace(read_settings(settings, bytes_of(memory, "--memory")), strict=strict)
    warnings.simplefilter("ignore", MirrorskinWarning)  # outcomes contain them
    # All are named before they are divided, so that a result has the same name on every machine.
    jobs = make_jobs(sources, output)
    if parts > 1:
        jobs = sorted(jobs, key=lambda job: job.target)[part - 1 :: parts]
    _prepare(output, jobs)
    outcomes: list[Outcome] = []
    start = time.perf_counter()
    with (
        _reporting_interruption(outcomes, len(jobs)),
        _show_batch(len(jobs), as_json) as show,
        closing(_run(jobs, plan, device, workers, scheduler, show)) as run,
    ):
        for outcome in run:
            outcomes.append(outcome)
            show.ended(outcome)
    _report(outcomes, output, time.perf_counter() - start, as_json)
    raise click.exceptions.Exit(int(any(outcome.state == "failed" for outcome in outcomes)))


def _find(words: Sequence[str], folder: Path) -> list[Path]:
    """Return the recordings, without results among them."""
    from mirrorskin.io import InputError
    from mirrorskin.io.base.url import Url, path_of

    paths: list[Path] = []
    for word in words:
        found = matches(word, "recordings")
        paths += [path_of(word)] if found is None else found
    if not any(isinstance(path, Url) or os.path.lexists(path) for path in paths):
        raise InputError(f"{paths[0]}: no such file")
    recordings = [path for path in paths if not _is_result(path, folder)]
    if not recordings:
        raise InputError(f"{words[0]}: results only. Name recordings")
    if len(recordings) < len(paths):
        click.echo(f"left out, as results: {len(paths) - len(recordings)} files", err=True)
    return recordings


def _is_result(path: Path, folder: Path) -> bool:
    """Return whether a file is a result, or was one in this folder before it was damaged."""
    from mirrorskin.io import InputError
    from mirrorskin.io.storage.hdf5 import Hdf5File
    from mirrorskin.io.storage.layout import RESULT_MARK

    if not path.name.endswith(_RESULTS) or not path.is_file():
        return False
    try:
        with Hdf5File(path) as file:
            return file.marked(RESULT_MARK)
    except InputError:
        return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _prepare(folder: Path, jobs: Sequence[Job]) -> None:
    """Create the folder, check that it can be written to, and remove temporary files of a killed batch."""
    from mirrorskin import io
    from mirrorskin.io.base.system import translate_os_errors
    from mirrorskin.io.storage.atomic import remove_leftovers

    with translate_os_errors(f"{folder} cannot be created", "choose another folder with -o"):
        if folder.exists() and not folder.is_dir():
            raise io.InputError(f"{folder} is not a folder: name one with -o")
        if not folder.parent.is_dir():
            raise io.InputError(f"{folder}: there is no folder {folder.parent}: make it first")
        folder.mkdir(exist_ok=True)
    with (
        translate_os_errors(f"{folder} cannot be written to", "choose another with -o"),
        TemporaryFile(dir=folder),
    ):
        pass
    for place in {job.target.parent for job in jobs} | {folder}:
        if place.is_dir():
            remove_leftovers(place)


def _run(
    jobs: Sequence[Job],
    plan: Plan,
    device: Sequence[str] | None,
    workers: int | None,
    scheduler: str | None,
    show: _Show,
) -> Generator[Outcome, None, None]:
    """Run the jobs here, or on a cluster; devices are opened and workers started only if there are jobs."""
    from mirrorskin.engine.batch.work import find_settled

    todo = []
    for job in jobs:
        settled = find_settled(job, plan)
        if settled is None:
            todo.append(job)
        else:
            yield settled
    if not todo:
        return
    if workers is not None or scheduler is not None:
        from mirrorskin.engine.batch.cluster import run_cluster

        yield from run_cluster(todo, plan, address=scheduler, workers=workers)
        return
    from mirrorskin.engine.batch.local import default_devices, run_local
    from mirrorskin.kernels.device import open_devices

    devices = open_devices(device) if device else default_devices()
    yield from run_local(todo, plan, devices, show.under_way)


@contextmanager
def _reporting_interruption(outcomes: Sequence[Outcome], total: int) -> Iterator[None]:
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        click.echo(f"ended after {len(outcomes)} of {total}: the same command resumes it", err=True)
        raise


def _report(outcomes: Sequence[Outcome], folder: Path, seconds: float, as_json: bool) -> None:
    """Print the outcomes of all recordings."""
    from mirrorskin.cli.output import print_json

    states = Counter({"done": 0, "kept": 0, "failed": 0})
    states.update(outcome.state for outcome in outcomes)
    size = sum(outcome.bytes for outcome in outcomes)
    if as_json:
        summary = {"output": str(folder), **states, "bytes": size, "seconds": seconds}
        print_json(summary | {"files": [_fields(outcome) for outcome in outcomes]})
        return
    for outcome in outcomes:
        if outcome.state == "failed":
            click.echo(f"failed: {_problem(outcome)}")
    counts = ", ".join(f"{count} {state}" for state, count in states.items())
    speed = f"{size / 1e9:.3g} GB in {seconds:.3g} s, {size / 1e9 / seconds:.3g} GB/s"
    recordings = "1 recording" if len(outcomes) == 1 else f"{len(outcomes)} recordings"
    click.echo(f"{printable(str(folder))}: {recordings}: {counts}; {speed}")
    warned = sum(outcome.warned for outcome in outcomes)
    if warned:
        click.echo(f"with warnings: {warned} of {states['done']}; --strict makes them failures")
    for line in _brightness_trends(outcomes):
        click.echo(line)


def _brightness_trends(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield how the brightness of the sensor changes from recording to recording, in the order of names."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.engine.metrology.measures import HEALTH
    from mirrorskin.engine.metrology.tables import find_trend

    ordered = sorted(outcomes, key=lambda outcome: str(outcome.job.source))
    for motion, what in (("vertical", "presses"), ("axial", "rotations")):
        changes = []
        for outcome in ordered:
            if outcome.motion != motion or outcome.state == "failed":
                continue
            change = outcome.brightness_change
            if outcome.state == "kept":
                change = (io.open_result(outcome.job.target).fitted.light_change or (None,))[0]
            changes.append(math.nan if change is None else 100 * change)
        trend = find_trend(np.array(changes), "%")
        if trend is not None:
            yield f"{HEALTH[0]} of {what} {trend}"


def _fields(outcome: Outcome) -> dict[str, Any]:
    fields = dataclasses.asdict(outcome)
    job = fields.pop("job")
    return {"source": str(job["source"]), "result": str(job["target"])} | fields


@contextmanager
def _show_batch(total: int, as_json: bool) -> Iterator[_Show]:
    """Show the progress of a batch with a total number of files."""
    if sys.stderr.isatty() and (as_json or sys.stdout.isatty()):
        from rich.console import Console
        from rich.live import Live

        table = _Table(total)
        console = Console(stderr=True)
        with Live(get_renderable=table.render, console=console, transient=True, refresh_per_second=4):
            yield table
    else:
        yield _Show(not as_json)


def _problem(outcome: Outcome) -> str:
    """Return a line that names the file and what is wrong with it."""
    name, message = str(outcome.job.source), " ".join(outcome.message.split())
    message = message.replace("--no-verify", "verify = false in [stack] of --settings")
    message = _OPTIONS.sub(r"\1 in [stack] of --settings", message)
    return printable(message if name in message else f"{name}: {message}")


class _Show:
    """Display of the progress of a batch: a line for each file, if wanted."""

    def __init__(self, enabled: bool) -> None:
        self._wanted = enabled

    def under_way(self, job: Job, frames: int, /) -> None:
        """Receive, from any thread, the number of frames of a job that were read."""

    def ended(self, outcome: Outcome, /) -> None:
        """Receive the outcome of a job, from any thread."""
        if not self._wanted:
            return
        line = f"{outcome.state}: {printable(str(outcome.job.source))}"
        if outcome.state == "failed":
            line = f"failed: {_problem(outcome)}"
        elif outcome.state == "done":
            line += f" in {outcome.seconds:.3g} s, {_speed(outcome)} MB/s: {outcome.message}"
        click.echo(line)


class _Table(_Show):
    """Table of the files in progress and the last that ended, with a progress bar."""

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
        """Draw the current state."""
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
        for outcome in last:
            state = _problem(outcome) if outcome.state == "failed" else outcome.state
            speed = _speed(outcome) if outcome.bytes else ""
            cells = printable(str(outcome.job.source)), outcome.motion, state, f"{outcome.seconds:.2f}", speed
            table.add_row(*map(Text, cells))
        for job, (start, frames) in running:
            state = f"{frames} frames" if frames else "begun"
            table.add_row(Text(printable(str(job.source))), "", state, f"{time.monotonic() - start:.2f}", "")
        return Group(table, self._bar)


def _speed(outcome: Outcome) -> str:
    return f"{outcome.bytes / 1e6 / outcome.seconds:.0f}"
