"""The number of processors that this process may use; no other module of mirrorskin is needed for it."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

POCL_THREADS = "POCL_MAX_PTHREAD_COUNT"
"""Environment variable: the number of threads of PoCL, which takes those of the machine otherwise."""

_GROUPS, _LIMITS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def usable_cores() -> int:
    """Return the number of processor cores that this process may use: affinity, and limits of containers."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    return max(1, min([cores, *map(math.ceil, _limits())]))


def _limits() -> Iterator[float]:
    """Yield the limits of the control groups of this process, processors (cgroups(7), CPU controller).

    In a container, the folder of its group may be mounted in place of the root.
    """
    try:
        groups = [line.split(":", 2) for line in _GROUPS.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError):
        return
    for _, controllers, name in (group for group in groups if len(group) == 3):
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = _LIMITS / controllers if controllers else _LIMITS
        parts = [part for part in name.split("/") if part not in ("", "..")]
        for depth in range(len(parts), -1, -1):
            place = root.joinpath(*parts[:depth])
            if controllers:
                quota, period = _word(place / "cpu.cfs_quota_us"), _word(place / "cpu.cfs_period_us")
            else:
                quota, period = _word(place / "cpu.max"), _word(place / "cpu.max", 1)
            if quota.isdecimal() and period.isdecimal() and int(period) > 0:
                yield int(quota) / int(period)


def _word(file: Path, number: int = 0) -> str:
    """Return a word of a file; "" without it."""
    try:
        return [*file.read_text(encoding="utf-8").split(), "", ""][number]
    except (OSError, ValueError):
        return ""
