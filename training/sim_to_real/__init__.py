"""Trained in the twin, tested on real frames."""
