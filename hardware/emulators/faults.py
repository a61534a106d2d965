"""What all emulated devices have: faults, switched on by name (``NAME`` or ``NAME=VALUE``), a start, an end, and a run until a signal."""

import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from threading import Timer
from typing import Self

from hardware.errors import DeviceError
from scenes.files import quote
from twin.errors import ErrorsAs, TwinError

SLOWEST, FASTEST = 1e-3, 1e3  # limits of the time scale: beyond them a move takes hours, or no time at all
CHECK_S = 0.1  # interval, s, at which signals and a failure of the emulator are checked


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
            close = get_close_matches(name, self.known, n=1)
            raise TwinError(
                f"no fault '{quote(name)}'{f' (did you mean {close[0]}?)' if close else ''}; there are: {', '.join(self.known)}"
            )
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

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def run_until_signal(device: Emulator) -> None:
    """Run a device until SIGTERM or Ctrl-C, or until it fails, whose error is raised. Use it in the main thread only.

    What listens, and where, is printed after ``ready``.
    """
    told: list[bool] = []
    handlers = {end: signal.signal(end, lambda *_: told.append(True)) for end in (signal.SIGTERM, signal.SIGINT)}
    try:
        with device:
            print(f"ready {device.place}", flush=True)  # at once, because a program may wait for it on a pipe
            while not told:
                if device.error is not None:
                    raise device.error
                time.sleep(CHECK_S)
    finally:
        for end, handler in handlers.items():
            signal.signal(end, handler)


def require_time_scale(time_scale: float) -> None:
    """Raise ``DeviceError`` unless an emulated arm can be this many times as fast as the real one."""
    if not SLOWEST <= time_scale <= FASTEST:
        raise DeviceError(f"`time_scale` {time_scale:g}: expected {SLOWEST:g} to {FASTEST:g} times the real arm's speed")


def fault_lines(known: dict[str, Fault]) -> list[str]:
    """Lines of text about an emulator's faults: default values and effects."""
    return [f"{name + ('' if fault.allowed is None else f'={fault.default:g}'):22} {fault.effect}" for name, fault in known.items()]
