"""A page of one or several runs: aims, a summary, a roofline, every case."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mirrorskin.bench.report import (
    LEGEND,
    TARGET_HEAD,
    Data,
    as_machine,
    as_section,
    as_table,
    as_targets,
    as_title,
    as_versions,
)
from mirrorskin.bench.roofline import draw_rooflines, roofline_of
from mirrorskin.bench.runs import Run
from mirrorskin.bench.summary import SUMMARY_HEAD, as_starts, as_summary, as_sweep, is_accuracy
from mirrorskin.io import InputError, check_output

PICTURE = Path("images") / "roofline.png"
"""Where the picture lies, seen from the page."""

_ABOUT = (
    "What `mirrorskin bench` measured. `mirrorskin bench report` made this page of the runs below: make it "
    "anew rather than change it."
)
_ABOUT_AIMS = "What was aimed at, and what came of it in these runs."
_ABOUT_ACCURACY = "Answers on this device against truths that are known, each a number and its bound."
_ABOUT_SUMMARY = (
    "Beside each work of ours the quickest of the others that do the same in the same run, and return the "
    "same. of limit: the share of the limit of memory that stands first in its table below."
)
_ABOUT_SIZES = (
    "GB/s of each work in each size of picture and type of frames, with so many frames, or on so many cores, "
    "and the share of the limit of memory that took turns with it, both by the host's clock."
)
_ABOUT_STARTS = "What the steps of a process take, with an empty cache of kernels and with a full one."
_ABOUT_PICTURE = (
    "Each number is a kernel on its largest pictures, its dots are other sizes and types: how many "
    "multiply-adds it does with a byte that must move, and how many in a second, by the device's own "
    "account. The lines are what the same device did in the same runs with nothing else to do: read bytes, "
    "combine them as a triad, and multiply and add numbers that stay in registers. Below a slope memory "
    "binds, below the level line arithmetic does. What is above a slope has its bytes in a cache. The shares "
    "are of the limit of memory that took turns with the kernel, or of arithmetic where that is more. Peers, "
    "and kernels whose operations are not counted, are in the tables alone."
)


@dataclass(slots=True)
class Machine:
    """The cases of all runs of one device.

    Attributes
    ----------
    title : str
        Device and processor.
    cases : dict
        By name; of a case that several runs have, the last one counts.
    """

    title: str
    cases: dict[str, Data] = field(default_factory=dict)


def write_page(runs: Mapping[Path, Run], page: Path) -> None:
    """Write a page of runs, and its picture where they tell what one needs.

    Parameters
    ----------
    runs : mapping
        Runs by their files; of a case that several runs of one machine have, the last one counts.
    page : Path
        The picture goes to `PICTURE` beside it, in a folder that is made.

    Raises
    ------
    InputError
        Page or picture cannot be written, or there is no Matplotlib.
    """
    machines = gather(runs.values())
    rooflines = {one.title: roof for one in machines if (roof := roofline_of(one.cases.values()))}
    if rooflines:
        picture = page.parent / PICTURE
        _make_folder(picture.parent)
        check_output(picture, *runs)
        draw_rooflines(rooflines, picture)
    write_text(page, as_page(runs, machines, pictured=bool(rooflines)))


def gather(runs: Iterable[Run]) -> list[Machine]:
    """Return the cases of some runs by the machine that they ran on."""
    machines: dict[str, Machine] = {}
    for run in runs:
        title = as_machine(run)
        machine = machines.setdefault(title, Machine(title))
        machine.cases.update({case["name"]: case for case in run["cases"]})
    return list(machines.values())


def as_page(runs: Mapping[Path, Run], machines: Sequence[Machine], *, pictured: bool) -> str:
    """Return the page of some runs.

    Parameters
    ----------
    runs : mapping
    machines : sequence of Machine
        Of these runs; see `gather`.
    pictured : bool
        Whether there is a picture.
    """
    parts = ["# Benchmarks", _ABOUT, _runs(runs)]
    parts += _topic("Aims", _ABOUT_AIMS, machines, _aims)
    parts += _topic("Accuracy", _ABOUT_ACCURACY, machines, _accuracy)
    if pictured:
        parts += ["## Roofline", f"![Roofline]({PICTURE.as_posix()})", _ABOUT_PICTURE]
    parts += _topic("Summary", _ABOUT_SUMMARY, machines, _summary)
    parts += _topic("Sizes, types and cores", _ABOUT_SIZES, machines, _sizes)
    parts += _topic("Cold and warm", _ABOUT_STARTS, machines, _starts)
    parts += _topic("All cases", LEGEND, machines, _sections)
    return "\n\n".join(parts) + "\n"


def write_text(path: Path, content: str) -> None:
    """Write a text file, or raise InputError."""
    try:
        path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path} could not be written: {error.strerror}; make room") from error


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder} cannot be made: {error.strerror}; choose another place with -o"
        ) from error


def _runs(runs: Mapping[Path, Run]) -> str:
    quick = {True: " Made with `--quick`: the times mean nothing.", False: ""}
    told = (
        f"- {path.name}: {as_title(run)}. {as_versions(run)}.{quick[run['quick']]}"
        for path, run in runs.items()
    )
    return "\n".join(told)


def _topic(
    title: str, about: str, machines: Sequence[Machine], tell: Callable[[Machine], list[str]]
) -> list[str]:
    """Return a heading and what there is to say of each machine; nothing where there is nothing."""
    told = {machine.title: tell(machine) for machine in machines}
    parts = []
    for name, mine in told.items():
        if mine:
            parts += [*([f"**{name}**"] if len(machines) > 1 else []), *mine]
    return [f"## {title}", about, *parts] if parts else []


def _aims(machine: Machine) -> list[str]:
    cases = [case for case in machine.cases.values() if not is_accuracy(case)]
    cells = [[case["name"], *row] for case in cases for row in as_targets(case)]
    return [as_table(("case", *TARGET_HEAD), cells, numbers=False)] if cells else []


def _accuracy(machine: Machine) -> list[str]:
    """Return how many bounds each case of accuracy keeps, and which it does not."""
    cells = []
    for case in filter(is_accuracy, machine.cases.values()):
        missed = [f"{one['what']}: {one['measured']}" for one in case["targets"] if not one["met"]]
        count = len(case["targets"])
        told = "; ".join(missed) or "none"
        cells.append([case["name"], case["title"], f"{count - len(missed)} of {count}", told])
    head = ("case", "about", "bounds that are kept", "missed")
    return [as_table(head, cells, numbers=False)] if cells else []


def _summary(machine: Machine) -> list[str]:
    cells = [[name, *row] for name, case in machine.cases.items() for row in as_summary(case)]
    return [as_table(("case", *SUMMARY_HEAD), cells)] if cells else []


def _sizes(machine: Machine) -> list[str]:
    """Return a table for each set of sizes and types, with a line for each work."""
    tables: dict[tuple[str, ...], list[list[str]]] = {}
    for case in machine.cases.values():
        labels, rows = as_sweep(case)
        if rows:
            tables.setdefault(labels, []).extend(rows)
    return [as_table(("case", "work", *labels), rows) for labels, rows in tables.items()]


def _starts(machine: Machine) -> list[str]:
    cells = [line for case in machine.cases.values() for line in as_starts(case)]
    return [as_table(("step", "cold, ms", "warm, ms"), cells)] if cells else []


def _sections(machine: Machine) -> list[str]:
    return [as_section(case, "###") for case in machine.cases.values()]
