"""Pictures of a calibration, part by part."""
