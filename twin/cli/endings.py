"""How a command that moves an arm may be ended."""

from collections.abc import Iterator
from contextlib import contextmanager

from twin.cli import print_notes


@contextmanager
def arm_let_go() -> Iterator[None]:
    """SIGTERM and a closed terminal end the command as Ctrl-C does. What could not be let go of is printed."""
    from hardware.endings import signals_as_ctrl_c

    with signals_as_ctrl_c():
        try:
            yield
        except KeyboardInterrupt as interrupt:
            print_notes(interrupt)  # here, because typer ends without a word
            raise
