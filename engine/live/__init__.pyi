from .loop import LATENCY, Loop
from .run import LiveRun
from .status import PUSHED, RAISED, SHOWN, STAGES, UPDATED, WAITED, Event, Latency, Status, Update
from .stream import Stream
from .touch import Taken, Touched, TouchSensor, fuse_touch, recordings_of, touch
from .tracking import Frames, Limit, Tracker

__all__ = [
    "LATENCY",
    "PUSHED",
    "RAISED",
    "SHOWN",
    "STAGES",
    "UPDATED",
    "WAITED",
    "Event",
    "Frames",
    "Latency",
    "Limit",
    "LiveRun",
    "Loop",
    "Status",
    "Stream",
    "Taken",
    "TouchSensor",
    "Touched",
    "Tracker",
    "Update",
    "fuse_touch",
    "recordings_of",
    "touch",
]
