from .loop import LATENCY, Loop
from .run import LiveRun
from .status import PUSHED, RAISED, SHOWN, STAGES, UPDATED, WAITED, Latency, Status, Update
from .stream import Stream

__all__ = [
    "LATENCY",
    "PUSHED",
    "RAISED",
    "SHOWN",
    "STAGES",
    "UPDATED",
    "WAITED",
    "Latency",
    "LiveRun",
    "Loop",
    "Status",
    "Stream",
    "Update",
]
