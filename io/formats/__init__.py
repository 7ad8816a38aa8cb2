"""Files of other programs, and exports."""
