"""Cameras, arms, their emulators, and the loop that joins them."""
