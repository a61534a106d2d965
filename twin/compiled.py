"""Compilation with Numba. The machine code is stored on disk for later processes, if the disk can be written."""

import atexit
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from inspect import isgeneratorfunction
from pathlib import Path
from typing import Any

import numba

from twin.errors import warn_once


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator that compiles a function at its first call, and stores the machine code on disk for later processes.

    Numba stores it beside the source, or else in the user's home. If neither folder can be written, or if the disk is full, the process
    gives one warning.

    Write numbers one by one where that is short (``a[0] = b[0]``): for an assignment of arrays Numba also compiles the text of the error
    for wrong shapes, which takes some seconds. Hand arrays over in one memory layout: each layout is compiled for itself.

    Parameters
    ----------
    options
        Options of ``numba.njit``, except ``cache``.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        # of a generator that was stored by another process, Numba can't compile a caller; code in C calls none
        chosen: dict[str, Any] = {"cache": not isgeneratorfunction(function), "no_cfunc_wrapper": True} | options
        try:
            dispatcher = numba.njit(**chosen)(function)
        except RuntimeError as error:
            if "cannot cache function" not in str(error):
                raise
            _warn("no folder for them can be written")
            return numba.njit(**chosen | {"cache": False})(function)
        kept = dispatcher._cache  # numba has no public way to continue if it can't save
        save = kept.save_overload

        def save_if_possible(signature: object, data: object) -> None:
            try:
                save(signature, data)
            except OSError as error:
                _warn(f"{kept.cache_path}: {error.strerror or error}")

        kept.save_overload = save_if_possible
        return dispatcher

    return decorate


@cache
def begin_compiling(module: str, mark: Any) -> None:
    """Run a module that compiles what is soon needed, in a process of its own, unless the machine code of ``mark`` is stored on disk.

    The process ends with this one at the latest.

    Parameters
    ----------
    module : str
    mark : compiled function
        One of the functions that the module compiles.
    """
    folder = mark.stats.cache_path
    if folder is None or any(Path(folder).glob(f"*.{mark.__name__}-*.nbi")):
        return
    child = subprocess.Popen([sys.executable, "-m", module], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def end() -> None:
        child.kill()
        child.wait()

    atexit.register(end)


def _warn(why: str) -> None:
    remedy = "set NUMBA_CACHE_DIR to a folder that can be written"
    warn_once(f"compiled functions can't be kept ({why}), so every start compiles them again; {remedy}")
