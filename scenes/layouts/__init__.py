"""Layouts of pins: one class in one module each."""

MOST_PINS = 5000
"""Largest number of pins. The finest printed sensors have about 3000."""
