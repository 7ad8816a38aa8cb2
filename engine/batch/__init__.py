"""Reconstruction of many recordings, on several devices or machines."""
