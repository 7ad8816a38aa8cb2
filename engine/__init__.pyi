from .errors import NotConverged
from .focus import Focus, find_focus
from .force.normal import find_force
from .force.tangential import find_tangential_force
from .fringes import Fringes, decode_gray, fit_fringes, unwrap_frequencies, unwrap_gray
from .fusion import fuse
from .integration.camera import Camera
from .integration.integration import Integrator, integrate
from .integration.laplacian import invert_laplacian
from .method import Method, Step
from .metrology.measures import Measures, measure
from .operation import Operation
from .options import option
from .photometric import PhotometricStereo, photometric_stereo
from .pose.pose import Pose, estimate_pose
from .pose.stitching import Stitch, stitch
from .pose.tracker import PoseTracker
from .press.changepoint import ChangePoint, find_change_point
from .press.growth import Growth, find_growth
from .press.holes import fill_holes
from .press.onset import Onset, find_onset
from .press.press import Press
from .press.strokes import Strokes
from .reconstruction import reconstruct
from .rotation.correlation import Correlate, correlate
from .rotation.edges import find_edges
from .rotation.frequency import Frequency, estimate_frequency
from .rotation.moving_normals import MovingNormals, estimate_normals
from .rotation.normals import Normals
from .rotation.rotation import Rotation
from .running import run
from .scoring import Score, score
from .slip.displacement import find_displacement
from .slip.search import Slip
from .slip.slip import Sliding
from .tiling import free_memory

__all__ = [
    "Camera",
    "ChangePoint",
    "Correlate",
    "Focus",
    "Frequency",
    "Fringes",
    "Growth",
    "Integrator",
    "Measures",
    "Method",
    "MovingNormals",
    "Normals",
    "NotConverged",
    "Onset",
    "Operation",
    "PhotometricStereo",
    "Pose",
    "PoseTracker",
    "Press",
    "Rotation",
    "Score",
    "Sliding",
    "Slip",
    "Step",
    "Stitch",
    "Strokes",
    "correlate",
    "decode_gray",
    "estimate_frequency",
    "estimate_normals",
    "estimate_pose",
    "fill_holes",
    "find_change_point",
    "find_displacement",
    "find_edges",
    "find_focus",
    "find_force",
    "find_growth",
    "find_onset",
    "find_tangential_force",
    "fit_fringes",
    "free_memory",
    "fuse",
    "integrate",
    "invert_laplacian",
    "measure",
    "option",
    "photometric_stereo",
    "reconstruct",
    "run",
    "score",
    "stitch",
    "unwrap_frequencies",
    "unwrap_gray",
]
