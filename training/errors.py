"""The error of training data, runs and trained models."""

from twin.errors import TwinError


class TrainingError(TwinError):
    """A training run can't be started, continued or used as requested."""
