"""A Dobot Magician emulated on this machine, over a real pseudo-terminal."""

import contextlib
import logging
import os
import random
import select
import time
from pathlib import Path
from threading import Event, Lock, Thread

from hardware.arms.magician import Message, take_message
from hardware.emulators.faults import EVERY_NTH, SECONDS, SHARE, EmulatedArm, Fault, Range
from hardware.emulators.magician_controller import EmulatedController
from hardware.errors import on_error
from twin.errors import ErrorsAs, TwinError

LOG = logging.getLogger(__name__)
SPLIT_AT = 4
NO_TERMINALS = "this system has no pseudo-terminals; emulate an MG400, or emulate the Magician on Linux, macOS or in WSL"
FAULTS = {
    "noise": Fault("this many random bytes come before each reply", 5.0, Range(1, 1000, whole=True)),
    "split-frames": Fault("replies come in two pieces, this many seconds apart", 0.02, SECONDS),
    "wrong-checksum": Fault("every n-th reply has a wrong checksum", 3.0, EVERY_NTH),
    "lost-reply": Fault("every n-th reply never comes", 3.0, EVERY_NTH),
    "mute": Fault("no reply ever comes"),
    "unplugged": Fault("the cable is pulled, this many seconds after the start", 5.0, SECONDS),
    "lost-steps": Fault("each move stops with an alarm after this share of its time", 0.5, SHARE),
    "stall": Fault("each move stops after this share of its time, and its command never ends", 0.5, SHARE),
    "ignore-moves": Fault("moves are accepted and not executed"),
    "slow": Fault("moves at this share of the speed", 0.1, SHARE),
    "wide-queue-space": Fault("the queue's space is reported in 8 bytes instead of 4"),
}


class MagicianEmulator(EmulatedArm):
    """A Magician on a pseudo-terminal. A context manager, which works between ``start`` and ``stop``.

    Parameters
    ----------
    link : Path or None
        Symbolic link to the terminal. It is removed at the end. A link that leads nowhere is replaced.
    faults : iterable of str
        ``NAME`` or ``NAME=VALUE`` of ``FAULTS``; ``faults`` can be changed while it runs.
    time_scale : float
        Factor by which it moves faster than the real arm.

    Attributes
    ----------
    device : str
        The terminal that a client opens.
    """

    def __init__(self, *, link: Path | None = None, faults: tuple[str, ...] = (), time_scale: float = 1.0) -> None:
        super().__init__(FAULTS, faults, time_scale)
        self.arm = EmulatedController(self.faults, time_scale=time_scale)
        self.device = ""
        self._link = link
        self._ends: tuple[int, int] | None = None  # file descriptors: our end, the client's end
        self._lock, self._ended = Lock(), Event()
        self._thread: Thread | None = None
        self._noise, self._replies = random.Random(0), 0

    def start(self) -> None:
        """Make the terminal.

        Raises
        ------
        TwinError
            The link can't be made, or the system has no pseudo-terminals.
        """
        with ErrorsAs(ImportError, lambda error: TwinError(NO_TERMINALS)):
            import pty
            import tty
        self._ends = pty.openpty()
        tty.setraw(self._ends[1])
        self.device = os.ttyname(self._ends[1])
        if self._link is not None:
            remedy = "remove it or give another `link`"
            refused = ErrorsAs(OSError, lambda error: TwinError(f"{self._link}: can't make the link ({error.strerror}); {remedy}"))
            with on_error(self.unplug), refused:
                if self._link.is_symlink() and (not self._link.exists() or os.readlink(self._link) == self.device):
                    self._link.unlink()  # left by an emulator that was killed
                self._link.symlink_to(self.device)
        self._thread = Thread(target=self._serve, daemon=True, name="magician-emulator")
        self._thread.start()
        self.place = f"magician {self._link or self.device}"
        self.faults.after("unplugged", self.unplug)

    def stop(self) -> None:
        self.unplug()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def unplug(self) -> None:
        """Pull the cable: the terminal vanishes. The arm still executes its queue."""
        self._ended.set()
        with self._lock:
            for end in self._ends or ():
                with contextlib.suppress(OSError):
                    os.close(end)
            self._ends = None
            if self._link is not None and self._link.is_symlink():
                self._link.unlink()

    def _serve(self) -> None:
        import termios

        buffer = b""
        while not self._ended.is_set():
            with self._lock:
                if self._ends is None:
                    return
                ready, _, _ = select.select([self._ends[0]], [], [], 0.0)
                data = os.read(self._ends[0], 4096) if ready else b""
                if data and termios.tcgetattr(self._ends[1])[4] != termios.B115200:
                    data = b""  # at a wrong baud rate only noise arrives
            if not data:
                time.sleep(0.001)
                continue
            message, buffer = take_message(buffer + data)
            while message is not None:
                self._send(self._answer(message).to_bytes())
                message, buffer = take_message(buffer)

    def _answer(self, message: Message) -> Message:
        """The controller's reply. A command that fails in the emulator raises the alarm of a command that is not understood."""
        try:
            return self.arm.answer(message)
        except Exception:
            LOG.exception("emulated Magician: command %d failed", message.id)
            return self.arm.refuse(message)

    def _send(self, frame: bytes) -> None:
        self._replies += 1
        if "mute" in self.faults or self.faults.every("lost-reply", self._replies):
            return
        if self.faults.every("wrong-checksum", self._replies):
            frame = frame[:-1] + bytes([frame[-1] ^ 0xFF])
        if (count := self.faults.value("noise")) is not None:
            frame = self._noise.randbytes(int(count)) + frame
        pause_s = self.faults.value("split-frames")
        pieces = [frame] if pause_s is None else [frame[:SPLIT_AT], frame[SPLIT_AT:]]
        for n, piece in enumerate(pieces):
            if n and pause_s is not None:
                time.sleep(pause_s)
            with self._lock, contextlib.suppress(OSError):
                if self._ends is not None:
                    os.write(self._ends[0], piece)
