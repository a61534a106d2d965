"""Simulated data sets: frames in the recordings' own format, with the exact truth beside them."""

from training.generation.config import DatasetError, GenerationConfig, require_count
from training.generation.run import generate

__all__ = ["DatasetError", "GenerationConfig", "generate", "require_count"]
