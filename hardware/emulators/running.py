"""Running an emulator until somebody ends it."""

import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

CHECK_S = 0.5  # between two looks at whether the emulator failed


def run_until_told(
    device: AbstractContextManager[Any],
    ready: Callable[[], str],
    failure: Callable[[], Exception | None] = lambda: None,
    *,
    on_ready: Callable[[str], None] | None = None,
) -> None:
    """Run a device until SIGTERM or Ctrl-C, or until it fails. Only in the main thread.

    Parameters
    ----------
    device : context manager
        Listens while it is entered.
    ready : callable
        Tells what listens, and where, once it does.
    failure : callable
        Tells what the device ended with, or None while it runs. That error is raised.
    on_ready : callable, optional
        Called once with what ``ready`` tells; by default it is printed.
    """
    ends = {signal.SIGTERM, signal.SIGINT}
    told: list[bool] = []
    handlers = {end: signal.signal(end, lambda *_: told.append(True)) for end in ends}  # libraries' threads get signals, too
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # waited for: nothing is ever interrupted halfway
    try:
        with device:
            text = f"ready {ready()}"
            if on_ready is not None:
                on_ready(text)
            else:
                print(text, flush=True)
            while not told and signal.sigtimedwait(ends, CHECK_S) is None:
                if (error := failure()) is not None:
                    raise error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for end, handler in handlers.items():
            signal.signal(end, handler)


def fault_lines(known: dict[str, tuple[float | None, str]]) -> list[str]:
    """The faults that an emulator knows, with their default values and what they do, for people."""
    return [f"{name + ('' if default is None else f'={default:g}'):22} {meaning}" for name, (default, meaning) in known.items()]
