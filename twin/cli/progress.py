"""Progress bars on stderr."""

from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text


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


class _RateColumn(ProgressColumn):
    """Items a second, or seconds an item where that reads better."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("")
        return Text(f"{speed:.1f}/s" if speed >= 1 else f"{1 / speed:.1f} s each")


@contextmanager
def rate_bar(title: str):
    """As ``count_bar``, with the rate; the first call says what was there before, which does not count towards it."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        tasks = []

        def progress(done: int, total: int) -> None:
            if not tasks:
                tasks.append(bar.add_task(title, total=total, completed=done))
            bar.update(tasks[0], total=total, completed=done)

        yield progress


@contextmanager
def epoch_bar(title: str):
    """A bar over epochs with the error on held-out rows; yields ``progress(done, total, point)``."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=None)

        def progress(done: int, total: int, point: dict) -> None:
            bar.update(task, total=total, completed=done, description=f"{title} {point['held_out_error']:.4f}")

        yield progress
