"""Lists of all specifications: shipped ones, and a user's own."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from scenes.base import SpecError
from scenes.load import (
    SHIPPED,
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

Spec = TypeVar("Spec", bound=BaseModel)


@dataclass(frozen=True)
class Entry:
    """One specification.

    Attributes
    ----------
    name : str
    path : Path
    description : str
        The specification's description and a detail of its kind. If it is ``broken``: the reason.
    broken : bool
        Whether the file can't be read.
    """

    name: str
    path: Path
    description: str
    broken: bool = False

    @property
    def own(self) -> bool:
        """Whether it is a user's own specification."""
        return not self.path.is_relative_to(SHIPPED)

    def line(self) -> str:
        """The entry as a line of text."""
        if self.broken:
            return f"{self.name:16} BROKEN: {self.description}"
        return f"{self.name:16} {self.description}{f'  [{self.path}]' if self.own else ''}"


@dataclass(frozen=True)
class Catalog:
    """All specifications of one kind; ``kind`` is also the name of their folders."""

    kind: str
    entries: list[Entry]

    def lines(self) -> list[str]:
        """The catalog as lines of text: each entry, the folder of the shipped files, and the folder for own files."""
        return [
            *(entry.line() for entry in self.entries),
            "",
            f"Shipped files: {SHIPPED / self.kind}",
            f"Your own: copy one to {user_spec_dir() / self.kind}/NAME.toml and edit it (or give a path: my.toml)",
        ]


def sensors() -> Catalog:
    """All sensors."""
    return _catalog("sensors", list_sensors(), load_sensor, lambda spec: f"{spec.pins.count} pins, {spec.camera.channels}")


def objects() -> Catalog:
    """All objects. Any STL, OBJ or PLY file can also be used as an object."""
    return _catalog("objects", list_objects(), load_object, lambda spec: spec.shape.kind)


def experiments() -> Catalog:
    """All experiments (contacts in the robot's coordinates)."""
    return _catalog("experiments", list_experiments(), load_experiment, lambda spec: ", ".join(spec.targets))


def randomisations() -> Catalog:
    """All randomisations (distributions of quantities that are sampled for each simulated contact)."""
    return _catalog("randomisations", list_randomisations(), load_randomisation, lambda spec: f"{len(spec.sensor)} numbers of the sensor")


def _catalog(kind: str, found: Mapping[str, Path], load: Callable[[str], Spec], detail: Callable[[Spec], str]) -> Catalog:
    return Catalog(kind, [_entry(name, path, load, detail) for name, path in found.items()])


def _entry(name: str, path: Path, load: Callable[[str], Spec], detail: Callable[[Spec], str]) -> Entry:
    try:
        spec = load(name)
    except SpecError as error:
        return Entry(name, path, str(error), broken=True)
    return Entry(name, path, f"{spec.description} ({detail(spec)})")  # type: ignore[attr-defined]  # every specification has one
