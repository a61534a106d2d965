"""Progress reports of functions that take long, with one protocol for all of them.

Such a function has a keyword option ``progress``, a ``Progress``. Its work has stages, each with a title, and it calls
``progress(stage, done, total, note)`` during each stage. The command line draws bars from these calls. A program may give a function of
its own; by default nothing is reported (``silent``).

A function that is one stage of a larger work does not know its title. It takes a ``Step`` instead: ``step(done, total)``. The caller
makes the ``Step`` from its own ``progress`` with ``stage``.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Called during long work."""

    def __call__(self, stage: str, done: float, total: float, note: str = "") -> None:
        """Receive the progress of a stage.

        Parameters
        ----------
        stage : str
            The stage's title. The first call with a title begins the stage.
        done : float
            Finished work, in the stage's own unit: contacts, frames, epochs. The first value counts what was finished before.
        total : float
            All work, in the same unit. 0 means that it is not known yet; 1 means that ``done`` is a fraction.
        note : str
            A remark on the work at this point, such as the present error of a training; "" for none.
        """


class Step(Protocol):
    """Called during one stage. The arguments are those of ``Progress`` without the title."""

    def __call__(self, done: float, total: float = 1.0, note: str = "") -> None: ...


Bar = Callable[[str], AbstractContextManager[Step]]
"""``bar(title)`` is a context manager around one stage of work, which yields that stage's ``Step`` (see ``stage``)."""


def silent(stage: str, done: float, total: float, note: str = "") -> None:
    """The ``Progress`` that reports nothing."""


def unheard(done: float, total: float = 1.0, note: str = "") -> None:
    """The ``Step`` that reports nothing."""


def report_each(items: Sequence[Item], progress: Step) -> Iterator[Item]:
    """Each item; after the work on it, ``progress`` is told the number of finished ones."""
    for done, item in enumerate(items, 1):
        yield item
        progress(done, len(items))


@contextmanager
def stage(progress: Progress, title: str) -> Iterator[Step]:
    """Context of one stage: yields the ``Step`` that reports its progress.

    The stage begins with a total of 0. If it ends without an error and nothing was reported, it counts as one finished item.
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
