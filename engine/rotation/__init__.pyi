from .correlation import Correlate, correlate
from .edges import find_edges
from .frequency import Frequency, estimate_frequency
from .moving_normals import MovingNormals, estimate_normals
from .normals import Normals
from .rotation import Rotation

__all__ = [
    "Correlate",
    "Frequency",
    "MovingNormals",
    "Normals",
    "Rotation",
    "correlate",
    "estimate_frequency",
    "estimate_normals",
    "find_edges",
]
