from . import (
    calibration,
    correlation,
    force,
    integration,
    live,
    metrology,
    optical,
    pose,
    press,
    rotation,
    slip,
    vibration,
)
from .base.errors import NotConverged
from .base.functions import function_of
from .base.method import Method
from .base.operation import Operation
from .base.options import option
from .base.reconstruction import reconstruct, run
from .base.running import Run
from .base.steps import Step
from .base.tiling import free_memory
from .correlation.correlation import Correlate, correlate
from .fusion.fusion import fuse
from .integration.integration import Integrator, integrate
from .metrology.measures import measure
from .metrology.scoring import score
from .press.changepoint import ChangePoint, find_change_point
from .press.holes import fill_holes
from .press.onset import Onset, find_onset
from .press.press import Press
from .rotation.edges import find_edges
from .rotation.moving_normals import estimate_normals
from .rotation.normals import Normals
from .rotation.rotation import Rotation
from .slip.slip import Slide

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
    "Slide",
    "Step",
    "calibration",
    "correlate",
    "correlation",
    "estimate_normals",
    "fill_holes",
    "find_change_point",
    "find_edges",
    "find_onset",
    "force",
    "free_memory",
    "function_of",
    "fuse",
    "integrate",
    "integration",
    "live",
    "measure",
    "metrology",
    "optical",
    "option",
    "pose",
    "press",
    "reconstruct",
    "rotation",
    "run",
    "score",
    "slip",
    "vibration",
]
