"""The number of processors that this process may use; no other module of mirrorskin is needed for it."""

from __future__ import annotations

import functools
import math
import os
import sys
from pathlib import Path

POCL_THREADS = "POCL_MAX_PTHREAD_COUNT"
"""Environment variable: the number of threads of PoCL, which takes those of the machine otherwise."""

_GROUPS, _LIMITS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def usable_cores() -> int:
    """Return the number of processor cores that this process may use: affinity, and limits of containers."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    return min(cores, _limit())


@functools.cache
def _limit() -> int:
    """Return the least limit of the control groups of this process (cgroups(7), CPU controller).

    In a container, the folder of its group may be mounted in place of the root.
    """
    least = float(sys.maxsize)
    lines = _words(_GROUPS)
    for _, controllers, name in (line.split(":", 2) for line in lines if line.count(":") > 1):
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = _LIMITS / controllers if controllers else _LIMITS
        parts = [part for part in name.split("/") if part not in ("", "..")]
        for depth in range(len(parts), -1, -1):
            place = root.joinpath(*parts[:depth])
            files = ("cpu.cfs_quota_us", "cpu.cfs_period_us") if controllers else ("cpu.max",)
            quota, period = (*(word for file in files for word in _words(place / file)), "", "")[:2]
            if quota.isdecimal() and period.isdecimal() and int(period) > 0:
                least = min(least, int(quota) / int(period))
    return max(1, math.ceil(least))


def _words(file: Path) -> list[str]:
    """Return the words of a file; none without it."""
    try:
        return file.read_text(encoding="utf-8").split()
    except (OSError, ValueError):
        return []
