from .pose import Pose, estimate_pose
from .stitching import Stitch, stitch
from .tracker import PoseTracker
from .turn_tracker import TurnTracker

__all__ = [
    "Pose",
    "PoseTracker",
    "Stitch",
    "TurnTracker",
    "estimate_pose",
    "stitch",
]
