"""Progress on the command line: bars on a terminal, otherwise a line every ten seconds. All of it goes to stderr."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from typing import TextIO

from rich import progress
from rich.console import Console
from rich.text import Text

from twin.progress import Progress as Told

LINE_S = 10.0  # time between two lines without a terminal, s


class _CountColumn(progress.ProgressColumn):
    """Number done and total number of counted items; empty for a fraction, which the bar shows."""

    def render(self, task: progress.Task) -> Text:
        return Text(f"{task.completed:.0f}/{task.total:.0f}" if task.total is not None and task.total > 1 else "")


class _RateColumn(progress.ProgressColumn):
    """Items per second, or seconds per item if that is easier to read; empty for a fraction."""

    def render(self, task: progress.Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed or task.total is None or task.total <= 1:
            return Text("")
        return Text(f"{speed:.1f}/s" if speed >= 1 else f"{1 / speed:.1f} s each")


class Bars:
    """One bar for each stage. Call ``close`` at the end.

    Stages that run at the same time stand below each other. When all of them are done they stay on the screen as they are, and the next
    stage begins a new set.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._display: progress.Progress | None = None
        self._tasks: dict[str, progress.TaskID] = {}

    def __call__(self, stage: str, done: float, total: float, note: str = "") -> None:
        begins = stage not in self._tasks or (done == 0 and total == 0)
        if begins and self._display is not None and self._display.finished:
            self.close()
        if self._display is None:
            shown = progress.SpinnerColumn(), progress.TextColumn("{task.description}"), progress.BarColumn()
            times = progress.TimeElapsedColumn(), progress.TimeRemainingColumn()
            self._display = progress.Progress(*shown, _CountColumn(), _RateColumn(), *times, console=self._console)
            self._display.start()
        if stage not in self._tasks:
            self._tasks[stage] = self._display.add_task(stage, total=None)
        elif begins:  # the same title once more
            self._display.reset(self._tasks[stage], total=None)
        title = f"{stage} {note}" if note else stage
        self._display.update(self._tasks[stage], total=total or None, completed=done, description=title)

    def close(self) -> None:
        """Leave the bars as they are."""
        if self._display is not None:
            self._display.stop()
        self._display, self._tasks = None, {}


class Lines:
    """A line of text for each stage, and for each tenth of it, for log files and pipes; at most one every ``every_s`` seconds.

    Work that ends sooner says nothing, and no line comes twice. Within its context a line is also printed where nothing is reported for so
    long, so a log shows what the program is doing.

    Parameters
    ----------
    out : TextIO
    every_s : float
    clock : callable
        Tells the time in seconds.
    """

    def __init__(self, out: TextIO, *, every_s: float = LINE_S, clock: Callable[[], float] = time.monotonic) -> None:
        self._out, self._every_s, self._clock = out, every_s, clock
        self._last_s = clock()
        self._line, self._part, self._told = "at work", ("", 0), ("", -1)
        self._turn = threading.Lock()
        self._over = threading.Event()

    def __call__(self, stage: str, done: float, total: float, note: str = "") -> None:
        far = "" if total <= 0 else f" {done:.0%}" if total <= 1 else f" {done:.0f} of {total:.0f}"
        self._part = stage, int(10 * done / total) if total > 0 else -1
        self._line = f"{stage}:{far or ' begun'}{f', {note}' if note else ''}"
        self._print_if_due()

    def _print_if_due(self) -> None:
        """Print how far the work is if the last line is old and of another part."""
        with self._turn:
            if (now_s := self._clock()) - self._last_s >= self._every_s:
                self._last_s = now_s
                if self._part != self._told:
                    self._told = self._part
                    print(self._line, file=self._out, flush=True)

    def _watch(self) -> None:
        while not self._over.wait(self._every_s / 10):
            self._print_if_due()

    def __enter__(self) -> "Lines":
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._watcher.join()


GOES_ON = "what is finished is kept; the same command resumes from there"
"""Note of an interrupted command that does."""


@contextmanager
def show_progress(*, goes_on: bool = False) -> Iterator[Told]:
    """The ``Progress`` of a command: bars where stderr is a terminal, else lines.

    ``goes_on``: the same command continues interrupted work, and Ctrl-C says so.
    """
    console = Console(stderr=True)
    shown: AbstractContextManager[Told] = closing(Bars(console)) if console.is_terminal else Lines(sys.stderr)
    try:
        with shown as told:
            yield told
    except KeyboardInterrupt as interrupt:
        if goes_on:
            interrupt.add_note(GOES_ON)
        raise
