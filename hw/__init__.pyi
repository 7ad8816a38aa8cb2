from .base.camera import Camera
from .base.errors import HardwareError
from .base.rig_file import load_rig
from .base.stage import Limits, Position, Stage
from .cameras.camera_thread import ThreadedCamera
from .cameras.genicam import GenicamCamera
from .cameras.video import VideoCamera
from .rig.plans import AxialPlan, HorizontalPlan, RockPlan, TwistPlan, VerticalPlan
from .rig.rig import Rig, open_rig
from .rig.scan import StepScan
from .rig.sweep import SweepScan
from .rig.touch import RigTouch
from .stages.grbl import GrblStage

__all__ = [
    "AxialPlan",
    "Camera",
    "GenicamCamera",
    "GrblStage",
    "HardwareError",
    "HorizontalPlan",
    "Limits",
    "Position",
    "Rig",
    "RigTouch",
    "RockPlan",
    "Stage",
    "StepScan",
    "SweepScan",
    "ThreadedCamera",
    "TwistPlan",
    "VerticalPlan",
    "VideoCamera",
    "load_rig",
    "open_rig",
]
