"""Pictures of results beside the truth that a simulation knows."""
