"""A sensor's state of health, told from a few of its frames."""

from twin.health.examine import Finding, Verdict, examine

__all__ = ["Finding", "Verdict", "examine"]
