"""A fast stand-in for the skin's finite elements: friction's memory by bristles, all else by a small network."""
