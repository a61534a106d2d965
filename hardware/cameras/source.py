"""The protocol of all cameras: ``FrameSource``, a source of frames. Times are ``time.monotonic()`` seconds."""

from contextlib import AbstractContextManager
from types import TracebackType
from typing import Protocol

from hardware.errors import DeviceError
from twin.errors import ErrorsAs
from twin.types import Form, Frame


class FrameSource(Protocol):
    """A live camera, a stream, a recording or the twin.

    A background reader keeps the newest frame. ``Frame.time_s`` is the time of the exposure as far as it is known: the kernel's buffer
    time, or the time of arrival. ``Frame.sequence`` counts the device's frames; it includes lost frames if the device reports them. Every
    read raises ``DeviceError`` if the pictures of a live source are frozen, black or late, or if its reader has ended after too many
    failed reads.
    """

    name: str
    form: Form
    is_live: bool  # a recording waits for its reader, a live source does not
    streams: bool  # whether frames come unasked: not from a recording, nor from a twin that draws on demand

    @property
    def first_frame_s(self) -> float:
        """Longest time from ``connect`` to the first frame."""

    @property
    def is_connected(self) -> bool:
        """Whether frames can be read."""

    @property
    def dropped(self) -> int:
        """Number of frames that nobody read, including those that the device lost."""

    @property
    def fault(self) -> str:
        """What is wrong with the pictures ("" if nothing)."""

    @property
    def same_s(self) -> tuple[float, float] | None:
        """Exposures (s) of the first and the newest of several equal pictures; None if the picture changes, or could not stay equal."""

    def blind(self) -> str:
        """Reason why there is no fresh frame; "" if there is one. A fresh frame is new, usable, and at most 3 periods or 0.2 s old."""

    def notes(self) -> list[str]:
        """What was irregular in the frames so far, one line each: pauses, damaged, repeated and unreadable frames."""

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def __enter__(self) -> "FrameSource": ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None: ...

    def read(self, *, timeout_s: float = 1.0) -> Frame:
        """The newest frame that was not read yet. Waits for one if necessary; ``TimeoutError`` if none comes.

        Raises
        ------
        EOFError
            A recording is at its end.
        """

    def read_latest(self, *, max_age_s: float = 0.5) -> Frame:
        """The newest frame, even if it was read before; ``StaleDataError`` if it is older than ``max_age_s``."""

    def read_after(self, time_s: float, *, timeout_s: float = 2.0) -> Frame:
        """The first frame that was exposed after ``time_s``; ``TimeoutError`` if none comes."""


def no_frame() -> AbstractContextManager[None]:
    """Context that converts the errors of a camera that gives no frame to a ``DeviceError`` with the remedy."""
    return ErrorsAs((TimeoutError, EOFError), lambda error: DeviceError(f"{error}; check the camera"))


def await_frame(source: FrameSource, *, timeout_s: float | None = None, after_s: float | None = None) -> Frame:
    """The next frame, or the first one that was exposed after ``after_s``. By default the wait lasts at most ``first_frame_s``.

    Raises
    ------
    DeviceError
        No frame comes.
    """
    timeout_s = source.first_frame_s if timeout_s is None else timeout_s
    with no_frame():
        return source.read(timeout_s=timeout_s) if after_s is None else source.read_after(after_s, timeout_s=timeout_s)
