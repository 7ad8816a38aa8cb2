from .loop import LATENCY, Loop
from .operation import LiveOperation
from .status import PUSHED, RAISED, SHOWN, STAGES, UPDATED, WAITED, Latency, Maps, Status, Update
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
    "LiveOperation",
    "Loop",
    "Maps",
    "Status",
    "Stream",
    "Update",
]
