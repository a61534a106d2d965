"""Runs an emulator until it is ended."""

import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from hardware.emulators.faults import Fault
from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import OLD_FIRMWARE, Mg400Emulator
from hardware.errors import DeviceError

SLOWEST, FASTEST = 1e-3, 1e3  # limits of the time scale: beyond them a move takes hours, or no time at all
CHECK_S = 0.5  # interval, s, at which a failure of the emulator is checked


def run_until_signal(
    device: AbstractContextManager[Any],
    ready: Callable[[], str],
    failure: Callable[[], Exception | None] = lambda: None,
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
    ends = {signal.SIGTERM, signal.SIGINT}
    told: list[bool] = []
    handlers = {end: signal.signal(end, lambda *_: told.append(True)) for end in ends}  # threads of libraries may get the signals, too
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # signals are waited for, so that nothing is interrupted halfway
    try:
        with device:
            print(f"ready {ready()}", flush=True)  # at once, because a program may wait for it on a pipe
            while not told and not _comes(ends):
                if (error := failure()) is not None:
                    raise error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for end, handler in handlers.items():
            signal.signal(end, handler)


def _comes(ends: set[signal.Signals]) -> bool:
    """Whether one of these signals comes within ``CHECK_S``.

    A process that was stopped and continues gets an answer from ``sigtimedwait`` although no signal came: it holds no number of a signal.
    """
    found = signal.sigtimedwait(ends, CHECK_S)
    return found is not None and found.si_signo in ends


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
        Behave as firmware 1.5.5, whatever ``firmware`` is: bare echoes, no reply to moves.
    """
    _require_time_scale(time_scale)
    version = OLD_FIRMWARE if lenient else firmware
    arm = Mg400Emulator(host=host, port_offset=port_offset, faults=faults, firmware=version, time_scale=time_scale)
    run_until_signal(arm, lambda: f"mg400 {host} {' '.join(str(port) for port in arm.ports.values())}")


def emulate_magician(*, link: Path | None = None, faults: tuple[str, ...] = (), time_scale: float = 1.0) -> None:
    """Emulate a Dobot Magician on a pseudo-terminal until it is ended; see ``MagicianEmulator``."""
    _require_time_scale(time_scale)
    arm = MagicianEmulator(link=link, faults=faults, time_scale=time_scale)
    run_until_signal(arm, lambda: f"magician {link or arm.device}")


def _require_time_scale(time_scale: float) -> None:
    if not SLOWEST <= time_scale <= FASTEST:
        raise DeviceError(f"`time_scale` {time_scale:g}: expected {SLOWEST:g} to {FASTEST:g} times the real arm's speed")


def fault_lines(known: dict[str, Fault]) -> list[str]:
    """Lines of text about an emulator's faults: default values and effects."""
    return [f"{name + ('' if fault.allowed is None else f'={fault.default:g}'):22} {fault.effect}" for name, fault in known.items()]
