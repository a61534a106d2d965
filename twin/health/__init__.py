"""A sensor's state of health, told from a few of its frames."""

from twin.health.examine import Finding, Grade, examine

__all__ = ["Finding", "Grade", "examine"]
