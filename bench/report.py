"""A run as tables: of each case, and on a page of one or several runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from mirrorskin.bench.harness import FIRST, OURS
from mirrorskin.bench.run import Data, Run
from mirrorskin.io import InputError, check_output
from mirrorskin.io.atomic import write_new

HEAD = ("work", "ms", "quartiles", "kernels", "copies", "GB/s", "frames/s", "of limit", "kernels")
TARGET_HEAD = ("aim", "bound", "measured", "reached")
PICTURE = Path("images") / "roofline.png"
"""Where the page's picture lies, seen from the page."""

LEGEND = (
    "ms: median by the host's clock, from the call to its return; kernels and copies: the device's own "
    "account of that time. of limit: bandwidth as a share of the first row's, by the clock; then the same "
    "of kernels alone. Bytes are those of what goes in and of what comes out, each once."
)

_ABOUT = (
    "What `mirrorskin bench` measured. `mirrorskin bench report` made this page of the runs named at its "
    "end: make it anew rather than change it."
)
_COMMANDS = """```sh
pip install '.[bench]'                            # peers: Numba, PyTorch, pyamg, besides NumPy, SciPy, OpenCV
mirrorskin bench --list                           # the cases
mirrorskin bench --case 'call-*' -o mine.json     # some of them; the tables of all works go to mine.md
mirrorskin bench compare before.json mine.json    # what is quicker or slower by more than its turns vary
mirrorskin bench report mine.json -o page.md      # a page like this one
```"""
_METHOD = (
    "The works of a case take turns in one process: the engine, the limits of memory (read, copy, triad) "
    "on as many bytes, and peers, each as one who knows the library well would use it. All must return "
    "the same maps before anything is timed. A time is the median of up to 15 rounds by the host's clock, "
    "from the call until the device is done. A limit is what the same device did in the same rounds with "
    "nothing else to do. Compare within a run rather than between runs, or let `bench compare` judge by "
    "the quartiles."
)
_AIMS = "What was aimed at, and what came of it."
_CALLS = (
    "Calls as users make them, NumPy arrays in and maps out, and commands from process start to end, in "
    "milliseconds: what memory needs to read as many bytes, the kernels, a call after others, one with no "
    "memory kept from calls before it, and the quickest peer that returns the same maps."
)
_BESIDE = (
    "Each work of ours beside the quickest of the peers that do the same. of limit: bandwidth as a share "
    "of the limit of memory; what is far below is bound by arithmetic or by calls."
)
_SIZES = (
    "GB/s by the host's clock, and the share of the limit of memory that took turns with it: by size of "
    "picture and type of frames, or number of frames."
)
_ROOF = (
    "Each number is a kernel on its largest pictures, its dots are other sizes and types: how many "
    "multiply-adds it does with a byte that must move, and how many in a second, by the device's own "
    "account. Below a slope memory binds, below the level line arithmetic does; what is above a slope has "
    "its bytes in a cache."
)
_ACCURACY = "Answers on this device against truths that are known, each a number and its bound."


Machine = Mapping[str, Data]  # cases by name


def as_rows(case: Data) -> list[list[str]]:
    """Return the table of a case, as cells under `HEAD`."""
    return [_cells(row) for row in case["rows"]]


def as_targets(case: Data) -> list[list[str]]:
    """Return what a case aims at, as cells under `TARGET_HEAD`."""
    return [
        [target["what"], target["bound"], target["measured"], "yes" if target["met"] else "no"]
        for target in case["targets"]
    ]


def as_notes(case: Data) -> list[str]:
    """Return what there is to say below the table of a case."""
    firsts = [f"{row['name']} {row['first']:.2f} s" for row in case["rows"] if not is_limit(row)]
    compiling = sum(row["compile"] for row in case["rows"])
    warm_up = f"first call: {', '.join(firsts)}; {compiling:.2f} s in all went into building OpenCL kernels"
    absent = (f"{name}: {why}" for name, why in case["absent"].items())
    return [*([warm_up] if firsts else []), *case["notes"], *absent]


