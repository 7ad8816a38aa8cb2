"""What the experiments share: a camera as labs have it, and its recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mirrorskin import hw, io
    from mirrorskin.hw.twin import Camera


def lab_camera() -> Camera:
    """Return a camera with read and shot noise, deviations of the pixels, and a lens."""
    from mirrorskin.hw.twin import Camera

    return Camera(noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5)


def record(twin: hw.Twin, path: Path, doing: str) -> io.Truth:
    """Record all frames of a twin, with a bar that says what it is doing; return the truth."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress

    with (
        io.Recorder(twin, path, truth=lambda: twin.truth) as recorder,
        progress(doing, twin.shape[0]) as show,
    ):
        recorder.drain(show)
    return twin.truth
