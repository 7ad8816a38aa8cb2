from .correlation import Correlate, correlate
from .frequency import Frequency, estimate_frequency
from .growth import Growth, find_growth

__all__ = [
    "Correlate",
    "Frequency",
    "Growth",
    "correlate",
    "estimate_frequency",
    "find_growth",
]
