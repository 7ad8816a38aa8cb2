"""Calibration files: the parameters of a sensor."""
