"""Looks at a camera that runs: its frames, their rate, and how much light they have."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.camera import Camera, Counts
from mirrorskin.hw.rig.finding import Finding
from mirrorskin.hw.settings import CameraSettings

_FIRST = 5.0  # seconds that a camera may take to its first frame
_PERIOD = 1.0  # seconds that frames are counted for
_MOST = 64  # frames taken at once
_OFF = 0.05  # share that a rate may differ from the one asked
_SATURATED = 0.01  # share of the pixels that may be


def check_camera(camera: Camera, settings: CameraSettings) -> Iterator[Finding]:
    """Look at a camera that was opened, for about a second.

    Raises
    ------
    HardwareError
        No frame came, or the camera was lost meanwhile.
    """
    rows, columns = camera.shape
    yield Finding("camera", "pictures", f"{columns} x {rows} {camera.dtype.name}")
    before, picture, dropped = _watch(camera)
    after = camera.counts
    yield _rate(after, settings)
    yield _losses(dropped, after, before)
    yield _brightness(picture)


def _watch(camera: Camera) -> tuple[Counts, NDArray[Any], int]:
    """Take all frames of a second; return the counts before, the last frame, and how many were lost."""
    camera.take(1, _FIRST)
    camera.flush()
    before, dropped, end = camera.counts, 0, time.monotonic() + _PERIOD
    while True:
        frames = camera.take(_MOST, _FIRST)
        dropped += frames.dropped
        if time.monotonic() >= end:
            return before, frames.pixels[-1].copy(), dropped


def _rate(counts: Counts, settings: CameraSettings) -> Finding:
    found = f"{counts.rate:.2f} Hz"
    if settings.rate is None:
        return Finding("camera", "rate", found)
    found += f", asked {settings.rate:g} Hz"
    if abs(counts.rate - settings.rate) <= _OFF * settings.rate:
        return Finding("camera", "rate", found)
    remedy = f"the exposure or the line may be too long for it; set camera.rate = {counts.rate:.3g}"
    return Finding("camera", "rate", found, "warning", remedy)


def _losses(dropped: int, after: Counts, before: Counts) -> Finding:
    total, late = after.frames - before.frames, after.late - before.late
    found = f"{total} frames, {dropped} lost, {late} late, {after.reconnects} reconnections"
    if dropped or after.reconnects:
        return Finding(
            "camera", "frames", found, "warning", "frames are lost; lower the rate, or use a faster line"
        )
    return Finding("camera", "frames", found)


def _brightness(picture: NDArray[Any]) -> Finding:
    known = picture[~np.isnan(picture)]
    if not known.size:
        return Finding("camera", "brightness", "NaN", "warning", "no pixel has a value; look at camera.dtype")
    low, middle, high = (float(value) for value in np.percentile(known, (0, 50, 100)))
    top = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else np.inf
    saturated, dark = float(np.mean(picture >= top)), float(np.mean(picture <= 0))
    found = f"{low:g} to {high:g}, median {middle:g}; {saturated:.2%} saturated, {dark:.2%} black"
    if saturated > _SATURATED:
        return Finding("camera", "brightness", found, "warning", "too much light; shorten the exposure")
    if high <= low:
        return Finding(
            "camera", "brightness", found, "warning", "all pixels are alike; look at the light and the lid"
        )
    return Finding("camera", "brightness", found)
