"""A task."""

from training.environments.tasks import GentlePress


class ExamplePress(GentlePress):
    """Press a ball with little force."""

    name, objects, forces_n = "ExamplePress", ("ball-40",), (0.2, 0.5)
