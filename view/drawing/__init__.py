"""What all figures share: the canvas, and colours."""
