"""Stages: how they report and move, and the firmwares GRBL and Marlin."""
