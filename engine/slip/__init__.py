"""The texture of the skin on the move: how far it has gone, and where it slips on the object."""
