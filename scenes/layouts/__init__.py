"""Layouts of pins: one class in one module each."""
