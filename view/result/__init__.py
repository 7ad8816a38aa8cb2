"""Figures of one result."""

from mirrorskin.view.result.figures import figures_of, overview, pixels_of

__all__ = ["figures_of", "overview", "pixels_of"]
