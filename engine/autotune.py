"""Choosing a device's layout by trial: measured once for each device and driver, and kept on disk."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from mirrorskin.engine.provenance import program_version
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.disk_cache import keep, recall
from mirrorskin.kernels.errors import DeviceError
from mirrorskin.kernels.layout import LAYOUTS, Layout

Run = Callable[[], None]

_ROUNDS = 5
_lock = threading.RLock()
_log = logging.getLogger("mirrorskin.engine")


def choose_layout(device: Device, prepare: Callable[[Device], Run]) -> None:
    """Give a device the layout in which it does a trial fastest, unless that has been measured before.

    ``prepare`` makes the trial for a device in its present layout; what it returns does the work and waits.
    DeviceError if it runs in no layout.
    """
    with _lock:
        if device.tuned:
            return
        info = device.info
        key = info.title, info.driver, info.compute_units, LAYOUTS, program_version()
        known = recall("shape", key)
        device.tuned = True  # the trial itself chooses none
        if known is not None and known.isdecimal() and int(known) < len(LAYOUTS):
            device.layout = LAYOUTS[int(known)]
            return
        try:
            device.layout = _fastest(device, prepare)
        except DeviceError:
            device.tuned = False
            raise
        keep("shape", key, str(LAYOUTS.index(device.layout)))
        _log.info("%s is fastest with %s", info.title, device.layout)


def _fastest(device: Device, prepare: Callable[[Device], Run]) -> Layout:
    seconds: dict[Layout, float] = {}
    problem = None
    for layout in LAYOUTS:
        device.layout = layout
        try:
            seconds[layout] = _time(prepare(device))
        except DeviceError as error:
            _log.info("%s does not run with %s: %s", device.info.title, layout, error)
            problem = error
    if problem is not None and not seconds:
        raise problem
    return min(seconds, key=lambda layout: seconds[layout])


def _time(run: Run) -> float:
    """Return the seconds of the fastest of several rounds, after one that does not count."""
    run()
    rounds = []
    for _ in range(_ROUNDS):
        start = time.perf_counter()
        run()
        rounds.append(time.perf_counter() - start)
    return min(rounds)
