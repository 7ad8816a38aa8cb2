"""Kernels of displacements of the skin, and of poses."""
