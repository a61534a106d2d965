"""How a command that moves an arm may be ended."""

import signal
from contextlib import contextmanager

from twin.cli import print_notes


@contextmanager
def signals_as_ctrl_c():
    """SIGTERM and a closed terminal end as Ctrl-C does: what is to be let go of is let go of. Only in the main thread."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {ended: signal.getsignal(ended) for ended in (signal.SIGTERM, signal.SIGHUP)}
    for ended, handler in before.items():
        if handler is not signal.SIG_IGN:  # nohup
            signal.signal(ended, interrupt)
    try:
        yield
    except KeyboardInterrupt as interrupt:
        print_notes(interrupt)  # here, for typer ends without a word
        raise
    finally:
        for ended, handler in before.items():
            signal.signal(ended, handler)
