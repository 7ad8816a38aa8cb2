"""What a benchmark found, as plain data, and that as tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from mirrorskin.bench.environment import describe_environment
from mirrorskin.bench.results import Case, Row
from mirrorskin.kernels.device import Device

Data = Mapping[str, Any]

HEAD = ("work", "ms", "quartiles", "kernels", "copies", "GB/s", "frames/s", "of limit", "kernels")
TARGET_HEAD = ("aim", "bound", "measured", "reached")
LEGEND = (
    "ms: median by the host's clock, from the call to its return; kernels and copies: the device's own "
    "account of that time. of limit: bandwidth as a share of the first row's, by the clock; then the same "
    "of kernels alone. Bytes are those of the frames, each once, of axial rotation those of the maps too, "
    "and of integration those of what is given and of the heights, each once."
)


def as_data(device: Device, cases: Sequence[Case], quick: bool) -> dict[str, Any]:
    """Return everything about a run as what JSON knows; a number that there is not is None."""
    data = {**describe_environment(device), "quick": quick, "cases": [_case(case) for case in cases]}
    return {**data, "device": asdict(device.info)}


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


def as_title(data: Data) -> str:
    """Return device, processor, commit and date in one line."""
    code = data["commit"] or data["versions"].get("mirrorskin")
    return f"{as_machine(data)}; mirrorskin {code}; {data['date']}"


def as_machine(data: Data) -> str:
    """Return device and processor in one line."""
    device = data["device"]
    where = f"{device['platform']}: {device['name']} (driver {device['driver']}), {data['threads']} threads"
    return f"{where}; {data['processor']}"


def as_versions(data: Data) -> str:
    """Return the versions of what a run used, in one line."""
    return ", ".join(f"{name} {version or 'not installed'}" for name, version in data["versions"].items())


def as_markdown(data: Data) -> str:
    """Return a run as a page."""
    parts = [f"# {as_title(data)}", as_versions(data), LEGEND]
    parts += [as_section(case, "##") for case in data["cases"]]
    return "\n\n".join(parts) + "\n"


def as_section(case: Data, level: str) -> str:
    """Return a case with all its tables and notes as a part of a page.

    Parameters
    ----------
    case : mapping
    level : str
        Hashes of its heading.
    """
    parts = [f"{level} {case['name']}: {case['title']}"]
    for head, rows, numbers in ((HEAD, as_rows(case), True), (TARGET_HEAD, as_targets(case), False)):
        parts += [as_table(head, rows, numbers=numbers)] if rows else []
    return "\n\n".join([*parts, *as_notes(case)])


def as_table(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: bool = True) -> str:
    """Return a table of a page.

    Parameters
    ----------
    head : sequence of str
    rows : sequence of sequences of str
        Cells under the head.
    numbers : bool
        Columns after the first are set to the right.
    """
    lines = [head, ["---"] + ["---:" if numbers else "---"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)


def _case(case: Case) -> dict[str, Any]:
    rows = [_row(case, row) for row in case.rows]
    # Numbers of NumPy were compared, and JSON does not know its bool.
    targets = [{**asdict(target), "met": bool(target.met)} for target in case.targets]
    told = {"absent": case.absent, "notes": list(case.notes), "targets": targets}
    return {"name": case.name, "title": case.title, "rows": rows, **told}


def _row(case: Case, row: Row) -> dict[str, Any]:
    return {
        "name": row.name,
        "bytes": row.bytes,
        "frames": row.frames,
        "operations": row.operations,
        **asdict(row.measured),
        "bandwidth": row.bandwidth,
        "share": _number(case.share(row)),
        "kernel_share": _number(case.kernel_share(row)),
    }


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


def as_ms(seconds: float) -> str:
    """Return a time as milliseconds, of three digits or so."""
    milliseconds = 1e3 * seconds
    return f"{milliseconds:.{2 if milliseconds < 10 else 1 if milliseconds < 1000 else 0}f}"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
