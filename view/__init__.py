"""Pictures for people."""

from mirrorskin.view.figures import check_drawing, height_figure

__all__ = ["check_drawing", "height_figure"]
