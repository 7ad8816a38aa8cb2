"""Heights from slopes: weighted least squares on the graph of the pixels."""
