"""The GRBL driver: replies, the serial line, moves, and the stage."""
