from .changepoint import ChangePoint, find_change_point
from .growth import Growth, find_growth
from .holes import fill_holes
from .levels import Levels
from .onset import Onset, find_onset
from .press import Press
from .strokes import Strokes

__all__ = [
    "ChangePoint",
    "Growth",
    "Levels",
    "Onset",
    "Press",
    "Strokes",
    "fill_holes",
    "find_change_point",
    "find_growth",
    "find_onset",
]
