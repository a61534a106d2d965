"""Signals that end the program as Ctrl-C does. This module imports nothing heavy, so that they are handled from the start."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn


def end_on_sigterm() -> None:
    """Make SIGTERM end this process as Ctrl-C does, with its own exit code. Forked processes end at once."""
    program = os.getpid()

    def end(number: int, _: object) -> None:
        if os.getpid() != program:
            os._exit(128 + number)
        raise KeyboardInterrupt(number)

    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, end)


def end_interrupted(interrupt: KeyboardInterrupt, print_notes: Callable[[KeyboardInterrupt], None] = lambda _: None) -> NoReturn:
    """End the program with one line, the notes of the interrupt, and 128 plus the signal's number as the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):  # a second one must not end the end
        signal.signal(number, signal.SIG_IGN)
    print("twin: interrupted", file=sys.stderr)
    print_notes(interrupt)
    sys.exit(128 + (interrupt.args[0] if interrupt.args else signal.SIGINT))


@contextmanager
def signals_as_ctrl_c() -> Iterator[None]:
    """Context in which SIGTERM and a closed terminal (SIGHUP) raise ``KeyboardInterrupt`` as Ctrl-C does.

    So the arm is stopped, withdrawn and disabled after these signals, too. In another thread than the main one it changes nothing. A
    signal that was ignored before (``nohup``) stays ignored. The former handlers are restored at the end.
    """

    def interrupt(number: int, _: object) -> None:
        raise KeyboardInterrupt(number)

    ending = (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM))  # Windows has no SIGHUP
    handled = ending if threading.current_thread() is threading.main_thread() else ()
    before = {ended: signal.getsignal(ended) for ended in handled}
    for ended, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(ended, interrupt)
    try:
        yield
    finally:
        for ended, handler in before.items():
            signal.signal(ended, handler)
