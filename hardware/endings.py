"""How work that moves an arm may be ended from outside."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def signals_as_ctrl_c() -> Iterator[None]:
    """SIGTERM and a closed terminal (SIGHUP) raise ``KeyboardInterrupt``, as Ctrl-C does, so that the arm is let go of.

    For the main thread only. A signal that is ignored outside (``nohup``) stays ignored. The handlers of before are put back at the end.
    """

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {ended: signal.getsignal(ended) for ended in (signal.SIGTERM, signal.SIGHUP)}
    for ended, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(ended, interrupt)
    try:
        yield
    finally:
        for ended, handler in before.items():
            signal.signal(ended, handler)
