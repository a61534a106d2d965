"""Shared libraries that Dr.Jit needs and its wheel does not bring."""

import ctypes
import sys
from pathlib import Path

PRIVATE_FOLDER = Path(sys.prefix) / "lib" / "private"
"""Where 'make setup' puts its own copies of libraries if it may not install them."""
REMEDY = "install it (Debian, Ubuntu: apt-get install libatomic1)"


def load_needed_libraries(folder: Path = PRIVATE_FOLDER) -> str:
    """Load libatomic, the system's or else the private copy in ``folder``, so that Dr.Jit finds it.

    Returns
    -------
    str
        "" if it is there, else what is missing and the remedy.
    """
    if not sys.platform.startswith("linux"):
        return ""
    for library in ("libatomic.so.1", str(folder / "libatomic.so.1")):
        try:
            ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
            return ""
        except OSError:
            continue
    return f"libatomic.so.1 is missing, which Mitsuba needs: {REMEDY}"
