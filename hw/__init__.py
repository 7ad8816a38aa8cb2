"""What moves and what sees: stage, camera, both as a rig, and the digital twin of it all."""

from mirrorskin.hw.camera import Camera
from mirrorskin.hw.emulator.rig import EmulatedRig
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.rig.plans import AxialPlan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig, open_rig
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.hw.rig_file import load_rig
from mirrorskin.hw.stage import Limits, Position, Stage
from mirrorskin.hw.twin import Live, Twin
from mirrorskin.hw.video import VideoCamera

__all__ = [
    "AxialPlan",
    "Camera",
    "EmulatedRig",
    "GrblStage",
    "HardwareError",
    "Limits",
    "Live",
    "Position",
    "Rig",
    "Stage",
    "StepScan",
    "SweepScan",
    "Twin",
    "VerticalPlan",
    "VideoCamera",
    "load_rig",
    "open_rig",
]
