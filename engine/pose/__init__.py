"""Where and how an object moved from one result to the next, and one surface of several results."""
