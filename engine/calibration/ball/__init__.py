"""A ball of known size: as every frame sees it, where it is in the picture, and how a gel takes its shape."""
