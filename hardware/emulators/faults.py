"""Faults of an emulated device, switched on by name: ``NAME`` or ``NAME=VALUE``."""

from difflib import get_close_matches

from scenes.files import shown
from twin.errors import TwinError


class Faults:
    """The faults that are switched on. They can be changed while the device runs.

    Parameters
    ----------
    known : dict of str to (float or None, str)
        Default value (None: a switch without a value) and effect of every fault.
    given : iterable of str
        ``NAME`` or ``NAME=VALUE``.

    Raises
    ------
    TwinError
        A fault is not known, or its value is not a number.
    """

    def __init__(self, known: dict[str, tuple[float | None, str]], given: tuple[str, ...] = ()) -> None:
        self.known = known
        self._on: dict[str, float] = {}
        for text in given:
            self.add(text)

    def add(self, text: str) -> None:
        name, _, value = text.partition("=")
        if name not in self.known:
            close = get_close_matches(name, self.known, n=1)
            raise TwinError(
                f"no fault '{shown(name)}'{f' (did you mean {close[0]}?)' if close else ''}; there are: {', '.join(self.known)}"
            )
        default = self.known[name][0]
        try:
            self._on[name] = float(value) if value else (1.0 if default is None else default)
        except ValueError as error:
            raise TwinError(f"fault '{text}': '{value}' is not a number; for example {name}={default or 1:g}") from error

    def clear(self) -> None:
        """Switch all faults off."""
        self._on.clear()

    def __contains__(self, name: str) -> bool:
        return self.value(name) is not None

    def value(self, name: str) -> float | None:
        """The fault's value, or None if it is off."""
        if name not in self.known:
            raise KeyError(name)
        return self._on.get(name)
