"""Cameras, arms and what of them is attached to this machine."""