def is_limit(row: Data) -> bool:
    """Return whether a row is what a machine can do, and not what we or others do with it."""
    return "limit" in row["name"]


def as_title(run: Data) -> str:
    """Return device, processor, commit and date in one line."""
    code = run["commit"] or run["versions"].get("mirrorskin")
    return f"{as_machine(run)}; mirrorskin {code}; {run['date']}"


def as_machine(run: Data) -> str:
    """Return device and processor in one line."""
    device = run["device"]
    where = f"{device['platform']}: {device['name']} (driver {device['driver']}), {run['threads']} threads"
    return f"{where}; {run['processor']}"


def as_versions(run: Data) -> str:
    """Return the versions of what a run used, in one line."""
    return ", ".join(f"{name} {version or 'not installed'}" for name, version in run["versions"].items())


def as_ms(seconds: float) -> str:
    """Return a time as milliseconds, of three digits or so."""
    milliseconds = 1e3 * seconds
    return f"{milliseconds:.{2 if milliseconds < 10 else 1 if milliseconds < 1000 else 0}f}"


def as_table(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: bool = True) -> str:
    """Return a table of a page; columns of numbers, those after the first, are set to the right."""
    lines = [head, ["---"] + ["---:" if numbers else "---"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)


def as_markdown(run: Data) -> str:
    """Return a run with all its tables and notes as a page, and at its end what it was made with."""
    parts = [f"# Benchmarks, run of {run['date'][:10]}", LEGEND]
    for case in run["cases"]:
        parts.append(f"## {case['name']}: {case['title']}")
        for head, rows, numbers in ((HEAD, as_rows(case), True), (TARGET_HEAD, as_targets(case), False)):
            parts += [as_table(head, rows, numbers=numbers)] if rows else []
        parts += as_notes(case)
    parts += ["## Machine", f"{as_title(run)}.", f"{as_versions(run)}."]
    return "\n\n".join(parts) + "\n"


def write_page(runs: Mapping[Path, Run], page: Path) -> None:
    """Write a page of runs by their files, and to `PICTURE` beside it its picture, if there is one.

    Raises
    ------
    InputError
        Page or picture cannot be written, or there is no Matplotlib.
    """
    from mirrorskin.bench.roofline import draw_rooflines, roofline_of

    machines = gather(runs.values()).items()
    rooflines = {title: roof for title, cases in machines if (roof := roofline_of(cases.values()))}
    if rooflines:
        picture = page.parent / PICTURE
        try:
            picture.parent.mkdir(exist_ok=True)
        except OSError as error:
            where = "choose another place with -o"
            raise InputError(f"{picture.parent} cannot be made: {error.strerror}; {where}") from error
        check_output(picture, *runs)
        draw_rooflines(rooflines, picture)
    write_new(page, [as_page(runs, pictured=bool(rooflines)).encode()])


def gather(runs: Iterable[Run]) -> dict[str, Machine]:
    """Return cases by machine; of a case that several runs of one machine have, the last one counts."""
    machines: dict[str, dict[str, Data]] = {}
    for run in runs:
        machines.setdefault(as_machine(run), {}).update({case["name"]: case for case in run["cases"]})
    return dict(machines)


def as_page(runs: Mapping[Path, Run], *, pictured: bool) -> str:
    """Return the page of some runs; `pictured` says whether there is a picture."""
    machines = gather(runs.values())
    parts = ["# Benchmarks", _ABOUT, "## How to measure", _COMMANDS, _METHOD]
    for title, about, describe in (
        ("Aims", _AIMS, _aims),
        ("Calls", _CALLS, _calls),
        ("Kernels and paths beside peers", _BESIDE, _beside_peers),
        ("Sizes and types", _SIZES, _sizes),
    ):
        parts += _topic(title, about, machines, describe)
    if pictured:
        parts += ["## Roofline", f"![Roofline]({PICTURE.as_posix()})", _ROOF]
    parts += _topic("Accuracy", _ACCURACY, machines, _accuracy)
    parts += ["## Machine and runs", _runs(runs)]
    return "\n\n".join(parts) + "\n"


def _runs(runs: Mapping[Path, Run]) -> str:
    """List the machines, and what each run was made with."""
    lines = []
    for machine in dict.fromkeys(as_machine(run) for run in runs.values()):
        lines.append(f"- {machine}:")
        for path, run in runs.items():
            if as_machine(run) == machine:
                quick = "; made with `--quick`: the times mean nothing" if run["quick"] else ""
                code = (run["commit"] or str(run["versions"].get("mirrorskin")))[:12]
                lines.append(f"    - {path.name}: {run['date'][:10]}, mirrorskin {code}{quick}")
    versions: dict[str, list[str]] = {}
    for run in runs.values():
        for name, version in run["versions"].items():
            known = versions.setdefault(name, [])
            known += [version] if version and version not in known else []
    used = ", ".join(f"{name} {' and '.join(known)}" for name, known in versions.items() if known)
    return "\n".join([*lines, f"- With {used}."])


def _topic(
    title: str, about: str, machines: Mapping[str, Machine], describe: Callable[[Machine], list[str]]
) -> list[str]:
    """Return a heading and what there is to say of each machine; nothing where there is nothing."""
    parts = []
    for name, machine in machines.items():
        if mine := describe(machine):
            parts += [*([f"**{name}**"] if len(machines) > 1 else []), *mine]
    return [f"## {title}", about, *parts] if parts else []


def _aims(machine: Machine) -> list[str]:
    cases = [case for case in machine.values() if not _is(case, "accuracy-")]
    cells = [[case["name"], *row] for case in cases for row in as_targets(case)]
    return [as_table(("case", *TARGET_HEAD), cells, numbers=False)] if cells else []


def _calls(machine: Machine) -> list[str]:
    """Return whole calls with limit, kernels and quickest peer, and commands with their kernels."""
    cells = []
    for case in machine.values():
        works = [row for row in case["rows"] if not is_limit(row)]
        limit = next((as_ms(row["wall"]["median"]) for row in case["rows"] if is_limit(row)), "")
        by_name = {row["name"]: row for row in works}
        ours = [by_name[OURS]] if FIRST in by_name else works if _is(case, "call-") else []
        for row in ours:
            kernel = row["device"].get("kernel")
            first = by_name.get(FIRST) if row["name"] == OURS else None
            rival = _quickest(row, [other for other in works if not is_ours(other)]) if first else None
            cells.append(
                [
                    case["title"] if first else f"{case['title']}: {row['name']}",
                    limit,
                    "" if kernel is None else as_ms(kernel["median"]),
                    as_ms(row["wall"]["median"]),
                    as_ms(first["wall"]["median"]) if first else "",
                    f"{_head(rival)} {as_ms(rival['wall']['median'])}" if rival else "",
                ]
            )
    head = ("call", "limit, ms", "kernels", "call", "first call", "quickest peer")
    return [as_table(head, cells)] if cells else []


def _beside_peers(machine: Machine) -> list[str]:
    """Return each work of ours that a peer does too, or that an aim is about, beside the quickest peer."""
    cells = []
    for case in machine.values():
        if _is(case, "sweep-", "scaling-", "accuracy-", "call-"):
            continue
        works = [row for row in case["rows"] if not is_limit(row)]
        ours, others = ([row for row in works if is_ours(row) is kind] for kind in (True, False))
        rivals = {row["name"]: _quickest(row, others) for row in ours}
        wanted = {target["what"] for target in case["targets"]} | {name for name in rivals if rivals[name]}
        alone = not any(rivals.values())
        cells += [
            [case["name"], *_beside(row, rivals[row["name"]])]
            for row in ours
            if alone or row["name"] in wanted
        ]
    head = ("case", "work", "ms", "GB/s", "of limit", "quickest peer", "ms", "times as fast")
    titles = {name: case["title"] for name, case in machine.items()}
    about = [f"- {name}: {titles[name]}" for name in dict.fromkeys(row[0] for row in cells)]
    return [as_table(head, cells), "\n".join(about)] if cells else []


def is_ours(row: Data) -> bool:
    """Return whether a row is the engine's: by its name, or because it used the device."""
    return OURS in row["name"] or "kernel" in row["device"]


def _is(case: Data, *starts: str) -> bool:
    return str(case["name"]).startswith(starts)


def _quickest(row: Data, others: Sequence[Data]) -> Data | None:
    """Return the quickest of the others that do the same: what stands behind the comma of their names."""
    same = [other for other in others if _part(other) == _part(row)]
    return min(same, key=lambda other: float(other["wall"]["median"]), default=None)


def _beside(row: Data, rival: Data | None) -> list[str]:
    mine, counted = row["wall"]["median"], bool(row["bytes"])
    share = row["share"] if counted else None
    cells = [
        row["name"],
        as_ms(mine),
        f"{row['bandwidth'] / 1e9:.2f}" if counted else "",
        "" if share is None else f"{100 * share:.0f} %",
    ]
    if rival is None:
        return [*cells, "", "", ""]
    theirs = rival["wall"]["median"]
    return [*cells, _head(rival), as_ms(theirs), f"{theirs / mine:.1f}"]


def _sizes(machine: Machine) -> list[str]:
    """Return a table for each set of sizes and types, with a line for each work of ours."""
    tables: dict[tuple[str, ...], list[list[str]]] = {}
    for case in machine.values():
        labels, rows = as_sweep(case)
        if rows:
            tables.setdefault(labels, []).extend(rows)
    return [as_table(("case", "work", *labels), rows) for labels, rows in tables.items()]


def as_sweep(case: Data) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return what a sweep goes through, sizes or types, and its works: names, and cells under those.

    Both are empty where a case is no sweep.
    """
    rows = [
        row for row in case["rows"] if _is(case, "sweep-", "scaling-") and not is_limit(row) and row["bytes"]
    ]
    labels = tuple(dict.fromkeys(_part(row) for row in rows))
    lines: dict[str, dict[str, str]] = {}
    for row in rows:
        share = "" if row["share"] is None else f" ({100 * row['share']:.0f} %)"
        rate = row["bandwidth"] / 1e9
        lines.setdefault(_head(row), {})[_part(row)] = f"{rate:.{1 if rate >= 1 else 2}f}{share}"
    cells = ([name, *(found.get(label, "") for label in labels)] for name, found in lines.items())
    return labels, [[case["name"], *line] for line in cells]


def _accuracy(machine: Machine) -> list[str]:
    """Return how many bounds each case of accuracy keeps, and which it does not."""
    cells = []
    for case in machine.values():
        if _is(case, "accuracy-"):
            missed = [f"{one['what']}: {one['measured']}" for one in case["targets"] if not one["met"]]
            kept = f"{len(case['targets']) - len(missed)} of {len(case['targets'])}"
            cells.append([case["name"], case["title"], kept, "; ".join(missed) or "none"])
    head = ("case", "about", "bounds that are kept", "missed")
    return [as_table(head, cells, numbers=False)] if cells else []


def _head(row: Data) -> str:
    return str(row["name"]).partition(", ")[0]


def _part(row: Data) -> str:
    return str(row["name"]).partition(", ")[2]


def _cells(row: Data) -> list[str]:
    device = {kind: timing["median"] for kind, timing in row["device"].items()}
    copies = [device[kind] for kind in ("upload", "download") if kind in device]
    wall = row["wall"]
    shares = (row[kind] if row["bytes"] else None for kind in ("share", "kernel_share"))
    return [
        row["name"],
        as_ms(wall["median"]),
        f"{as_ms(wall['lower'])}-{as_ms(wall['upper'])}",
        as_ms(device["kernel"]) if "kernel" in device else "",
        as_ms(sum(copies)) if copies else "",
        f"{row['bandwidth'] / 1e9:.2f}" if row["bytes"] else "",
        f"{row['frames'] / wall['median']:.0f}" if row["frames"] else "",
        *("" if share is None else f"{100 * share:.0f} %" for share in shares),
    ]
