"""Results while the body moves: the same accumulators as offline, within a bounded time."""

from mirrorskin.engine.live.estimator import LiveEstimator
from mirrorskin.engine.live.loop import LATENCY, Loop, run
from mirrorskin.engine.live.press import LivePress
from mirrorskin.engine.live.rotation import LiveRotation, choose_window
from mirrorskin.engine.live.types import (
    PUSHED,
    SHOWN,
    STAGES,
    UPDATED,
    WAITED,
    Latency,
    Status,
    Update,
)

__all__ = [
    "LATENCY",
    "PUSHED",
    "SHOWN",
    "STAGES",
    "UPDATED",
    "WAITED",
    "Latency",
    "LiveEstimator",
    "LivePress",
    "LiveRotation",
    "Loop",
    "Status",
    "Update",
    "choose_window",
    "run",
]
