"""What the brightness of a few pixels over time shows about a recording."""
