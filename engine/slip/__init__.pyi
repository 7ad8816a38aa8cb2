from .displacement import find_displacement
from .search import SlipOnset
from .slip import Slide
from .slip_tracker import SlipTracker

__all__ = [
    "Slide",
    "SlipOnset",
    "SlipTracker",
    "find_displacement",
]
