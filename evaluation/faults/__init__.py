"""Standard deviations when a camera, a lamp or a stage fails."""
