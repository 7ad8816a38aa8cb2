"""Kernels that compute heights from slopes."""
