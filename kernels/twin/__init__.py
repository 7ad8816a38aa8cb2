"""Kernels of the twin's skin, wall and camera."""
