from .loop import LATENCY, LiveEstimator, Loop
from .own import LiveOwn
from .press import LivePress
from .rocking import LiveRocking
from .rotation import LiveRotation, choose_window
from .slip import LiveSlip
from .status import PUSHED, RAISED, SHOWN, STAGES, UPDATED, WAITED, Latency, Maps, Status, Update

__all__ = [
    "LATENCY",
    "PUSHED",
    "RAISED",
    "SHOWN",
    "STAGES",
    "UPDATED",
    "WAITED",
    "Latency",
    "LiveEstimator",
    "LiveOwn",
    "LivePress",
    "LiveRocking",
    "LiveRotation",
    "LiveSlip",
    "Loop",
    "Maps",
    "Status",
    "Update",
    "choose_window",
]
