"""Our network: see ``training.models.vgnn.model``."""
