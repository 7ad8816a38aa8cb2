from .displacement import find_displacement
from .search import SlipOnset
from .slip import Slide

__all__ = [
    "Slide",
    "SlipOnset",
    "find_displacement",
]
