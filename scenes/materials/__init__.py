"""Hyperelastic laws of rubbers: one class in one module each."""
