"""Numbers of a height map as metrology defines them, each with its standard uncertainty."""
