"""How long work tells how far it is: one protocol for all of it.

A function that takes long has a keyword option ``progress``, a ``Progress``. Its work has stages, each with a title, and it calls
``progress(stage, done, total, note)`` as each of them goes on. The command line draws bars from these calls; a program gives a function
of its own, or nothing (``silent``).

A function that is one stage of something larger does not know its title. It takes a ``Step`` instead: ``step(done, total)``. The caller
makes one from its own ``progress`` with ``stage``.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Progress(Protocol):
    """Called as work goes on."""

    def __call__(self, stage: str, done: float, total: float, note: str = "") -> None:
        """Take notice of how far a stage is.

        Parameters
        ----------
        stage : str
            The stage's title. The first call with a title begins the stage.
        done : float
            What is done, in the stage's own unit: contacts, frames, epochs. The first value counts what was there before.
        total : float
            What there is to do, in the same unit. 0 means that it is not known yet; 1 means that ``done`` is a fraction.
        note : str
            What can be said of the work at this point, such as the present error of a training; "" for nothing.
        """


class Step(Protocol):
    """Called as one stage goes on; arguments as those of ``Progress``."""

    def __call__(self, done: float, total: float = 1.0, note: str = "") -> None: ...


Bar = Callable[[str], AbstractContextManager[Step]]
"""``bar(title)`` is a context manager around one stage of work, which yields that stage's ``Step`` (see ``stage``)."""


def silent(stage: str, done: float, total: float, note: str = "") -> None:
    """The ``Progress`` of who does not want to know."""


@contextmanager
def stage(progress: Progress, title: str) -> Iterator[Step]:
    """One stage of some work: yields the ``Step`` that tells how far it is.

    It begins with a total of 0. If nothing was told of it when it ends without an error, it counts as one thing that is done.
    """
    told = False

    def step(done: float, total: float = 1.0, note: str = "") -> None:
        nonlocal told
        told = told or total > 0
        progress(title, done, total, note)

    progress(title, 0, 0)
    yield step
    if not told:
        progress(title, 1, 1)
