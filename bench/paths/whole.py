"""The whole path of a recording: from a file with frames to a file with maps."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

from mirrorskin import io
from mirrorskin.bench.harness import Work
from mirrorskin.bench.ours import OURS
from mirrorskin.engine import reconstruct
from mirrorskin.kernels.device import Device

PATH = f"{OURS}, file to result"
ROUNDS = 7


def to_result(
    source: Path,
    target: Path | None,
    device: Device,
    opening: Mapping[str, Any] | None = None,
    **options: Any,
) -> io.Result:
    """Open a recording, reconstruct it, and save the result if it has a name.

    Parameters
    ----------
    source : Path
    target : Path or None
    device : Device
    opening : mapping, optional
        Keywords of `mirrorskin.io.open_recording`.
    **options
        Keywords of `mirrorskin.engine.reconstruct`.
    """
    with io.open_recording(source, **(opening or {})) as recording:
        result = reconstruct(recording, device=device, **options)
    if target is not None:
        io.save_result(result, target)
    return result


def to_new_results(source: Path, target: Path, device: Device, **options: Any) -> Work:
    """Return a work that does the path and writes a new file each time, since to replace one takes longer.

    Parameters
    ----------
    source : Path
    target : Path
        Of the first result; others have a number more.
    device : Device
    **options
        Those of `to_result`.
    """
    numbers = count()

    def work() -> io.Result:
        number = next(numbers)
        name = target.with_stem(f"{target.stem}-{number}") if number else target
        return to_result(source, name, device, **options)

    return work
