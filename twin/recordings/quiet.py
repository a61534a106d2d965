"""Silence for the libraries below OpenCV: they print their messages to the process's stderr, where no Python code can catch them."""

import contextlib
import os
import threading
from collections.abc import Iterator

# File descriptor of the process's stderr.
STDERR = 2
_lock = threading.Lock()
_inside = 0
_kept: int | None = None  # the real stderr while it is turned away

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET; read by OpenCV when it opens its first video


def _turn_away() -> None:
    global _inside, _kept
    with _lock:
        _inside += 1
        if _inside > 1:
            return
        try:
            _kept = os.dup(STDERR)
        except OSError:  # no stderr at all
            return
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, STDERR)
        os.close(nowhere)


def _turn_back() -> None:
    global _inside, _kept
    with _lock:
        _inside -= 1
        if _inside == 0 and _kept is not None:
            os.dup2(_kept, STDERR)
            os.close(_kept)
            _kept = None


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Drop what any thread prints to stderr inside. Use it for the length of one decoder call only."""
    _turn_away()
    try:
        yield
    finally:
        _turn_back()
