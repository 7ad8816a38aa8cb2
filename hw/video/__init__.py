"""Cameras, video files and network streams through OpenCV."""

from mirrorskin.hw.video.camera import VideoCamera

__all__ = ["VideoCamera"]
