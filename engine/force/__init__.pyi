from .normal import find_force
from .tangential import find_tangential_force
from .tracker import ForceTracker

__all__ = [
    "ForceTracker",
    "find_force",
    "find_tangential_force",
]
