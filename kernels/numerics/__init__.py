"""Least squares, conjugate gradients, samples of arrays, and the limits of a device."""
