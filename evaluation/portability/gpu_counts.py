"""Work of each public call on a GPU: launches, waits and copies; ``make gpu-check``.

``gpu_counts.py [--freeze]``: print the table, and keep it. Calls have 1 Mpx unless their name says otherwise,
and are counted when they are made again. The predicted time is the sum of launches, waits, copies and kernels
by a model; a kernel takes as long as all of its bytes, or as what one work-item reads one after another.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mirrorskin.evaluation.portability import gpu_calls
from mirrorskin.evaluation.portability.gpu_check import taken_for_gpu
from mirrorskin.kernels.device import Device, Kernel, open_device

TABLE = Path(__file__).with_name("gpu-counts.json")
FEW = 10_000  # work-items of a launch that leave most of a GPU idle
LAUNCH, WAIT, ACCESS = 5e-6, 15e-6, 0.5e-6  # seconds, the last of an access that others depend on
BUS, MEMORY = 25e9, 2.4e12  # bytes per second: between pinned memory and the device, and on the device
WORD = 4  # bytes that a work-item is given by one access

COUNTS = "launches", "small launches", "waits", "copies up", "MB up", "copies down", "MB down"
ITERATED = re.compile(r"fuse|robustly|cuts|live rotation|Integrator")
MORE = 1.1  # by which factor their counts may rise: processors round differently, which changes cycles
NOT_COUNTED = "staging", "allocation"  # waits that depend on the moment and on the calls before
HEAD = f"""# What each call would have a GPU do

By `make gpu-check`, on a device that is treated as a GPU with memory of its own: what happens when
a call with arrays on the host is made again. A small launch has fewer than {FEW} work-items. The
time is predicted by a model: a launch {1e6 * LAUNCH:g} µs, a wait {1e6 * WAIT:g} µs,
copies {BUS / 1e9:g} GB/s, memory {MEMORY / 1e12:g} TB/s,
and {1e6 * ACCESS:g} µs for each {WORD} bytes that one work-item reads or writes.
Maps stay on the device with frames that are there, except for copies of those that checks look at.

| call | {" | ".join(COUNTS)} | predicted, ms | longest kernels, predicted ms |
|---{"|---" * (len(COUNTS) + 2)}|
"""

Row = dict[str, Any]


def main() -> int:
    """Print the table and what is worse than in the stored one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--freeze", action="store_true", help="keep what is found as the table")
    words = parser.parse_args()
    rows = dict(count_all())
    print(page(rows))
    if words.freeze:
        TABLE.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        TABLE.with_suffix(".md").write_text(page(rows), encoding="utf-8")
    stored = load()
    wrong = [line for name, row in rows.items() for line in complaints(name, row, stored.get(name))]
    print(*wrong, sep="\n", end="\n" * bool(wrong), file=sys.stderr)
    return 1 if wrong else 0


def load() -> dict[str, Row]:
    """Return the table that was kept."""
    stored: dict[str, Row] = json.loads(TABLE.read_text(encoding="utf-8"))
    return stored


def count_all() -> Iterator[tuple[str, Row]]:
    """Count every call, by name."""
    device = open_device()
    taken_for_gpu(device)
    for name, call in gpu_calls.calls(gpu_calls.MEGAPIXEL, device):
        yield name, count(call, device)


def count(call: Callable[[], object], device: Device) -> Row:
    """Count what a call does when it is made the second time."""
    kept = call()
    device.finish()
    device.profile.clear()
    del kept
    with launches() as kernels:
        kept = call()  # noqa: F841, what is given back too early would be used again
    records = device.profile.records()
    waits = [record for record in records if record.kind == "wait" and record.name not in NOT_COUNTED]
    row: Row = {
        "launches": len(kernels),
        "small launches": sum(items < FEW for _, items, _ in kernels),
        "waits": sum(record.runs for record in waits),
    }
    for kind, direction in (("upload", "up"), ("download", "down")):
        row[f"copies {direction}"] = sum(record.runs for record in records if record.kind == kind)
        row[f"MB {direction}"] = round(
            sum(record.bytes for record in records if record.kind == kind) / 1e6, 1
        )
    longest: dict[str, float] = {}
    for kernel, items, moved in kernels:
        longest[kernel] = longest.get(kernel, 0.0) + seconds_of(items, moved)
    counted = LAUNCH * row["launches"] + WAIT * row["waits"]
    copies = 1e6 * (row["MB up"] + row["MB down"]) / BUS
    row["predicted ms"] = round(1e3 * (counted + copies + sum(longest.values())), 2)
    first = sorted(longest, key=lambda kernel: -longest[kernel])[:3]
    row["longest"] = {kernel: float(f"{1e3 * longest[kernel]:.2g}") for kernel in first}
    return row


def seconds_of(items: int, moved: int) -> float:
    """Predict how long a kernel takes, from its work-items and the bytes that it reads and writes."""
    return max(moved / MEMORY, moved / max(items, 1) / WORD * ACCESS)


@contextmanager
def launches() -> Iterator[list[tuple[str, int, int]]]:
    """Collect names, work-items and bytes of the kernels that are started."""
    kernels: list[tuple[str, int, int]] = []
    start = Kernel.__call__

    def started(kernel: Kernel, items: int, /, *, moved: int, **arguments: Any) -> None:
        kernels.append((kernel.name, items, moved))
        start(kernel, items, moved=moved, **arguments)

    Kernel.__call__ = started  # type: ignore[method-assign]
    try:
        yield kernels
    finally:
        Kernel.__call__ = start  # type: ignore[method-assign]


def complaints(name: str, row: Row, stored: Row | None) -> Iterator[str]:
    """Say in a line each what a call does more of than in the table."""
    if stored is None:
        yield f"{name} is not in {TABLE.name}: gpu_counts.py --freeze"
        return
    for key in COUNTS:
        if row[key] > stored[key] * (MORE if ITERATED.search(name) else 1):
            yield f"{name}: {key} {row[key]}, and the table has {stored[key]}"


def page(rows: dict[str, Row]) -> str:
    """Return the table in Markdown."""
    lines = [HEAD]
    for name, row in rows.items():
        counts = " | ".join(f"{row[key]:g}" for key in COUNTS)
        longest = ", ".join(f"{kernel} {ms:g}" for kernel, ms in row["longest"].items())
        lines.append(f"| {name} | {counts} | {row['predicted ms']:.2f} | {longest} |\n")
    return "".join(lines)


if __name__ == "__main__":
    sys.exit(main())
