"""Kernels of focus and of light from several directions."""
