from .changepoint import ChangePoint, find_change_point
from .holes import fill_holes
from .levels import Levels
from .onset import Onset, find_onset
from .press import Press
from .strokes import Strokes

__all__ = [
    "ChangePoint",
    "Levels",
    "Onset",
    "Press",
    "Strokes",
    "fill_holes",
    "find_change_point",
    "find_onset",
]
