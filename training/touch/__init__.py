"""Contact from the pins: whether anything is touched, slip, contact maps."""
