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


def as_notes(case: Data) -> list[str]:
    """Return what there is to say below the table of a case."""
    firsts = [f"{row['name']} {row['first']:.2f} s" for row in case["rows"] if "limit" not in row["name"]]
    compiling = sum(row["compile"] for row in case["rows"])
    notes = [f"first call: {', '.join(firsts)}; {compiling:.2f} s in all went into building OpenCL kernels"]
    return [*notes, *case["notes"], *(f"{name}: {why}" for name, why in case["absent"].items())]


def as_title(data: Data) -> str:
    """Return device, processor, commit and date in one line."""
    device = data["device"]
    where = f"{device['platform']}: {device['name']} (driver {device['driver']}), {data['threads']} threads"
    code = data["commit"] or data["versions"]["mirrorskin"]
    return f"{where}; {data['processor']}; mirrorskin {code}; {data['date']}"


def as_markdown(data: Data) -> str:
    """Return a run as a page."""
    versions = ", ".join(f"{name} {version or 'not installed'}" for name, version in data["versions"].items())
    parts = [f"# {as_title(data)}", versions, LEGEND]
    for case in data["cases"]:
        lines = [HEAD, ["---"] + ["---:"] * (len(HEAD) - 1), *as_rows(case)]
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
        parts += [f"## {case['name']}: {case['title']}", table, *as_notes(case)]
    return "\n\n".join(parts) + "\n"


def _case(case: Case) -> dict[str, Any]:
    rows = [_row(case, row) for row in case.rows]
    told = {"absent": case.absent, "notes": list(case.notes)}
    return {"name": case.name, "title": case.title, "rows": rows, **told}


def _row(case: Case, row: Row) -> dict[str, Any]:
    return {
        "name": row.name,
        "bytes": row.bytes,
        "frames": row.frames,
        "operations": row.operations,
        **asdict(row.measured),
        "bandwidth": row.bandwidth,
        "share": case.share(row),
        "kernel_share": _number(case.kernel_share(row)),
    }


def _cells(row: Data) -> list[str]:
    device = {kind: timing["median"] for kind, timing in row["device"].items()}
    copies = [device[kind] for kind in ("upload", "download") if kind in device]
    wall = row["wall"]
    return [
        row["name"],
        _ms(wall["median"]),
        f"{_ms(wall['lower'])}-{_ms(wall['upper'])}",
        _ms(device["kernel"]) if "kernel" in device else "",
        _ms(sum(copies)) if copies else "",
        f"{row['bandwidth'] / 1e9:.2f}" if row["bytes"] else "",
        f"{row['frames'] / wall['median']:.0f}" if row["frames"] else "",
        f"{100 * row['share']:.0f} %" if row["bytes"] else "",
        f"{100 * row['kernel_share']:.0f} %" if row["bytes"] and row["kernel_share"] is not None else "",
    ]


def _ms(seconds: float) -> str:
    milliseconds = 1e3 * seconds
    return f"{milliseconds:.{2 if milliseconds < 10 else 1 if milliseconds < 1000 else 0}f}"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
