"""Count what kernels read, write and compute, in Oclgrind: ``gpu_work.py [CALL...] [--freeze]``.

Oclgrind (``apt install oclgrind``) interprets kernels and counts their instructions, here those of all public
calls on small pictures.
The work of a launch is assumed to be linear in its work-items and in the bytes that its caller declares, with
coefficients for each kernel. ``gpu_counts.py`` applies them to pictures of full size. Some ten minutes.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

TABLE = Path(__file__).with_name("gpu-work.json")
SHAPE, PRESS, DIVISOR = (
    (64, 64),
    (24, 24),
    8,
)  # of pictures; kernels of presses take longest
PRESSES = re.compile("find_onset|find_change_point|find_focus")
MARK = "@launch "

# Kernels are counted unoptimised, because Oclgrind does not know all instructions of optimised ones. Private
# memory, conversions between integers and jumps are left out: they are free, or gone after optimisation.
SIMPLE = re.compile(
    r"add|sub|mul|fadd|fsub|fmul|fneg|icmp|fcmp|and|or|xor|lshr|ashr|shl|select|[su]itofp|fpto[su]i"
    r"|call _Z\d+(fma|mad|fmin|fmax|min|max|fabs|abs|floor|round|rint|clamp|convert)\w*\(\)"
)
DIVISION = re.compile(r"[fsu](div|rem)")
FUNCTION = re.compile(r"call _Z\d+(sqrt|rsqrt|cbrt|hypot|exp|log|pow|sin|cos|tan|asin|acos|atan|erf)\w*\(\)")
OPERATIONS = {SIMPLE: 1, DIVISION: 10, FUNCTION: 20}  # of which each instruction counts as so many
COUNTED = re.compile(r"\s+([\d,]+) - (.+?)(?: \(([\d,]+) bytes\))?\s*")


class Work(NamedTuple):
    """What a launch does, or one of its work-items."""

    read: float = 0.0  # bytes of global memory, each as often as it is read
    written: float = 0.0
    operations: float = 0.0


Coefficients = dict[str, tuple[Work, Work]]  # by kernel: of a work-item, and of a declared byte


class Sample(NamedTuple):
    """A launch that was counted."""

    kernel: str
    items: int
    moved: int
    work: Work


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("calls", nargs="*", metavar="CALL", help="a part of a name")
    parser.add_argument("--freeze", action="store_true", help="keep what is found as the table")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    words = parser.parse_args()
    if words.inside:
        run_calls(words.calls)
        return 0
    table = fit(run_in_oclgrind(words.calls))
    text = json.dumps({kernel: [*map(list, pair)] for kernel, pair in sorted(table.items())})
    text = text.replace("]], ", "]],\n")
    print(text)
    if words.freeze:
        TABLE.write_text(text + "\n", encoding="utf-8")
    return 0


def load() -> Coefficients:
    """Return the table that was kept."""
    stored = json.loads(TABLE.read_text(encoding="utf-8"))
    return {kernel: (Work(*item), Work(*byte)) for kernel, (item, byte) in stored.items()}


def work_of(table: Coefficients, kernel: str, items: int, moved: int) -> Work:
    """Return the work of a launch."""
    item, byte = table[kernel]
    return Work(*(items * each + moved * more for each, more in zip(item, byte, strict=True)))


def run_in_oclgrind(calls: Iterable[str]) -> Iterator[Sample]:
    """Run the calls in Oclgrind, in another process; give their launches."""
    from mirrorskin.evaluation.portability.portability import CHECKS, UNOPTIMISED, environment_for

    check = next(check for check in CHECKS if check.name == "Oclgrind: unset")
    if check.find() is None:
        sys.exit(f"gpu_work.py: Oclgrind is not installed: {check.remedy}")
    command = [sys.executable, "-W", "ignore", __file__, "--inside", *calls]
    with tempfile.TemporaryDirectory() as folder:
        environment = environment_for(check, Path(folder)) | UNOPTIMISED
        environment |= {"OCLGRIND_INST_COUNTS": "1", "OCLGRIND_GLOBAL_MEM_SIZE": "500000000"}
        del environment["OCLGRIND_UNINITIALIZED"]
        child = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        lines: list[str] = []
        late = False
        for line in child.stdout:
            if line.startswith(MARK):
                kernel, items, moved = line.removeprefix(MARK).split()
                work, lines = summed(lines), []
                if any(work) and not late:
                    yield Sample(kernel, int(items), int(moved), work)
                late = not any(work)  # counts that come late are of several launches, and left out
            else:
                lines.append(line)
        if child.wait():
            sys.exit(child.returncode)


def run_calls(names: list[str]) -> None:
    """Make the calls on small pictures, and mark where the counts of each launch end."""
    from mirrorskin.evaluation.portability import gpu_calls
    from mirrorskin.kernels.device import Kernel, open_device

    warnings.simplefilter("ignore")
    device = open_device()
    start = Kernel.__call__

    def started(kernel: Kernel, items: int, /, *, moved: int, **arguments: Any) -> None:
        start(kernel, items, moved=moved, **arguments)
        device.finish()
        print(f"{MARK}{kernel.name} {-(-items // kernel.group) * kernel.group} {moved}", flush=True)

    Kernel.__call__ = started  # type: ignore[method-assign]
    presses = gpu_calls.presses(PRESS, device, 64)
    others = gpu_calls.calls(SHAPE, device, divisor=DIVISOR)
    for name, call in chain(presses, (pair for pair in others if not PRESSES.match(pair[0]))):
        if any(part in name for part in names or [""]):
            print(name, file=sys.stderr, flush=True)
            call()


def summed(lines: Iterable[str]) -> Work:
    """Return the work of a launch from Oclgrind's counts of instructions."""
    work = dict.fromkeys(Work._fields, 0.0)
    for match in filter(None, map(COUNTED.fullmatch, lines)):
        name, count, size = match[2], *(int((number or "0").replace(",", "")) for number in match.group(1, 3))
        if name in ("load global", "store global", "load constant"):
            work["written" if "store" in name else "read"] += size
        else:
            work["operations"] += sum(
                cost * count for pattern, cost in OPERATIONS.items() if pattern.fullmatch(name)
            )
    return Work(**work)


def fit(samples: Iterable[Sample]) -> Coefficients:
    """Return the coefficients that agree best with the launches, relatively, and are not negative."""
    from scipy.optimize import nnls

    by_kernel: dict[str, list[Sample]] = defaultdict(list)
    for sample in samples:
        by_kernel[sample.kernel].append(sample)
    table: Coefficients = {}
    for kernel, several in by_kernel.items():
        sizes = np.array([(sample.items, sample.moved) for sample in several], np.float64)
        works = np.array([sample.work for sample in several], np.float64)
        if np.linalg.matrix_rank(sizes / sizes[:, :1], 0.01) < 2:  # one kind of launch: by what is declared
            sizes[:, 0 if sizes[:, 1].any() else 1] = 0
        rows = [nnls(sizes / scale[:, None], each / scale)[0] for each, scale in scaled(works)]
        item, byte = np.array(rows).T
        table[kernel] = Work(*rounded(item)), Work(*rounded(byte))
    return table


def scaled(works: Any) -> Iterator[tuple[Any, Any]]:
    """Give each column, and what its elements are divided by to be compared."""
    return ((column, np.maximum(column, 1.0)) for column in works.T)


def rounded(numbers: Any) -> list[float]:
    """Return numbers with four digits."""
    return [float(f"{number:.4g}") for number in numbers]


if __name__ == "__main__":
    sys.exit(main())
