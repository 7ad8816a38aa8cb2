"""Figures, reports and interactive views."""

from mirrorskin.view.canvas import check_drawing
from mirrorskin.view.truth import height_figure, normal_figure, surface_figure

__all__ = [
    "check_drawing",
    "height_figure",
    "normal_figure",
    "surface_figure",
]
