"""The same path when no page of its file is in memory."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.ours import OURS
from mirrorskin.bench.paths.files import can_drop, drop, read_plainly
from mirrorskin.bench.results import Row
from mirrorskin.kernels.device import Device

COLD, STORAGE = f"{OURS}, file to result, cold", "plain reads of the file, cold"

_ROUNDS = 3
_ROOM = 2**22


def measure_cold(
    path: Path, work: Work, device: Device, rounds: int, frames: int, size: int
) -> tuple[list[Row], dict[str, str]]:
    """Time a path and plain reads of its file, each after the file was dropped from the page cache.

    Parameters
    ----------
    path : Path
        Of the recording, which is closed.
    work : callable
        From this file to a result.
    device : Device
    rounds : int
        At most; three are enough.
    frames, size : int
        Of the recording, and their bytes.

    Returns
    -------
    rows : list of Row
    absent : dict of str
        Why there are none.
    """
    if not can_drop(path):
        return [], {COLD: "pages of this file cannot be dropped from the cache"}
    # Works take turns in this order, so that each drop belongs to what follows.
    works: dict[str, Work] = {
        "drop": partial(drop, path),
        STORAGE: partial(read_plainly, path, bytearray(_ROOM)),
        "drop again": partial(drop, path),
        COLD: work,
    }
    measured = take_turns(works, min(rounds, _ROUNDS), device.profile)
    stored = path.stat().st_size
    return [Row(STORAGE, measured[STORAGE], stored), Row(COLD, measured[COLD], size, frames)], {}
