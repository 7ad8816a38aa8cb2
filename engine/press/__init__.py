"""A press or its release: heights from the frame in which a pixel turns light or dark."""
