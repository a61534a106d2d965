"""Optics: from a sensor's deformed geometry to the light on its camera's film."""
