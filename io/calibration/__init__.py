"""Calibration files: what is known of a sensor."""
