"""Kernels of a rotation: correlation, normals, edges and registration."""
