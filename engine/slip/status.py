"""What the status says of a pixel in a slide or a twist."""

UNKNOWN, SLIPPED, STICKS, NO_CONTACT, CLEAR = range(5)
