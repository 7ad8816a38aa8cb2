"""A child process that reconstructs one recording and tells how much memory that took.

Its command line is FEW RECORDING RESULT BUDGET DEVICE, see `measure`; it writes JSON.
"""

from __future__ import annotations

import gc
import json
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from mirrorskin.bench.paths.whole import to_result
from mirrorskin.kernels.device import Device, open_device

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_PEAK = "5"  # what resets the peak
_EVERY = 0.001  # seconds between looks


@dataclass(frozen=True, slots=True)
class Memory:
    """Bytes of a process's memory that came on top of what it had before.

    Attributes
    ----------
    peak : int
        By the system's own count (VmHWM): all that is resident, pages of mapped files as well.
    anonymous : int
        The most that was seen of its own alone (RssAnon and RssShmem).
    """

    peak: int
    anonymous: int


def is_told() -> bool:
    """Tell whether the system says how much memory a process takes."""
    return _CLEAR.exists()


@contextmanager
def watch_memory() -> Iterator[SimpleNamespace]:
    """Watch this process's memory; in the end, ``memory`` of what is given says what came on top."""
    gc.collect()
    _CLEAR.write_text(_PEAK, encoding="ascii")
    before, own = _bytes("VmRSS"), _bytes("RssAnon", "RssShmem")
    seen, done, told = [own], threading.Event(), SimpleNamespace()

    def look() -> None:
        while not done.wait(_EVERY):
            seen.append(max(seen.pop(), _bytes("RssAnon", "RssShmem")))

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield told
    finally:
        done.set()
        watcher.join()
    told.memory = Memory(_bytes("VmHWM") - before, seen[0] - own)


def measure(few: Path, source: Path, target: Path, budget: int, device: Device) -> Memory:
    """Reconstruct a recording within a budget, after one of few frames: what is loaded once is there."""
    within: dict[str, Any] = {"opening": {"memory_limit": budget}, "memory_limit": budget}
    to_result(few, target, device, **within)
    with watch_memory() as told:
        to_result(source, target, device, **within)
    memory: Memory = told.memory
    return memory


def _bytes(*names: str) -> int:
    """Return the sum of some numbers of this process's status."""
    lines = _STATUS.read_text(encoding="ascii").splitlines()
    known = dict(line.split(":", 1) for line in lines)
    return 1024 * sum(int(known[name].split()[0]) for name in names)


def main() -> None:
    """Measure what the command line says."""
    few, source, target, budget, device = sys.argv[1:]
    memory = measure(Path(few), Path(source), Path(target), int(budget), open_device(device))
    json.dump(asdict(memory), sys.stdout)
