"""What all of io needs: types, errors, units, arguments, samples, and the system."""
