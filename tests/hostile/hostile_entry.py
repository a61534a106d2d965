"""One hostile call as data, and how it must end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from hostile_inputs import RAW_SENSOR, SENSOR, Maker
from hostile_known import KNOWN

REFUSED, USAGE, DONE = 1, 2, 0  # exit codes
BAD_SENSOR = 3  # of 'twin check'
ANY = (DONE, REFUSED)


@dataclass(frozen=True)
class Entry:
    """One hostile call.

    Attributes
    ----------
    kind, what : str
        Of the input.
    call : str
        The command's words and options.
    make : dict of str to Maker
        Makers of the inputs that are named in ``call``.
    exit : tuple of int
        Exit codes that are right.
    says : tuple of str
        Words that the call must print, on stdout or stderr.
    leaves : tuple of str
        Files that a call that fails may leave in ``out``.
    first : str
        A harmless call that is made before, in the same folder.
    then : dict of str to function of a path
        What becomes of its inputs after it.
    fresh : bool
        Where it is done, stdout must be that of the same call with an ``out`` of its own.
    same : bool
        Where it is done, stdout must be that of the same call with the harmless inputs.
    seconds : float
        Within which it ends on an idle machine.
    gibibytes : float
        Of memory, at most.
    file_bytes : int
        No file may become larger: a full disk.
    end : (float, int, int)
        After so many seconds it is sent this signal, counted from when it consists of so many processes.
    env : dict of str to str
        Environment of a Python that is started again for this call.
    sample : bool
        Part of the quick tests.
    """

    kind: str
    what: str
    call: str
    make: dict[str, Maker] = field(default_factory=dict)
    exit: tuple[int, ...] = (REFUSED,)
    says: tuple[str, ...] = ()
    leaves: tuple[str, ...] = ()
    first: str = ""
    then: dict[str, Callable[[Path], object]] = field(default_factory=dict)
    fresh: bool = False
    same: bool = False
    seconds: float = 20.0
    gibibytes: float = 3.0
    file_bytes: int = 1 << 30
    end: tuple[float, int, int] = (0.0, 0, 1)
    env: dict[str, str] = field(default_factory=dict)
    sample: bool = False

    @property
    def command(self) -> str:
        """The command's name, as ``calibrate optics``."""
        words = self.call.split()
        return " ".join(words[:2]) if words[0] in GROUPS else words[0]

    @property
    def name(self) -> str:
        """Unique in the catalogue."""
        return f"{self.command}, {self.kind}: {self.what}"

    @property
    def known(self) -> str:
        """What is wrong with it now; "" if nothing is."""
        return KNOWN.get(self.name, "")


GROUPS = ("calibrate", "emulate", "study")
S, U = f"--sensor {SENSOR}", f"--sensor {RAW_SENSOR}"
