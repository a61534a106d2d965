"""Our model of contacts with forces: see ``training.models.touch.model``."""
