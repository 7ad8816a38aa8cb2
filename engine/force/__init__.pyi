from .normal import find_force
from .tangential import find_tangential_force

__all__ = [
    "find_force",
    "find_tangential_force",
]
