"""``twin sensors``, ``twin objects``, ``twin experiments`` and ``twin randomisations``: what is shipped, and where one's own go."""

from scenes import catalog
from twin.cli import app
from twin.cli.output import say


@app.command("sensors")
def sensors() -> None:
    """List the sensor specifications, and where to put one's own."""
    say(catalog.sensors().lines())


@app.command("objects")
def objects() -> None:
    """List the object specifications, and where to put one's own."""
    say([*catalog.objects().lines(), "Any STL, OBJ or PLY file (in mm) is an object too: --object part.stl"])


@app.command("experiments")
def experiments() -> None:
    """List the experiments (which contacts are made, in the robot's coordinates), and where to put one's own."""
    say(catalog.experiments().lines())


@app.command("randomisations")
def randomisations() -> None:
    """List what can differ from one simulated frame to the next, and where to put one's own."""
    say(catalog.randomisations().lines())
