"""Kernels that search the frame in which a pixel turns light."""
