"""What every computation is made of: options, operations, sources, runs, and pictures on devices."""
