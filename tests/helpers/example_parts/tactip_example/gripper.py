"""A gripper that remembers its width, and a policy that closes it slowly."""

import numpy as np


class ExampleGripper:
    """A gripper from the text after ``example:``."""

    width_mm = 40.0

    def __init__(self, rest, sensor):
        self.name = f"example gripper at {rest}"

    def move(self, width_mm):
        self.width_mm = width_mm


def grip(seen):
    """Close as long as the pins hardly moved."""
    return np.array([0.1 * (np.abs(seen["tactile"][0]).max() < 1.0)])
