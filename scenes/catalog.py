"""Lists of all specifications: shipped ones, and a user's own."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes.base import SpecError
from scenes.load import SHIPPED, list_specifications, load_experiment, load_object, load_randomisation, load_sensor, user_spec_dir


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


# Of each kind: the function that loads a specification, and a detail of it that its line states.
KINDS: dict[str, tuple[Callable[[str], Any], Callable[[Any], str]]] = {
    "sensors": (load_sensor, lambda spec: f"{spec.pins.count} pins, {spec.camera.channels}"),
    "objects": (load_object, lambda spec: spec.shape.kind),
    "experiments": (load_experiment, lambda spec: ", ".join(spec.targets)),
    "randomisations": (load_randomisation, lambda spec: f"{len(spec.sensor)} numbers of the sensor"),
}


def list_all(kind: str) -> Catalog:
    """All specifications of a kind, which is one of ``KINDS``."""
    return Catalog(kind, [_entry(name, path, *KINDS[kind]) for name, path in list_specifications(kind).items()])


def _entry(name: str, path: Path, load: Callable[[str], Any], detail: Callable[[Any], str]) -> Entry:
    try:
        spec = load(name)
    except SpecError as error:
        return Entry(name, path, str(error), broken=True)
    return Entry(name, path, f"{spec.description} ({detail(spec)})")
