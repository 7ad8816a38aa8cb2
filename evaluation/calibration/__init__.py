"""Errors of calibrated sensors."""
