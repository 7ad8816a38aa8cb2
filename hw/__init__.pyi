from . import twin as twin
from .camera import Camera
from .camera_thread import ThreadedCamera
from .emulator.rig import EmulatedRig
from .errors import HardwareError
from .genicam import GenicamCamera
from .grbl.stage import GrblStage
from .rig.plans import AxialPlan, HorizontalPlan, RockPlan, TwistPlan, VerticalPlan
from .rig.rig import Rig, open_rig
from .rig.scan import StepScan
from .rig.sweep import SweepScan
from .rig_file import load_rig
from .simulated_clock import SimulatedClock
from .stage import Limits, Position
from .twin import Live, Twin
from .video import VideoCamera

__all__ = [
    "AxialPlan",
    "Camera",
    "EmulatedRig",
    "GenicamCamera",
    "GrblStage",
    "HardwareError",
    "HorizontalPlan",
    "Limits",
    "Live",
    "Position",
    "Rig",
    "RockPlan",
    "SimulatedClock",
    "StepScan",
    "SweepScan",
    "ThreadedCamera",
    "Twin",
    "TwistPlan",
    "VerticalPlan",
    "VideoCamera",
    "load_rig",
    "open_rig",
]
