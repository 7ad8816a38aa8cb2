from .edges import find_edges
from .moving_normals import MovingNormals, estimate_normals
from .normals import Normals
from .rotation import Rotation

__all__ = [
    "MovingNormals",
    "Normals",
    "Rotation",
    "estimate_normals",
    "find_edges",
]
