"""Stage and camera together: rig files, scans, and the position of the body in each frame."""
