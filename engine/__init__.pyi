from . import (
    calibration,
    focus,
    force,
    fringes,
    integration,
    live,
    metrology,
    photometric,
    pose,
    press,
    rotation,
    slip,
)
from .errors import NotConverged
from .functions import function_of
from .fusion import fuse
from .integration.integration import Integrator, integrate
from .method import Method
from .metrology.measures import measure
from .operation import Operation
from .options import option
from .press.changepoint import ChangePoint, find_change_point
from .press.holes import fill_holes
from .press.onset import Onset, find_onset
from .press.press import Press
from .reconstruction import reconstruct, run
from .rotation.correlation import Correlate, correlate
from .rotation.edges import find_edges
from .rotation.moving_normals import estimate_normals
from .rotation.normals import Normals
from .rotation.rotation import Rotation
from .running import Run
from .scoring import score
from .slip.slip import Sliding
from .steps import Step
from .tiling import free_memory

__all__ = [
    "ChangePoint",
    "Correlate",
    "Integrator",
    "Method",
    "Normals",
    "NotConverged",
    "Onset",
    "Operation",
    "Press",
    "Rotation",
    "Run",
    "Sliding",
    "Step",
    "calibration",
    "correlate",
    "estimate_normals",
    "fill_holes",
    "find_change_point",
    "find_edges",
    "find_onset",
    "focus",
    "force",
    "free_memory",
    "fringes",
    "function_of",
    "fuse",
    "integrate",
    "integration",
    "live",
    "measure",
    "metrology",
    "option",
    "photometric",
    "pose",
    "press",
    "reconstruct",
    "rotation",
    "run",
    "score",
    "slip",
]
