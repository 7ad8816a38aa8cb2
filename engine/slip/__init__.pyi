from .displacement import find_displacement
from .search import Slip
from .slip import Sliding

__all__ = [
    "Sliding",
    "Slip",
    "find_displacement",
]
