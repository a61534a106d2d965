"""Names that a module offers of other modules, and that are imported when they are first used."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from twin.errors import extras_named


def named(places: Mapping[str, str], module: str, name: str) -> Any:
    """What a module offers under a name: the work of its ``__getattr__``.

    Parameters
    ----------
    places : mapping of str to str
        By name, the module that holds it; ``MODULE:OTHER`` if it has another name there.
    module, name : str

    Raises
    ------
    AttributeError
        The module does not offer this name.
    ExtraError
        A library that it needs is not installed.
    """
    if name not in places:
        raise AttributeError(f"'{module}' has no name '{name}'; help({module}) lists its names")
    place, _, other = places[name].partition(":")
    with extras_named():
        return getattr(import_module(place), other or name)
