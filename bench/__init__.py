"""Benchmarks of the development: times of calls, files and live runs, next to their limits and peers."""
