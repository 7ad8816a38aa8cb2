"""A ball of known size: as every frame sees it, and where it is in the picture."""
