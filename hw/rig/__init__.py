"""Stage and camera together: the rig file, scans, and where the body was in each frame."""
