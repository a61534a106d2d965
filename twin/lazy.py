"""Names that a module offers of other modules, and that are imported when they are first used."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from twin.errors import extras_named


def offered_name(places: Mapping[str, str], module: str, name: str) -> Any:
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


class WhenImported(MetaPathFinder):
    """Calls a function as soon as a module is imported: at once if it already is. The module itself is not imported for that.

    Parameters
    ----------
    module : str
    then : callable
    """

    def __init__(self, module: str, then: Callable[[], object]) -> None:
        self._module, self._then = module, then
        if module in sys.modules:
            then()
        else:
            sys.meta_path.insert(0, self)

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """The module's own specification, with a loader that calls the function at its end; None for other modules."""
        if name != self._module:
            return None
        others = (finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not self)
        spec = next(filter(None, others), None)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_call(module: ModuleType) -> None:
                load(module)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                    self._then()

            setattr(spec.loader, "exec_module", load_and_call)  # noqa: B010  a method is replaced
        return spec
