"""What a command prints of a result, on stdout."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol


class Result(Protocol):
    """What a function that does a command's work returns."""

    @property
    def written(self) -> Sequence[Path]:
        """The files that it wrote."""

    def lines(self) -> Iterable[str]:
        """What it found, for people."""


def say(lines: Iterable[str]) -> None:
    """Print lines, each as soon as it is there."""
    for line in lines:
        print(line, flush=True)


def tell(result: Result) -> None:
    """Print what was found and where it was written."""
    say(result.lines())
    say(f"wrote {path}" for path in result.written)
