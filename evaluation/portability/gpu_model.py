"""How long a GPU takes for a launch and for a call, calibrated with one half of a run on an H100.

``gpu_model.py``: fit the constants again, and print how far predictions are from what was measured.

A launch takes a time to start, the longer of two times, of all bytes that it moves and of all operations, and
the time in which one work-item reads its share of the bytes that the caller declares. A call takes its
launches, its copies, and the processor time of its thread on the host, one after the other. The model has no
caches: it does not see whether neighbours read the same bytes, or bytes that are far apart.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mirrorskin.evaluation.portability.gpu_work import Work

RUN = Path(__file__).with_name("gpu-h100.json")
"""The calls of the run, with the launches of the code that it measured (commit f08ab9b8) and their work."""

MEMORY = 2.79e12  # bytes per second that a kernel copies, measured
STAGING = 17.6e9  # bytes per second from host to host by four threads, measured: the bus takes 53
WAIT = 20.9e-6  # seconds to fetch four bytes, measured
FACTOR = 2.0  # by which a prediction may be wrong

STRIDES = "neighbours read places that are far apart; at 4K caches are too small for them"
HOST = "the other host takes relatively longer than for other calls"
OUTSIDE = {
    "components_sum": "`fuse` has more components, and takes longer for the same bytes",
    "correlation_window": "a short launch starts faster than others",
    "multigrid_advance": STRIDES,
    "multigrid_curve": "only its declared bytes are known: the commit's was not counted",
    "multigrid_direct": STRIDES,
    "multigrid_follow": "as multigrid_curve; its work rises with the square of the nodes",
    "multigrid_tail": "it reads the same bytes again and again, from caches",
    "rectangle_modes": "at 4K; its memory of a work-group leaves room for few groups",
    "pose_equations": "few work-items, each with many operations",
    "estimate_pose, 240 x 320": HOST,
    "find_displacement, 3 frames": HOST,
    "fit_fringes, 16 frames": HOST,
}
"""Kernels and calls whose time is not predicted within ``FACTOR``, and why."""


class Constants(NamedTuple):
    """What was fitted."""

    start: float  # seconds, of a launch
    arithmetic: float  # operations per second, of all work-items
    share: float  # seconds for each byte that is declared for one work-item
    host: float  # processor time of an H100's host, in that of the machine that freezes the table


FITTED = Constants(1.857e-5, 1.729e13, 6.349e-8, 0.2475)


class Launch(NamedTuple):
    """A launch: its work-items, the bytes that its caller declares, and the work of all work-items."""

    items: int
    moved: int
    work: Work

    def seconds(self, constants: Constants = FITTED) -> float:
        """Predict how long it takes."""
        memory = (self.work.read + self.work.written) / MEMORY
        longer = max(memory, self.work.operations / constants.arithmetic)
        return constants.start + longer + constants.share * self.moved / max(self.items, 1)


class Row(NamedTuple):
    """A measured time, ms, and its prediction, which depends on the constants."""

    name: str  # of the kernel or of the call, by which rows are divided into halves
    call: str
    measured: float
    predict: Callable[[Constants], float]

    def factor(self, constants: Constants = FITTED) -> float:
        """Return the predicted time divided by the measured one."""
        return self.predict(constants) / self.measured


def call_ms(
    host_ms: float, launches: Iterable[Launch], copies_ms: float, fetched: int, constants: Constants = FITTED
) -> float:
    """Predict how long a call takes, ms."""
    each = [launch.seconds(constants) for launch in launches]
    device = 1e3 * (sum(each) + WAIT * fetched)
    return constants.host * host_ms + copies_ms + device


def load() -> tuple[list[Row], list[Row]]:
    """Return the run's rows of kernels and of calls."""
    kernels, calls = [], []
    for call in json.loads(RUN.read_text(encoding="utf-8")):
        everything: list[Launch] = []
        where = f"{call['call']}, {call['size']}"
        for name, (measured, launches) in call["kernels"].items():
            mine = [
                Launch(items, moved, Work(*work))
                for count, items, moved, *work in launches
                for _ in range(count)
            ]
            everything += mine
            if measured is not None:
                kernels.append(Row(name, where, measured, _total_of(mine)))
        calls.append(Row(call["call"], where, call["ms"], _time_of(call, everything)))
    return kernels, calls


