"""Figures, reports and interactive views."""

from mirrorskin.view.canvas import check_drawing
from mirrorskin.view.force import force_figure
from mirrorskin.view.pose import Followed, pose_figure
from mirrorskin.view.slip import Slipped, slip_figure
from mirrorskin.view.truth import height_figure, normal_figure, surface_figure
from mirrorskin.view.vibration import Vibration, vibration_figure

__all__ = [
    "Followed",
    "Slipped",
    "Vibration",
    "check_drawing",
    "force_figure",
    "height_figure",
    "normal_figure",
    "pose_figure",
    "slip_figure",
    "surface_figure",
    "vibration_figure",
]
