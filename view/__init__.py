"""Pictures for people."""

from mirrorskin.view.canvas import check_drawing
from mirrorskin.view.truth.heights import height_figure
from mirrorskin.view.truth.normals import normal_figure
from mirrorskin.view.truth.surfaces import surface_figure

__all__ = ["check_drawing", "height_figure", "normal_figure", "surface_figure"]
