from .frequency import Frequency, estimate_frequency
from .growth import Growth, find_growth

__all__ = [
    "Frequency",
    "Growth",
    "estimate_frequency",
    "find_growth",
]
