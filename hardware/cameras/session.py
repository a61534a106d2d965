"""A recorded session with the protocol of the live sources."""

from collections.abc import Iterator
from pathlib import Path

from hardware.cameras.recorded import SequentialSource
from twin.records.session import Session
from twin.types import Frame


class SessionSource(SequentialSource):
    """A session's frames in the order of its steps. A frame that several steps used is given once for each.

    Parameters
    ----------
    folder : path

    Raises
    ------
    FrameError
        As for ``twin.records.session.Session``.
    """

    def __init__(self, folder: str | Path) -> None:
        self.session = Session(folder)
        super().__init__(str(folder), self.session.form)

    @property
    def steps(self) -> list[dict]:
        """The session's complete steps."""
        return self.session.steps

    @property
    def rest(self) -> Frame | None:
        """The no-contact frame from which the pins' displacements were computed."""
        return self.session.rest

    def notes(self) -> list[str]:
        return self.session.notes

    def _frames(self) -> Iterator[Frame]:
        return (self.session.frame(index) for index in range(len(self.session.steps)))
