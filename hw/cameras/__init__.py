"""Cameras, and the thread that reads from them."""
