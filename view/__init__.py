"""Pictures for people."""

from mirrorskin.view.figures import height_figure

__all__ = ["height_figure"]
