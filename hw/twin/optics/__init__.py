"""What the camera sees in the mirror: the lit wall."""
