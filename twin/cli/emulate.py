"""``twin emulate``: devices emulated on this machine, for any client."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app

emulate = typer.Typer(
    help="Emulate a device on this machine until SIGTERM or Ctrl-C; 'ready ...' is printed when it listens.", no_args_is_help=True
)
app.add_typer(emulate, name="emulate")

FaultOption = Annotated[
    list[str] | None, typer.Option("--fault", metavar="NAME[=VALUE]", help="switch a fault on; '--fault help' lists them; may be repeated")
]
TimeScale = Annotated[float, typer.Option("--time-scale", help="how much faster than the real arm it moves", min=1e-3)]


def faults_of(asked: list[str] | None, known: dict[str, tuple[float | None, str]]) -> tuple[str, ...]:
    """The faults that are asked for; lists those that are known, and leaves, where that is asked for."""
    from hardware.emulators.running import fault_lines
    from twin.cli.output import say

    if asked and "help" in asked:
        say(fault_lines(known))
        raise typer.Exit
    return tuple(asked or ())


@emulate.command("mg400")
def mg400(
    host: Annotated[str, typer.Option("--host", help="address to listen on")] = "127.0.0.1",
    port_offset: Annotated[int, typer.Option("--port-offset", help="added to 29999 and 30003 to 30006")] = 0,
    fault: FaultOption = None,
    firmware: Annotated[str, typer.Option("--firmware", help="version whose manners to have; below 1.5.6 bare echoes")] = "1.7.0",
    lenient: Annotated[bool, typer.Option("--lenient", help="as firmware 1.5.5: bare echoes, no reply to moves")] = False,
    time_scale: TimeScale = 1.0,
) -> None:
    """Emulate a Dobot MG400: dashboard 29999, motion 30003, feedback 30004 (8 ms), 30005 (200 ms) and 30006 (50 ms).

    Try it: twin emulate mg400 &  then in Python: open_arm("mg400:127.0.0.1").
    """
    from hardware.emulators.mg400 import FAULTS
    from hardware.emulators.running import emulate_mg400

    faults = faults_of(fault, FAULTS)
    emulate_mg400(host=host, port_offset=port_offset, faults=faults, firmware=firmware, lenient=lenient, time_scale=time_scale)


@emulate.command("magician")
def magician(
    link: Annotated[Path | None, typer.Option("--link", help="symbolic link to make to the pseudo-terminal")] = None,
    fault: FaultOption = None,
    time_scale: TimeScale = 1.0,
) -> None:
    """Emulate a Dobot Magician on a pseudo-terminal; its device is printed.

    Try it: twin emulate magician --link /tmp/magician &  then in Python: open_arm("magician:/tmp/magician").
    """
    from hardware.emulators.magician import FAULTS
    from hardware.emulators.running import emulate_magician

    faults = faults_of(fault, FAULTS)
    emulate_magician(link=link, faults=faults, time_scale=time_scale)
