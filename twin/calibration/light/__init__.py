"""Fits of all that is light: caps, LEDs, housing, specks, surroundings and the camera's response."""
