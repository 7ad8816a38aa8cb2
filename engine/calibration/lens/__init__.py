"""Millimetres per pixel and the lens from pictures of a board."""
