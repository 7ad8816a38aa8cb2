"""Sources of frames, tables of results, and a server that reports, tests and benchmarks share."""
