"""One surface from a press and a rotation."""
