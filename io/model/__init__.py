"""The data model: maps, results, positions, calibrations, and readers of frames."""
