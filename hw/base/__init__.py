"""What stages, cameras and rigs share: their protocols and settings, the clock, and errors."""
