"""The convolutional baselines: see ``training.models.cnn.model``."""
