"""Tactile servo control: the loop, its law, its figures."""
