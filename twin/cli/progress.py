"""Progress bars on stderr."""

from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@contextmanager
def step_bar(title: str):
    """A bar for one piece of work; yields ``progress(fraction)``, with the fraction done in [0, 1]."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=None)
        yield lambda fraction: bar.update(task, total=1.0, completed=fraction)
        bar.update(task, total=1.0, completed=1.0)


@contextmanager
def count_bar(title: str):
    """A bar over items; yields ``progress(done, total)``."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, total=total, completed=done)


@contextmanager
def epoch_bar(title: str):
    """A bar over epochs with the error on held-out rows; yields ``progress(done, total, point)``."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=None)

        def progress(done: int, total: int, point: dict) -> None:
            bar.update(task, total=total, completed=done, description=f"{title} {point['held_out_error']:.4f}")

        yield progress
