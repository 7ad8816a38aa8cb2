"""Steps that find what is wrong in a recording, and add it to standard deviations and findings."""
