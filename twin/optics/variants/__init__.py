"""Mitsuba's variants: which of them work on this machine, and its arrays."""
