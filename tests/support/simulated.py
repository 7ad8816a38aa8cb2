"""Commands on simulated time: what they open rigs, stages and cameras with."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from mirrorskin.hw.rig import check, rig
from mirrorskin.hw.simulated_clock import SimulatedClock


def simulate(
    patch: pytest.MonkeyPatch,
    clock: SimulatedClock,
    open_stage: Callable[..., Any] | None = None,
    open_camera: Callable[..., Any] | None = None,
) -> None:
    """Let commands open what the rig file says, or what these open, on a simulated clock."""
    stage = open_stage or functools.partial(rig.open_stage, clock=clock)
    camera = open_camera or functools.partial(rig.open_camera, clock=clock)
    both = {"clock": clock, "open_stage": stage, "open_camera": camera}
    patch.setattr(rig, "open_rig", functools.partial(rig.open_rig, **both))
    patch.setattr(check, "check_rig", functools.partial(check.check_rig, **both))
    patch.setattr(rig, "open_stage", stage)
    patch.setattr(rig, "open_camera", camera)


def on_clock(clock: SimulatedClock) -> dict[str, Any]:
    """Return what stands in for the modules ``time`` and ``threading`` in a user's class."""
    return {
        "time": SimpleNamespace(monotonic=clock.now, sleep=clock.sleep),
        "threading": SimpleNamespace(
            Lock=clock.condition, Event=clock.event, Thread=lambda target: clock.thread(target, "user's")
        ),
    }
