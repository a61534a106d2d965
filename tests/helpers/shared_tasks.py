"""Tasks of processes that share work: each process imports them alone, without the tests."""

import os
import signal
import time
import warnings
from pathlib import Path

from twin.errors import FrameError


def named(prefix):
    """Begins with a text; each call gives its task and process."""
    return lambda task: (f"{prefix}{task}", os.getpid())


def failing(where):
    """Fails at the beginning or at a task."""

    def fail(*_):
        raise FrameError(where)

    return fail() if where == "begin" else fail


def warning():
    """Warns at every task."""

    def warn(task):
        warnings.warn("the disk is slow", RuntimeWarning, stacklevel=1)
        return os.getpid()

    return warn


def dying(folder, always=""):
    """The first call of every task ends its process; of the task ``always`` each call."""

    def die(task):
        mark = Path(folder, str(task))
        if task == always or not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return task

    return die


def sleeping(folder):
    """Sleeps for longer than any test, and says so."""
    Path(folder, "begun").touch()

    def sleep(task):
        Path(folder, f"at work {os.getpid()}").touch()
        time.sleep(600)

    return sleep


def blocked():
    """Each call gives the signals that its process blocks."""
    return lambda task: signal.pthread_sigmask(signal.SIG_BLOCK, [])
