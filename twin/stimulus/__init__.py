"""Objects as signed-distance fields, in the object frame (origin touched first, z into the object)."""

from twin.stimulus.build import Stimulus, build_stimulus

__all__ = ["Stimulus", "build_stimulus"]
