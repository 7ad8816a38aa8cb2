"""A stage behind GRBL: replies, the serial line, moves, and the stage."""
