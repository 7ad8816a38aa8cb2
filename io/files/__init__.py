"""Recordings and results in files: opened, written and described."""
