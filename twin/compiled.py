"""Numba's compiler, as the whole program uses it: what is compiled is kept on disk where that is possible, and works where it is not."""

from collections.abc import Callable
from typing import Any

import numba

from twin.errors import warn_once


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator that compiles a function at its first call, and keeps the machine code on disk for later processes.

    Numba keeps it beside the source, or else in the user's home. Where neither can be written, or the disk is full, one warning in a
    process says so.

    Parameters
    ----------
    options
        Those of ``numba.njit``, without ``cache``.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            dispatcher = numba.njit(cache=True, **options)(function)
        except RuntimeError as error:
            if "cannot cache function" not in str(error):
                raise
            _warn("no folder for them can be written")
            return numba.njit(**options)(function)
        kept = dispatcher._cache  # numba has no public way to go on where it can't save
        save = kept.save_overload

        def save_if_possible(signature: object, data: object) -> None:
            try:
                save(signature, data)
            except OSError as error:
                _warn(f"{kept.cache_path}: {error.strerror or error}")

        kept.save_overload = save_if_possible
        return dispatcher

    return decorate


def _warn(why: str) -> None:
    remedy = "set NUMBA_CACHE_DIR to a folder that can be written"
    warn_once(f"compiled functions can't be kept ({why}), so every start compiles them again; {remedy}")
