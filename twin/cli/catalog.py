"""``twin sensors``, ``twin objects``, ``twin experiments`` and ``twin randomisations``: what is shipped, and where one's own go."""

from pathlib import Path

from scenes import (
    SpecError,
    list_experiments,
    list_objects,
    list_randomisations,
    list_sensors,
    load_experiment,
    load_object,
    load_randomisation,
    load_sensor,
    user_spec_dir,
)
from scenes.load import SHIPPED
from twin.cli import app


@app.command("sensors")
def sensors() -> None:
    """List the sensor specifications, and where to put one's own."""
    _list(list_sensors(), load_sensor, "sensors", lambda spec: f"{spec.pins.count} pins, {spec.camera.channels}")


@app.command("objects")
def objects() -> None:
    """List the object specifications, and where to put one's own."""
    _list(list_objects(), load_object, "objects", lambda spec: spec.shape.kind)
    print("Any STL, OBJ or PLY file (in mm) is an object too: --object part.stl")


@app.command("experiments")
def experiments() -> None:
    """List the experiments (which contacts are made, in the robot's coordinates), and where to put one's own."""
    _list(list_experiments(), load_experiment, "experiments", lambda spec: ", ".join(spec.targets))


@app.command("randomisations")
def randomisations() -> None:
    """List what can differ from one simulated frame to the next, and where to put one's own."""
    _list(list_randomisations(), load_randomisation, "randomisations", lambda spec: f"{len(spec.sensor)} numbers of the sensor")


def _list(found: dict[str, Path], load, kind: str, detail) -> None:
    for name, path in found.items():
        own = "" if path.is_relative_to(SHIPPED) else f"  [{path}]"
        try:
            spec = load(name)
        except SpecError as error:
            print(f"{name:16} BROKEN: {error}")
        else:
            print(f"{name:16} {spec.description} ({detail(spec)}){own}")
    print(f"\nShipped files: {SHIPPED / kind}")
    print(f"Your own: copy one to {user_spec_dir() / kind}/NAME.toml and edit it (or give a path: my.toml)")
