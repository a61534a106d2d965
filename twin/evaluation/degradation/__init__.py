"""Robustness of the pin detection: known degradations of increasing severity, applied to frames with known pins."""
