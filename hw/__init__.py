"""What moves and what sees: stage, camera, and the digital twin of both."""

from mirrorskin.hw.twin import Live, Twin

__all__ = ["Live", "Twin"]
