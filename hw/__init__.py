"""What moves and what sees: stage, camera, and the digital twin of both."""

from mirrorskin.hw.twin import Twin

__all__ = ["Twin"]
