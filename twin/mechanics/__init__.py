"""Pressing the sensor: poses, finite elements, contact with friction."""

from twin.mechanics.path import ContactPath, ContactPose
from twin.mechanics.solver import SkinSolver

__all__ = ["ContactPath", "ContactPose", "SkinSolver"]
