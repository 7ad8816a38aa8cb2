from .pose import Pose, estimate_pose
from .stitching import Stitch, stitch
from .tracker import PoseTracker

__all__ = [
    "Pose",
    "PoseTracker",
    "Stitch",
    "estimate_pose",
    "stitch",
]
