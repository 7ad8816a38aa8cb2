from .drawing.canvas import check_drawing
from .truth import height_figure, surface_figure
from .truth_normals import normal_figure

__all__ = ["check_drawing", "height_figure", "normal_figure", "surface_figure"]
