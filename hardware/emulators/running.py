"""Runs an emulator until it is ended."""

import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from hardware.emulators.faults import Fault
from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError

SLOWEST, FASTEST = 1e-3, 1e3  # limits of the time scale: beyond them a move takes hours, or no time at all
CHECK_S = 0.1  # interval, s, at which signals and a failure of the emulator are checked


def run_until_signal(
    device: AbstractContextManager[Any], ready: Callable[[], str], failure: Callable[[], Exception | None] = lambda: None
) -> None:
    """Run a device until SIGTERM or Ctrl-C, or until it fails. Use it in the main thread only.

    Parameters
    ----------
    device : context manager
        It listens while it is entered.
    ready : callable
        Returns what listens, and where, once it does. This is printed after ``ready``.
    failure : callable
        Returns the error with which the device ended, or None while it runs. The error is raised.
    """
    told: list[bool] = []
    handlers = {end: signal.signal(end, lambda *_: told.append(True)) for end in (signal.SIGTERM, signal.SIGINT)}
    try:
        with device:
            print(f"ready {ready()}", flush=True)  # at once, because a program may wait for it on a pipe
            while not told:
                if (error := failure()) is not None:
                    raise error
                time.sleep(CHECK_S)
    finally:
        for end, handler in handlers.items():
            signal.signal(end, handler)


def emulate_mg400(
    *,
    host: str = "127.0.0.1",
    port_offset: int | None = 0,
    faults: tuple[str, ...] = (),
    firmware: str = "1.7.0",
    lenient: bool = False,
    time_scale: float = 1.0,
) -> None:
    """Emulate a Dobot MG400 until it is ended; see ``Mg400Emulator``.

    Parameters
    ----------
    lenient : bool
        See ``Mg400Emulator``.
    """
    require_time_scale(time_scale)
    arm = Mg400Emulator(host=host, port_offset=port_offset, faults=faults, firmware=firmware, lenient=lenient, time_scale=time_scale)
    run_until_signal(arm, lambda: f"mg400 {host} {' '.join(str(port) for port in arm.ports.values())}")


def emulate_magician(*, link: Path | None = None, faults: tuple[str, ...] = (), time_scale: float = 1.0) -> None:
    """Emulate a Dobot Magician on a pseudo-terminal until it is ended; see ``MagicianEmulator``."""
    require_time_scale(time_scale)
    arm = MagicianEmulator(link=link, faults=faults, time_scale=time_scale)
    run_until_signal(arm, lambda: f"magician {link or arm.device}")


def require_time_scale(time_scale: float) -> None:
    """Raise ``DeviceError`` unless an emulated arm can be this many times as fast as the real one."""
    if not SLOWEST <= time_scale <= FASTEST:
        raise DeviceError(f"`time_scale` {time_scale:g}: expected {SLOWEST:g} to {FASTEST:g} times the real arm's speed")


def fault_lines(known: dict[str, Fault]) -> list[str]:
    """Lines of text about an emulator's faults: default values and effects."""
    return [f"{name + ('' if fault.allowed is None else f'={fault.default:g}'):22} {fault.effect}" for name, fault in known.items()]
