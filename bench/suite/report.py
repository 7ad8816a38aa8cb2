"""Tables of one run, case by case, and the page of several runs."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mirrorskin.bench.suite import glance
from mirrorskin.cli.commands.bench.records import LIVE_HEAD, Case, Row, Run, as_ms, as_percent
from mirrorskin.cli.commands.bench.timing import FIRST, OURS

HEAD = (
    "work",
    "ms",
    "quartiles",
    "processor",
    "kernels",
    "copies",
    "GB/s",
    "frames/s",
    "of limit",
    "kernels",
)
TARGET_HEAD = ("target", "bound", "measured", "met")

LEGEND = (
    "ms: median by the host's clock, from the call to its return; processor: time of all threads, ms; "
    "kernels and copies: as reported by the device. of limit: bandwidth divided by the bandwidth of the "
    "first row, by the clock; then the same for kernels alone. Bytes of input and output are counted once."
)

_ABOUT = (
    "The measurements of `make bench`. `python bench/run.py report` generates this page from the runs that "
    "are listed at its end, so do not edit it. `mirrorskin bench` measures the core operations on your "
    "device."
)
_COMMANDS = """<!-- not run: it takes hours -->
```sh
pip install '.[bench]'                            # peers: Numba, PyTorch, pyamg, NumPy, SciPy, OpenCV
python bench/run.py run --list                    # the cases
python bench/run.py run 'call-*' -o mine.json     # some of them; all tables are written to mine.md
python bench/run.py compare before.json mine.json # differences larger than the variation between rounds
python bench/run.py report mine.json -o page.md   # a page like this one, and its chart
```"""
_METHOD = (
    "The works of a case run alternately in one process: the engine, the limits of memory (read, copy, "
    "triad) on the same number of bytes, and peers, each as an expert of the library would use it. Before "
    "anything is timed, all must return the same maps. A time is the median of up to 15 rounds by the host's "
    "clock, from the call until the device has finished. A limit is the time of the same device in the same "
    "rounds for reading or copying alone. Compare times of one run; `compare` takes the quartiles into "
    "account when it compares two runs."
)
_GLANCE = (
    "Times in milliseconds, from NumPy arrays to maps unless stated otherwise. The limit is the time to read "
    "the same bytes from memory. Peers return the same maps."
)
_LIVE = (
    "Frames come from memory at a pace, by `mirrorskin bench live`. used, updates: frames, and maps or "
    "results of a tracker, a second. Frames that come too early wait, at most 64 of them (of a press or "
    "turn, 256) and for 0.1 s; the others are lost. "
    "50 %, 95 %, 99 %: latency from when a frame was due to its maps. "
    "processor: ms of all threads a frame, on simulated time; there the result must be that of the same "
    "frames offline."
)
_TARGETS = "Every target of the project, whether it is met or not."
_CALLS = (
    "Times in milliseconds of calls as users make them, from NumPy arrays to maps, and of commands, from "
    "process start to end. limit: reading the same bytes from memory. call: a call after earlier ones. "
    "first call: a call that cannot reuse memory of earlier calls. fastest peer: the fastest library that "
    "returns the same maps."
)
_PEERS = (
    "Each work of the engine next to the fastest peer with the same result. of limit: bandwidth divided by "
    "that of memory; where this is small, arithmetic or the overhead of calls is the limit."
)

Machine = Mapping[str, Case]  # cases by name


def as_rows(case: Case) -> list[list[str]]:
    """Return the table of a case as cells under `HEAD`."""
    return [_cells(case, row) for row in case.rows]


def as_targets(case: Case) -> list[list[str]]:
    """Return the targets of a case as cells under `TARGET_HEAD`."""
    return [
        [target.what, target.bound, target.measured, "yes" if target.met else "no"] for target in case.targets
    ]


def as_notes(case: Case) -> list[str]:
    """Return the lines below the table of a case."""
    firsts = [f"{row.name} {row.first:.2f} s" for row in case.rows if not row.is_limit]
    compiling = sum(row.compile for row in case.rows)
    warm_up = f"first call: {', '.join(firsts)}; {compiling:.2f} s in total for building OpenCL kernels"
    absent = (f"{name}: {why}" for name, why in case.absent.items())
    return [*([warm_up] if firsts else []), *case.notes, *absent]


def as_table(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: bool = True) -> str:
    """Return a table of a page; if ``numbers``, all columns but the first are right-aligned."""
    lines = [head, ["---"] + ["---:" if numbers else "---"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)


def as_markdown(run: Run) -> str:
    """Return the page of one run: all tables and notes, then versions and machine."""
    parts = [f"# Benchmarks, run of {run.date[:10]}", LEGEND]
    for case in run.cases:
        parts.append(f"## {case.name}: {case.title}")
        live = [row.cells for row in case.live]
        tables = (HEAD, as_rows(case), True), (LIVE_HEAD, live, True), (TARGET_HEAD, as_targets(case), False)
        for head, rows, numbers in tables:
            parts += [as_table(head, rows, numbers=numbers)] if rows else []
        parts += as_notes(case)
    versions = ", ".join(f"{name} {version or 'not installed'}" for name, version in run.versions.items())
    return "\n\n".join([*parts, "## Machine", f"{run.title}.", f"{versions}."]) + "\n"


def as_page(runs: Mapping[Path, Run], chart: str) -> str:
    """Return the page of some runs; ``chart`` is the address of its chart, see `as_chart`."""
    machines = _gather(runs.values())
    parts = ["# Benchmarks", _wrap(_ABOUT)]
    if glance.entries(_first(machines)):
        parts.append(f"![Times of mirrorskin, other libraries, and the limit of memory]({chart})")
    for title, about, describe in (
        ("At a glance", _GLANCE, _glance),
        ("Calls", _CALLS, _calls),
        ("Works and peers", _PEERS, _peers),
        ("Live", _LIVE, _live),
        ("Targets", _TARGETS, _targets),
    ):
        parts += _topic(title, about, machines, describe)
    parts += ["## How to measure", _COMMANDS, _wrap(_METHOD), "## Machine and runs", _runs(runs)]
    return "\n\n".join(parts) + "\n"


def as_chart(runs: Mapping[Path, Run]) -> bytes | None:
    """Return the chart of a page, SVG, for the machine of the first run; None if it has no such works."""
    shown = glance.entries(_first(_gather(runs.values())))
    return glance.draw(shown) if shown else None


def _wrap(text: str, start: str = "") -> str:
    """Return a paragraph, or with ``start`` an item of a list, in lines of at most 100 columns."""
    kept = re.sub("`[^`]*`", lambda code: code[0].replace(" ", "\0"), text)
    filled = textwrap.fill(
        kept,
        100,
        initial_indent=start,
        subsequent_indent=" " * len(start),
        break_long_words=False,
        break_on_hyphens=False,
    )
    return filled.replace("\0", " ")


def _first(machines: Mapping[str, Machine]) -> Machine:
    return next(iter(machines.values()), {})


def _gather(runs: Iterable[Run]) -> dict[str, Machine]:
    """Return cases by machine; if several runs of a machine contain a case, the last one is used."""
    machines: dict[str, dict[str, Case]] = {}
    for run in runs:
        machines.setdefault(run.machine, {}).update({case.name: case for case in run.cases})
    return dict(machines)


def _runs(runs: Mapping[Path, Run]) -> str:
    """List the machines, the runs and the versions."""
    lines = []
    for machine in dict.fromkeys(run.machine for run in runs.values()):
        lines.append(_wrap(f"{machine}:", "- "))
        for path, run in runs.items():
            if run.machine == machine:
                quick = "; made with `--quick`: its times are not representative" if run.quick else ""
                code = (run.commit or str(run.versions.get("mirrorskin")))[:12]
                lines.append(f"    - {path.name}: {run.date[:10]}, mirrorskin {code}{quick}")
    versions: dict[str, dict[str, None]] = {}
    for run in runs.values():
        for name, version in run.versions.items():
            versions.setdefault(name, {}).update({version: None} if version else {})
    used = ", ".join(f"{name} {' and '.join(releases)}" for name, releases in versions.items() if releases)
    return "\n".join([*lines, _wrap(f"With {used}.", "- ")])


def _topic(
    title: str, about: str, machines: Mapping[str, Machine], describe: Callable[[Machine], list[str]]
) -> list[str]:
    """Return a heading and the parts of each machine; nothing if all are empty."""
    parts = []
    for name, machine in machines.items():
        if mine := describe(machine):
            parts += [*([_wrap(f"**{name}**")] if len(machines) > 1 else []), *mine]
    return [f"## {title}", _wrap(about), *parts] if parts else []


def _glance(machine: Machine) -> list[str]:
    shown = glance.entries(machine)
    return [as_table(glance.HEAD, [glance.as_cells(entry) for entry in shown])] if shown else []


def _targets(machine: Machine) -> list[str]:
    cells = [[case.name, *row] for case in machine.values() for row in as_targets(case)]
    return [as_table(("case", *TARGET_HEAD), cells, numbers=False)] if cells else []


def _live(machine: Machine) -> list[str]:
    cells = [row.cells for case in machine.values() for row in case.live]
    return [as_table(LIVE_HEAD, cells)] if cells else []


def _calls(machine: Machine) -> list[str]:
    """Return whole calls with limit, kernels and fastest peer, and commands with their kernels."""
    cells = []
    for case in machine.values():
        works = {row.name: row for row in case.rows if not row.is_limit}
        limit = next((as_ms(row.wall.median) for row in case.rows if row.is_limit), "")
        whole = FIRST in works
        ours = [works[OURS]] if whole else works.values() if case.name.startswith("call-") else []
        for row in ours:
            rival = _fastest(row, works.values()) if whole else None
            cells.append(
                [
                    case.title if whole else f"{case.title}: {row.name}",
                    limit,
                    as_ms(row.kernel) if "kernel" in row.device else "",
                    as_ms(row.wall.median),
                    as_ms(works[FIRST].wall.median) if whole else "",
                    f"{_who(rival)} {as_ms(rival.wall.median)}" if rival else "",
                ]
            )
    head = ("call", "limit, ms", "kernels", "call", "first call", "fastest peer")
    return [as_table(head, cells)] if cells else []


def _peers(machine: Machine) -> list[str]:
    """Return each work of the engine that has a peer or a target, with the fastest peer."""
    cells = []
    for case in machine.values():
        if case.name.startswith("call-"):
            continue
        works = [row for row in case.rows if not row.is_limit]
        rivals = {row.name: _fastest(row, works) for row in works if _is_ours(row)}
        compared = {target.what for target in case.targets} | {name for name in rivals if rivals[name]}
        alone = not any(rivals.values())
        cells += [
            [case.name, *_pair(case, row, rivals[row.name])]
            for row in works
            if _is_ours(row) and (alone or row.name in compared)
        ]
    head = ("case", "work", "ms", "GB/s", "of limit", "fastest peer", "ms", "times as fast")
    about = [_wrap(f"{name}: {machine[name].title}", "- ") for name in dict.fromkeys(row[0] for row in cells)]
    return [as_table(head, cells), "\n".join(about)] if cells else []


def _is_ours(row: Row) -> bool:
    """Return whether a row is a work of the engine: by its name, or because it used the device."""
    return OURS in row.name or "kernel" in row.device


def _fastest(row: Row, works: Iterable[Row]) -> Row | None:
    """Return the fastest peer with the same result: the names are equal after the comma."""
    same = [work for work in works if not _is_ours(work) and _part(work) == _part(row)]
    return min(same, key=lambda work: work.wall.median, default=None)


def _pair(case: Case, row: Row, rival: Row | None) -> list[str]:
    mine = row.wall.median
    cells = [
        row.name,
        as_ms(mine),
        f"{row.bandwidth / 1e9:.2f}" if row.bytes else "",
        as_percent(case.share(row)) if row.bytes else "",
    ]
    if rival is None:
        return [*cells, "", "", ""]
    return [*cells, _who(rival), as_ms(rival.wall.median), f"{rival.wall.median / mine:.1f}"]


def _who(row: Row) -> str:
    return row.name.partition(", ")[0]


def _part(row: Row) -> str:
    return row.name.partition(", ")[2]


def _cells(case: Case, row: Row) -> list[str]:
    wall, copies = (
        row.wall,
        [row.device[kind].median for kind in ("upload", "download") if kind in row.device],
    )
    shares = (case.share(row), case.kernel_share(row)) if row.bytes else (np.nan, np.nan)
    return [
        row.name,
        as_ms(wall.median),
        f"{as_ms(wall.lower)}-{as_ms(wall.upper)}",
        as_ms(row.processor) if row.processor else "",
        as_ms(row.kernel) if "kernel" in row.device else "",
        as_ms(sum(copies)) if copies else "",
        f"{row.bandwidth / 1e9:.2f}" if row.bytes else "",
        f"{row.frames / wall.median:.0f}" if row.frames else "",
        *map(as_percent, shares),
    ]
