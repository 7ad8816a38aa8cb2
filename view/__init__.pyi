from .drawing.canvas import check_drawing
from .truth import height_figure, normal_figure, surface_figure

__all__ = ["check_drawing", "height_figure", "normal_figure", "surface_figure"]
