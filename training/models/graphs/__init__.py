"""The paper's graph networks: see ``training.models.graphs.model``."""
