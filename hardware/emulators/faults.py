"""What all emulated devices have: faults, switched on by name (``NAME`` or ``NAME=VALUE``), a start, an end, a run, and ports."""

import contextlib
import socket
import socketserver
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from threading import Thread, Timer
from typing import Any, Self

import numpy as np

from hardware.errors import DeviceError, on_error
from scenes.files import quote
from twin.errors import ErrorsAs, TwinError
from twin.signals import signals_as_ctrl_c

SLOWEST, FASTEST = 1e-3, 1e3  # limits of the time scale: beyond them a move takes hours, or no time at all
CHECK_S = 0.1  # interval, s, at which a failure of the emulator is looked for
CLOSED_S = 0.05  # interval, s, at which a port checks whether it was closed


@dataclass(frozen=True)
class Range:
    """The values that a fault may have, ends included."""

    low: float
    high: float
    whole: bool = False

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high and (not self.whole or value == int(value))

    def __str__(self) -> str:
        return f"{'a whole number' if self.whole else 'a number'} from {self.low:g} to {self.high:g}"


# A fault of every n-th reply, packet or picture.
EVERY_NTH = Range(1, 100_000, whole=True)
# A share of a time or of a speed. At a share of 0 a move would never end, and above 1 it would be no fault.
SHARE = Range(0.001, 1)
# A time in s, up to about a day, because a timer can't wait for a time of any length.
SECONDS = Range(0, 100_000)


@dataclass(frozen=True)
class Fault:
    """A fault that an emulated device can have: its effect, its value if none is given, and the values that it may have (None: a switch
    without a value)."""

    effect: str
    default: float = 1.0
    allowed: Range | None = None


class Faults:
    """The faults that are switched on. They can be changed while the device runs.

    Parameters
    ----------
    known : dict of str to Fault
    given : iterable of str
        ``NAME`` or ``NAME=VALUE``.

    Raises
    ------
    TwinError
        A fault is not known, or its value is not a number or not allowed.
    """

    def __init__(self, known: dict[str, Fault], given: tuple[str, ...] = ()) -> None:
        self.known = known
        self._on: dict[str, float] = {}
        for text in given:
            self.add(text)

    def add(self, text: str) -> None:
        """Switch a fault on, ``NAME`` or ``NAME=VALUE``.

        Raises
        ------
        TwinError
            The fault is not known, or its value is not a number or not allowed.
        """
        name, _, value = text.partition("=")
        if name not in self.known:
            meant = "".join(f" (did you mean {close}?)" for close in get_close_matches(name, self.known, n=1))
            raise TwinError(f"no fault '{quote(name)}'{meant}; there are: {', '.join(self.known)}")
        fault = self.known[name]
        if fault.allowed is None and value:
            raise TwinError(f"fault '{quote(text)}': {name} is a switch and takes no value; give {name} alone")
        example = f"for example {name}={fault.default:g}"
        with ErrorsAs(ValueError, lambda error: TwinError(f"fault '{quote(text)}': '{quote(value)}' is not a number; {example}")):
            number = float(value) if value else fault.default
        if fault.allowed is not None and number not in fault.allowed:
            raise TwinError(f"fault '{quote(text)}': {name} must be {fault.allowed}, not {quote(value)}; {example}")
        self._on[name] = number

    def clear(self) -> None:
        """Switch all faults off."""
        self._on.clear()

    def __contains__(self, name: str) -> bool:
        return self.value(name) is not None

    def value(self, name: str) -> float | None:
        """The fault's value, or None if it is off."""
        if name not in self.known:
            raise KeyError(name)
        return self._on.get(name)

    def every(self, name: str, count: int) -> bool:
        """Whether a fault of every n-th thing strikes the thing with this number."""
        every = self.value(name)
        return every is not None and count % int(every) == 0

    def factor(self, name: str) -> float:
        """The fault's value as a factor: 1 if it is off."""
        value = self.value(name)
        return 1.0 if value is None else value

    def after(self, name: str, act: Callable[[], object]) -> None:
        """Call a function after the time that is the fault's value, if it is on."""
        if (after_s := self.value(name)) is not None:
            timer = Timer(after_s, act)
            timer.daemon = True
            timer.start()


