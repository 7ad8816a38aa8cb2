"""Work of each public call on a GPU: launches, waits, copies and bytes that kernels move; ``make gpu-check``.

``gpu_counts.py [--freeze]``: print the table, and keep it. Calls have 1 Mpx unless their name says otherwise,
and are counted when they are made again. ``gpu_work.py`` counts the work of kernels, from which
``gpu_model.py`` predicts times.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from mirrorskin.evaluation.portability import gpu_calls, gpu_model, gpu_work
from mirrorskin.evaluation.portability.gpu_check import taken_for_gpu
from mirrorskin.kernels import transfer
from mirrorskin.kernels.array import Operand
from mirrorskin.kernels.device import Device, Kernel, open_device

TABLE = Path(__file__).with_name("gpu-counts.json")
FEW = 10_000  # work-items of a launch that leave most of a GPU idle
ROUNDS = 3  # of a call whose processor time is measured

COUNTS = "launches", "small launches", "waits", "copies up", "MB up", "copies down", "MB down", "MB moved"
ITERATED = re.compile(r"fuse|robustly|cuts|live rotation|Integrator")
STREAMED = re.compile(
    r"(find_onset|find_focus|correlate|estimate_normals|photometric_stereo), \d+ frames$|integrate$"
)  # calls that need to move no more than they copy
MORE = 1.1  # by which factor their counts may rise: processors round differently, which changes cycles
NOT_COUNTED = "staging", "allocation"  # waits that depend on the moment and on the calls before
CONSTANTS = gpu_model.FITTED
HEAD = f"""# What each call would have a GPU do

By `make gpu-check`, on a device that is treated as a GPU with memory of its own: what happens when
a call with arrays on the host is made again. A small launch has fewer than {FEW} work-items.
Kernels move the bytes that they read and write, but at most once all bytes of their arrays in each
direction. That is an upper bound: which arrays are only written is not known. Useful bytes are
those that are copied: frames up once, maps down once. The aim is to move at most 1.3 times as many.
Maps stay on the device with frames that are there, except for copies of those that checks look at.

Times are predicted for an H100. A launch takes {1e6 * CONSTANTS.start:.1f} µs; the longer of its bytes at
{gpu_model.MEMORY / 1e12:g} TB/s and its operations at {CONSTANTS.arithmetic / 1e12:.1f} T/s; and
{1e9 * CONSTANTS.share:.0f} ns for each byte that its caller declares for one work-item.
Copies take {gpu_model.STAGING / 1e9:g} GB/s, the rate at which the host fills pinned memory, and
{1e6 * gpu_model.WAIT:.1f} µs for each fetch. The host takes
{CONSTANTS.host:.2f} times the processor time of its thread on the machine that made the table.

| call | {" | ".join(COUNTS)} | moved / useful | host, ms | copies, ms | kernels, ms | all, ms | longest, ms |
|---{"|---" * (len(COUNTS) + 6)}|
"""

Row = dict[str, Any]


def main() -> int:
    """Print the table and what is worse than in the stored one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--freeze", action="store_true", help="keep what is found as the table")
    words = parser.parse_args()
    rows = dict(count_all(ROUNDS))
    print(page(rows))
    if words.freeze:
        TABLE.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        TABLE.with_suffix(".md").write_text(page(rows), encoding="utf-8")
    stored = load()
    wrong = [line for name, row in rows.items() for line in complaints(name, row, stored.get(name))]
    uncounted = sorted({kernel for row in rows.values() for kernel in row.get("uncounted", ())})
    notes = [
        f"{kernel}: its work is not in {gpu_work.TABLE.name}: gpu_work.py --freeze" for kernel in uncounted
    ]
    print(*notes, *wrong, sep="\n", end="\n" * bool(notes or wrong), file=sys.stderr)
    return 1 if wrong else 0


def load() -> dict[str, Row]:
    """Return the table that was kept."""
    stored: dict[str, Row] = json.loads(TABLE.read_text(encoding="utf-8"))
    return stored


def count_all(rounds: int = 0) -> Iterator[tuple[str, Row]]:
    """Count every call, by name, and measure the host's processor time in so many rounds."""
    device = open_device()
    taken_for_gpu(device)
    for name, call in gpu_calls.calls(gpu_calls.MEGAPIXEL, device):
        row = count(call, device)
        if STREAMED.match(name):
            row["moved / useful"] = round(row["MB moved"] / (row["MB up"] + row["MB down"]), 2)
        if rounds:
            predict(row, min(host_seconds(call) for _ in range(rounds)))
        yield name, row


