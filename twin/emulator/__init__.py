"""A rig without hardware: a GRBL controller behind a terminal, and the twin as its camera."""