class Emulator(ABC):
    """An emulated device. A context manager, which works between ``start`` and ``stop``.

    Attributes
    ----------
    place : str
        What listens, and where, from ``start`` on.
    error : Exception or None
        The error with which the device ended by itself.
    """

    place = ""
    error: Exception | None = None

    @abstractmethod
    def start(self) -> None: ...

    @abstractmethod
    def stop(self) -> None: ...

    def run(self) -> None:
        """Run until SIGTERM or Ctrl-C, or until the device fails, whose error is raised. What listens is printed after ``ready``."""
        with contextlib.suppress(KeyboardInterrupt), signals_as_ctrl_c(), self:
            print(f"ready {self.place}", flush=True)  # at once, because a program may wait for it on a pipe
            while self.error is None:
                time.sleep(CHECK_S)
            raise self.error

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class EmulatedArm(Emulator):
    """An emulated arm.

    Parameters
    ----------
    known : dict of str to Fault
        The faults that it can have.
    given : tuple of str
        Those that are switched on.
    time_scale : float
        Factor by which it moves faster than the real arm.

    Attributes
    ----------
    arm : object
        Its controller: ``track`` has the motion, and ``update`` brings it up to the present time, which is returned.
    """

    arm: Any

    def __init__(self, known: dict[str, Fault], given: tuple[str, ...], time_scale: float) -> None:
        if not SLOWEST <= time_scale <= FASTEST:
            raise DeviceError(f"`time_scale` {time_scale:g}: expected {SLOWEST:g} to {FASTEST:g} times the real arm's speed")
        self.faults = Faults(known, given)

    def pose(self, time_s: float | None = None) -> np.ndarray:
        """Pose (6,) of the tool, or of the flange of an MG400, at a ``time.monotonic()`` (now if not given)."""
        now_s = self.arm.update()
        return self.arm.track.pose(now_s if time_s is None else time_s)


class PortServer(socketserver.ThreadingTCPServer):
    """A bound port, which serves clients from the start.

    Parameters
    ----------
    address : (str, int)
    serve : callable
        Serves a client until it has gone. Then, and if it fails, the client is hung up on.
    deaf : bool
        Whether the port takes no clients. It is bound nevertheless, so that nobody else listens there.

    Attributes
    ----------
    clients : set of socket
        The clients that are served.

    Raises
    ------
    OSError
        The port is taken, or the address is not this machine's.
    """

    allow_reuse_address = daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], serve: Callable[[socket.socket], None], *, deaf: bool = False) -> None:
        super().__init__(address, socketserver.BaseRequestHandler, bind_and_activate=False)
        self.clients: set[socket.socket] = set()
        self._serve, self._deaf = serve, deaf
        with on_error(self.server_close):
            self.server_bind()
        if not deaf:
            self.server_activate()
            Thread(target=self.serve_forever, args=(CLOSED_S,), daemon=True, name="emulated port").start()

    def process_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Begin to serve a client."""
        self.clients.add(request)
        super().process_request(request, client_address)

    def finish_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Serve a client, in its thread."""
        with contextlib.suppress(OSError, ValueError, struct.error):
            request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._serve(request)

    def shutdown_request(self, request: socket.socket) -> None:  # type: ignore[override]
        """Hang up on a client."""
        self.clients.discard(request)
        super().shutdown_request(request)

    def lose(self, *, abruptly: bool = False) -> None:
        """Lose every connection and take no more; ``abruptly``: they are reset, as after a power loss."""
        if not self._deaf:
            self.shutdown()
        self.server_close()
        for client in self.clients.copy():
            with contextlib.suppress(OSError):
                if abruptly:
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    client.close()
                else:
                    client.shutdown(socket.SHUT_RDWR)


def fault_lines(known: dict[str, Fault]) -> list[str]:
    """Lines of text about an emulator's faults: default values and effects."""
    return [f"{name + ('' if fault.allowed is None else f'={fault.default:g}'):22} {fault.effect}" for name, fault in known.items()]
