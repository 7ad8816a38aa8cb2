"""The driver for Marlin, the firmware of 3D printers."""