def _total_of(launches: Sequence[Launch]) -> Callable[[Constants], float]:
    return lambda constants: 1e3 * sum(launch.seconds(constants) for launch in launches)


def _time_of(call: dict[str, Any], launches: Sequence[Launch]) -> Callable[[Constants], float]:
    return lambda constants: call_ms(call["host ms"], launches, call["copies ms"], call["fetched"], constants)


def is_held_out(row: Row, rows: Iterable[Row]) -> bool:
    """Return whether a row tests the constants: every second name in their order does."""
    return sorted({each.name for each in rows}).index(row.name) % 2 == 1


def fit() -> Constants:
    """Fit the constants to the rows that are not held out; those of kernels first."""
    from scipy.optimize import least_squares

    kernels, calls = load()

    def fitted(rows: list[Row], start: Sequence[float], constants: Callable[[Any], Constants]) -> Constants:
        used = [row for row in rows if not is_held_out(row, rows)]

        weights = [sum(other.name == row.name for other in used) ** -0.5 for row in used]

        def misfit(logarithms: Any) -> list[float]:
            trial = constants(np.exp(logarithms))
            return [weight * math.log(row.factor(trial)) for weight, row in zip(weights, used, strict=True)]

        return constants(np.exp(least_squares(misfit, np.log(start), loss="soft_l1").x))

    first = fitted(
        kernels,
        FITTED[:3],
        lambda three: FITTED._replace(**dict(zip(Constants._fields, three.tolist(), strict=False))),
    )
    return fitted(calls, FITTED[3:], lambda one: first._replace(host=float(one[0])))


def page() -> str:
    """Return how far predictions are from what was measured, in Markdown."""
    kernels, calls = load()
    lines = [HEAD, "| kernel | half | rows | predicted / measured | |\n|---|---|---|---|---|\n"]
    for name in sorted({row.name for row in kernels}):
        factors = [row.factor() for row in kernels if row.name == name]
        least, most = f"{min(factors):.2f}", f"{max(factors):.2f}"
        span = least if least == most else f"{least} to {most}"
        half = "tests" if is_held_out(next(row for row in kernels if row.name == name), kernels) else "fits"
        lines.append(f"| {name} | {half} | {len(factors)} | {span} | {remark(name, factors)} |\n")
    lines.append("\n| call | half | measured, ms | predicted, ms | factor | |\n|---|---|---|---|---|---|\n")
    for row in sorted(calls, key=lambda row: row.call):
        half = "tests" if is_held_out(row, calls) else "fits"
        lines.append(
            f"| {row.call} | {half} | {row.measured:.3g} | {row.predict(FITTED):.3g} | {row.factor():.2f}"
            f" | {remark(row.name, [row.factor()])} |\n"
        )
    return "".join(lines)


def remark(name: str, factors: Iterable[float]) -> str:
    """Return why predictions are outside, if one is."""
    if all(is_within(factor) for factor in factors):
        return ""
    return f"outside: {OUTSIDE.get(name, 'not explained')}"


def is_within(factor: float) -> bool:
    """Return whether a prediction is right within ``FACTOR``."""
    return 1 / FACTOR <= factor <= FACTOR


def unexplained(rows: Sequence[Row]) -> Iterator[str]:
    """Give the held-out rows that are outside and not named in ``OUTSIDE``."""
    for row in rows:
        if is_held_out(row, rows) and not is_within(row.factor()) and row.name not in OUTSIDE:
            yield f"{row.name}, {row.call}: {row.factor():.2f}"


HEAD = f"""
## How far predictions are from a run

The constants were fitted to one half of a [run on an H100](../../bench/results/gpu/h100.md). The
other half tests them: every second name of a kernel or call, in their order. The run measured an
older commit, f08ab9b8, whose launches were counted again; its copies were not staged. A prediction
that is wrong by more than a factor of {FACTOR:g} is outside. Calls include all of their kernels and copies.

"""


def main() -> int:
    """Print the constants of a new fit, and the page."""
    print(fit())
    print(page())
    wrong = [line for rows in load() for line in unexplained(rows)]
    print(*wrong, sep="\n", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