def count(call: Callable[[], object], device: Device) -> Row:
    """Count what a call does when it is made the second time, and predict how long its kernels take."""
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
        "small launches": sum(launched.items < FEW for launched in kernels),
        "waits": sum(record.runs for record in waits),
    }
    for kind, direction in (("upload", "up"), ("download", "down")):
        row[f"copies {direction}"] = sum(record.runs for record in records if record.kind == kind)
        row[f"MB {direction}"] = round(
            sum(record.bytes for record in records if record.kind == kind) / 1e6, 1
        )
    table, longest = gpu_work.load(), dict[str, float]()
    moved = 0.0
    for launched in kernels:
        launch = launched.counted(table)
        moved += launch.work.read + launch.work.written
        longest[launched.kernel] = longest.get(launched.kernel, 0.0) + 1e3 * launch.seconds()
    if uncounted := sorted({launched.kernel for launched in kernels} - table.keys()):
        row["uncounted"] = uncounted
    row["MB moved"] = round(moved / 1e6, 1)
    row["kernels ms"] = float(f"{sum(longest.values()):.3g}")
    first = sorted(longest, key=lambda kernel: -longest[kernel])[:3]
    row["longest"] = {kernel: float(f"{longest[kernel]:.2g}") for kernel in first}
    return row


def predict(row: Row, host: float) -> None:
    """Add the predicted time of a call, of which the host takes so many seconds on this machine."""
    copies = 1e9 * (row["MB up"] + row["MB down"]) / gpu_model.STAGING
    row["host ms"] = float(f"{1e3 * CONSTANTS.host * host:.3g}")
    row["copies ms"] = float(f"{copies + 1e3 * gpu_model.WAIT * row['copies down']:.3g}")
    row["predicted ms"] = float(f"{row['host ms'] + row['copies ms'] + row['kernels ms']:.3g}")


def host_seconds(call: Callable[[], object]) -> float:
    """Return the processor time of this thread in a call, except for copies between host and device."""
    copied, copy = [0.0], transfer._copy

    def measured(copies: Any) -> None:
        start = time.thread_time()
        copy(copies)
        copied[0] += time.thread_time() - start

    transfer._copy = measured
    try:
        start = time.thread_time()
        kept = call()  # noqa: F841, freeing it is not part of the call
        return time.thread_time() - start - copied[0]
    finally:
        transfer._copy = copy


class Launched(NamedTuple):
    """A launch: its work-items and those of a group, the bytes that its caller declares, and its arrays'."""

    kernel: str
    items: int
    group: int
    moved: int
    arrays: int

    def counted(self, table: gpu_work.Coefficients) -> gpu_model.Launch:
        """Return its work: each byte of its arrays is read from memory once, and written once."""
        items = -(-self.items // self.group) * self.group
        if self.kernel not in table:
            return gpu_model.Launch(items, self.moved, gpu_work.Work(read=self.moved))
        work = gpu_work.work_of(table, self.kernel, items, self.moved)
        once = {"read": min(work.read, self.arrays), "written": min(work.written, self.arrays)}
        return gpu_model.Launch(items, self.moved, work._replace(**once))


@contextmanager
def launches() -> Iterator[list[Launched]]:
    """Collect the kernels that are started."""
    kernels: list[Launched] = []
    start = Kernel.__call__

    def started(kernel: Kernel, items: int, /, *, moved: int, **arguments: Any) -> None:
        arrays = {id(array): array.nbytes for array in arguments.values() if isinstance(array, Operand)}
        kernels.append(Launched(kernel.name, items, kernel.group, moved, sum(arrays.values())))
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
        times = " | ".join(f"{row[key]:g}" for key in ("host ms", "copies ms", "kernels ms", "predicted ms"))
        longest = ", ".join(f"{kernel} {ms:g}" for kernel, ms in row["longest"].items())
        lines.append(f"| {name} | {counts} | {row.get('moved / useful', '')} | {times} | {longest} |\n")
    return "".join(lines) + gpu_model.page()


if __name__ == "__main__":
    sys.exit(main())
