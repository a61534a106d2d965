"""Fitting a specification to frames of a real sensor."""
