"""``steered``: a model of one direction on the whole circle."""
