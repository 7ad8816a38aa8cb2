"""Brightness by place and normal, from presses of a ball."""
