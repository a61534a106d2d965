"""Letting go of a device: every step is tried, whatever became of the others."""

import sys
from collections.abc import Callable


def try_each(**steps: Callable[[], object]) -> list[str]:
    """Call each step; a second Ctrl-C ends the step that it meets, not those after it.

    Returns
    -------
    list of str
        What failed. It is also noted on the exception that is on its way, if there is one, and printed with it.
    """
    on_its_way, failed, interrupt = sys.exc_info()[1], [], None
    for name, act in steps.items():
        try:
            act()
        except Exception as error:
            failed.append(f"{name} failed: {error}")
            if on_its_way is not None:
                on_its_way.add_note(failed[-1])
        except BaseException as error:
            failed.append(f"{name} was interrupted")
            interrupt = error
    if interrupt is not None:
        raise interrupt
    return failed
