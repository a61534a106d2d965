"""Parts of other packages, which offer them by entry points ``tactip_twin.KIND``.

A sensor, object, experiment, randomisation, servo or limits is the path of a TOML file. An arm is a function of the text after the colon in
``NAME:REST``, and a camera a function of this text, the sensor and the form. A world, in which an arm carries a sensor, is a function of
this text, the sensor and its pose on the tool (``hardware.cameras.twin.World``). A gripper is a function of this text and the sensor
(``hardware.servo.grip.Gripper``). A policy is a function of an observation of its environment, which gives the action. A layout,
material, condition, model or task is the object itself. A part that raises, that is of another kind or that has the name of another one is
left out, and a warning names it.
"""

import os
import sys
import warnings
from collections.abc import Callable, Container
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from inspect import isabstract
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

KINDS = (
    *("sensors", "objects", "experiments", "randomisations", "servos", "limits"),
    *("layouts", "materials", "arms", "grippers", "cameras", "worlds", "conditions", "models", "tasks", "policies"),
)
_found: dict[str, dict[str, Any]] = {}  # the parts of each kind, by name
_judged: dict[EntryPoint, str] = {}  # of each entry point that was looked at: why its part is left out, "" if it is not


def others(kind: str, own: Container[str] = (), *, is_one: Callable[[Any], bool] = callable) -> dict[str, Any]:
    """The parts of a kind that other packages offer, by name.

    Parameters
    ----------
    kind : str
        One of ``KINDS``.
    own : container of str
        Names that are taken.
    is_one : callable
        Whether an object is a part of this kind.
    """
    found = _found.setdefault(kind, {})
    for entry in _entries(kind):
        begun = getattr(getattr(sys.modules.get(entry.module), "__spec__", None), "_initializing", False)
        if entry in _judged or begun:  # a package that is being imported asks for a part of ours; the next call finds its own
            continue
        part, why = _load_part(entry)
        if entry.name in own or entry.name in found:
            why = f"there is another '{entry.name}'"
        elif not why and not is_one(part):
            why = f"{part!r} is none"
        _judged[entry] = why
        if why:
            warnings.warn(f"{kind} of {_package(entry)}: '{entry.name}' is left out ({why})", RuntimeWarning, stacklevel=2)
        else:
            found[entry.name] = part
    return found


def offered(kind: str) -> tuple[str, ...]:
    """Names of the parts of a kind that other packages offer; nothing is loaded."""
    return tuple(entry.name for entry in _entries(kind))


def classes(kind: str, base: type) -> dict[str, type]:
    """The classes of a kind below ``base``, by name: those in the modules of ``scenes.KIND``, and those of other packages; as `others`.

    The name of ours is its module's.
    """
    own = _own_classes(kind, base)
    return own | others(kind, own, is_one=lambda part: isinstance(part, type) and issubclass(part, base) and not isabstract(part))


@cache
def _own_classes(kind: str, base: type) -> dict[str, type]:
    found: dict[str, type] = {}
    for module in iter_modules(import_module(f"scenes.{kind}").__path__):
        names = vars(import_module(f"scenes.{kind}.{module.name}"))
        own = [part for part in names.values() if isinstance(part, type) and issubclass(part, base) and not isabstract(part)]
        found |= {module.name.replace("_", "-"): part for part in own if part.__module__ == names["__name__"]}
    return found


def _load_part(entry: EntryPoint) -> tuple[Any, str]:
    """A part, and why it can't be loaded."""
    try:
        return entry.load(), ""
    except (Exception, SystemExit) as error:
        return None, f"{type(error).__name__}: {error}"


def other_files(kind: str, own: Container[str]) -> dict[str, Path]:
    """The files of a kind that other packages offer, by name; as `others`."""
    files = others(kind, own, is_one=lambda part: isinstance(part, str | os.PathLike) and os.path.isfile(part))
    return {name: Path(path) for name, path in files.items()}


def plugin_lines() -> list[str]:
    """A line for each part that another package offers: its kind, name and package, and why it is left out if it is."""
    lines = []
    for kind in KINDS:
        for entry in (each for each in _entries(kind) if not (each.dist and each.dist.name == "tactip-twin")):
            why = _judged[entry] if entry in _judged else _load_part(entry)[1]
            lines.append(f"{kind}: {entry.name} of {_package(entry)}{f'; LEFT OUT: {why}' if why else ''}")
    return lines


@cache
def _entries(kind: str) -> tuple[EntryPoint, ...]:
    return tuple(sorted(entry_points(group=f"tactip_twin.{kind}"), key=lambda entry: (entry.name, _package(entry))))


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
