"""Comparison of rendered frames with real ones: pairs of pictures, and statistics of both sets."""
