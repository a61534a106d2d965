"""``twin emulate``: devices emulated on this machine, for any client."""

import signal
from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app

emulate = typer.Typer(
    help="Emulate a device on this machine until SIGTERM or Ctrl-C; 'ready ...' is printed when it listens.", no_args_is_help=True
)
app.add_typer(emulate, name="emulate")

CHECK_S = 0.5

FaultOption = Annotated[
    list[str], typer.Option("--fault", metavar="NAME[=VALUE]", help="switch a fault on; '--fault help' lists them; may be repeated")
]
TimeScale = Annotated[float, typer.Option("--time-scale", help="how much faster than the real arm it moves", min=1e-3)]


def run_until_told(device, ready, failure=lambda: None) -> None:
    """Run a device (a context manager) and print ``ready()`` once it listens; end on SIGTERM or Ctrl-C, or with its ``failure()``."""
    ends = {signal.SIGTERM, signal.SIGINT}
    told = []
    handlers = {end: signal.signal(end, lambda *_: told.append(True)) for end in ends}  # libraries' threads get signals, too
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # waited for: nothing is ever interrupted halfway
    try:
        with device:
            print(f"ready {ready()}", flush=True)
            while not told and signal.sigtimedwait(ends, CHECK_S) is None:
                if (error := failure()) is not None:
                    raise error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for end, handler in handlers.items():
            signal.signal(end, handler)


def list_faults(faults: list[str], known: dict) -> None:
    """Print the faults and leave, if asked to."""
    if "help" in faults:
        for name, (default, meaning) in known.items():
            print(f"{name + ('' if default is None else f'={default:g}'):22} {meaning}")
        raise typer.Exit


@emulate.command("mg400")
def mg400(
    host: Annotated[str, typer.Option("--host", help="address to listen on")] = "127.0.0.1",
    port_offset: Annotated[int, typer.Option("--port-offset", help="added to 29999 and 30003 to 30006")] = 0,
    fault: FaultOption = (),
    firmware: Annotated[str, typer.Option("--firmware", help="version whose manners to have; below 1.5.6 bare echoes")] = "1.7.0",
    lenient: Annotated[bool, typer.Option("--lenient", help="as firmware 1.5.5: bare echoes, no reply to moves")] = False,
    time_scale: TimeScale = 1.0,
) -> None:
    """Emulate a Dobot MG400: dashboard 29999, motion 30003, feedback 30004 (8 ms), 30005 (200 ms) and 30006 (50 ms).

    Try it: twin emulate mg400 &  then in Python: open_arm("mg400:127.0.0.1").
    """
    from hardware.emulators.mg400 import FAULTS, OLD_FIRMWARE, Mg400Emulator

    list_faults(fault, FAULTS)
    version = OLD_FIRMWARE if lenient else firmware
    arm = Mg400Emulator(host=host, port_offset=port_offset, faults=tuple(fault), firmware=version, time_scale=time_scale)
    run_until_told(arm, lambda: f"mg400 {host} {' '.join(str(port) for port in arm.ports.values())}")


@emulate.command("magician")
def magician(
    link: Annotated[Path | None, typer.Option("--link", help="symbolic link to make to the pseudo-terminal")] = None,
    fault: FaultOption = (),
    time_scale: TimeScale = 1.0,
) -> None:
    """Emulate a Dobot Magician on a pseudo-terminal; its device is printed.

    Try it: twin emulate magician --link /tmp/magician &  then in Python: open_arm("magician:/tmp/magician").
    """
    from hardware.emulators.magician import FAULTS, MagicianEmulator

    list_faults(fault, FAULTS)
    arm = MagicianEmulator(link=link, faults=tuple(fault), time_scale=time_scale)
    run_until_told(arm, lambda: f"magician {link or arm.device}")
