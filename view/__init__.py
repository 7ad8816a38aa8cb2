"""Pictures for people."""

from mirrorskin.view.canvas import check_drawing
from mirrorskin.view.force import force_figure
from mirrorskin.view.slip import Slipped, slip_figure
from mirrorskin.view.truth import height_figure, normal_figure, surface_figure
from mirrorskin.view.vibration import Vibration, vibration_figure

__all__ = [
    "Slipped",
    "Vibration",
    "check_drawing",
    "force_figure",
    "height_figure",
    "normal_figure",
    "slip_figure",
    "surface_figure",
    "vibration_figure",
]
