"""Frames from disk with the protocol of the live sources. They wait for their reader, and have an end."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from pathlib import Path

from hardware.errors import Connection
from scenes.sensor import SensorSpec
from twin.frames import Recording, open_recording
from twin.records.session import Session
from twin.types import Form, Frame


class SequentialSource(Connection):
    """Base class for folders, videos and sessions: their frames wait for their reader, and have an end.

    Parameters
    ----------
    name : str
    form : Form
    frames : iterable of Frame
        All frames from the first one, each time anew.
    """

    is_live = False
    first_frame_s = 0.0
    dropped = 0
    fault = ""
    streams = False  # frames come when they are read
    same_s = None

    def __init__(self, name: str, form: Form, frames: Iterable[Frame]) -> None:
        self.name, self.form, self._frames = name, form, frames
        self._left: Iterator[Frame] | None = None
        self._newest: Frame | None = None

    @abstractmethod
    def notes(self) -> list[str]:
        """Irregularities in the frames read so far, one line each."""

    def blind(self) -> str:
        return ""

    @property
    def is_connected(self) -> bool:
        return self._left is not None

    def connect(self) -> None:
        self._require_disconnected()
        self._left, self._newest = iter(self._frames), None

    def disconnect(self) -> None:
        self._left = None

    def read(self, *, timeout_s: float = 1.0) -> Frame:
        self._require_connected()
        frame = next(self._left or iter(()), None)
        if frame is None:
            raise EOFError(f"{self.name}: the recording is at its end")
        self._newest = frame
        return frame

    def read_latest(self, *, max_age_s: float = 0.5) -> Frame:
        """The frame that was read last, or the first one. A recording has no age."""
        return self.read() if self._newest is None or self._left is None else self._newest

    def read_after(self, time_s: float, *, timeout_s: float = 2.0) -> Frame:
        """The next frame, whatever its time is, because a recording waits for its reader."""
        return self.read()


class RecordedSource(SequentialSource):
    """A folder of pictures, a recording, a video.

    Parameters
    ----------
    path : path
    spec : SensorSpec, optional
    form : Form, optional
        Recognised by the frames' size and content if not given.
    """

    def __init__(self, path: str | Path, spec: SensorSpec | None = None, form: Form | None = None) -> None:
        self.recording: Recording = open_recording(path, spec, form)
        super().__init__(str(path), self.recording.form, self.recording)

    def notes(self) -> list[str]:
        return self.recording.notes()


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
        super().__init__(str(folder), self.session.form, self.session)

    def notes(self) -> list[str]:
        return self.session.notes
