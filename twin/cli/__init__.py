"""The command line ``twin``: the outermost composition root, so it may import every package.

Each module of this package holds the commands of one kind of work. A command imports what it runs inside its function, so that
``--help`` does not wait for libraries that it does not need.
"""

import errno
import io
import logging
import os
import sys
import tempfile
import warnings
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from twin.cli.options import App, as_options
from twin.errors import OptionError, StoreError, TwinError
from twin.signals import end_interrupted, end_on_sigterm

# Modules of commands, in the order in which 'twin --help' lists them, each with the title above its commands.
COMMANDS = {
    "start": "Begin",
    "frames": "Frames and pins",
    "calibration": "Your own sensor, and how true its twin is",
    "learning": "Data sets and models",
    "studies": "Studies",
    "live": "Cameras and arms",
}

# Exit codes: a failure, a wrong command line.
FAILED, MISUSED = 1, 2


class _Commands(TyperGroup):
    """All commands, listed by the kind of work. It also prints a line after Ctrl-C; typer alone ends the program without one."""

    def commands_by_title(self, ctx: Any) -> dict[str, list[str]]:
        """Names of the commands under each title of ``COMMANDS``."""
        found: dict[str, list[str]] = {title: [] for title in COMMANDS.values()}
        for name in self.list_commands(ctx):
            command: Any = self.get_command(ctx, name)
            while hasattr(command, "commands"):  # a group of commands is listed with the module of its first command
                command = next(iter(command.commands.values()))
            found[COMMANDS[command.callback.__module__.rpartition(".")[2]]].append(name)
        return {title: names for title, names in found.items() if names}

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        width = max(map(len, self.list_commands(ctx)))
        for title, names in self.commands_by_title(ctx).items():
            commands = [(name, self.get_command(ctx, name)) for name in names]
            rows = [(f"{name:{width}}", each.get_short_help_str(formatter.width - width - 6)) for name, each in commands if each]
            with formatter.section(title):
                formatter.write_dl(rows)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            end_interrupted(interrupt, _print_notes)
        except typer.BadParameter as error:
            numbers = error.param.nargs if error.param is not None else 1
            if numbers > 1:
                error.message += f"; it needs {numbers} numbers, with a space between"
            raise


class FewCommands(TyperGroup):
    """A group of commands of one kind. For an unknown name the error lists the commands of the group."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] not in self.list_commands(ctx) and not args[0].startswith("-") and not ctx.resilient_parsing:
            ctx.fail(f"No such command '{args[0]}'. There are {', '.join(self.list_commands(ctx))}.")
        return super().resolve_command(ctx, args)


def group(name: str, help: str) -> App:
    """A new group of commands of the program."""
    made = App(cls=FewCommands, help=help, no_args_is_help=True, rich_markup_mode=None)
    app.add_typer(made, name=name)
    return made


app = App(name="twin", cls=_Commands, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


def _print_version(asked: bool) -> None:
    from twin.store.fingerprint import program_version

    if asked:
        print(f"twin {program_version()}")
        raise typer.Exit


@app.callback(
    help="A digital twin of the TacTip optical tactile sensor.\n\n"
    "It presses a hyperelastic skin by finite elements, path-traces the camera's frames, finds the pins (markers), and builds their graph: "
    "for rendered, recorded and live frames alike.\n\n"
    "Start with 'twin doctor', then 'twin demo --out out/demo'.\n\n"
    "Exit codes: 0 done, 1 failed, 2 wrong command line, 3 'twin check' found a failed sensor, 130 ended by Ctrl-C, 143 by SIGTERM."
)
def _twin(
    version: Annotated[bool, typer.Option("--version", is_eager=True, callback=_print_version, help="print the version and stop")] = False,
) -> None:
    """What may stand before a command."""


def command_line() -> typer.Typer:
    """The program with all its commands. Each module adds its own commands when it is imported."""
    for name in COMMANDS:
        import_module(f"twin.cli.{name}")
    return app


def main() -> None:
    """Run the command line.

    An error that the user can correct is printed as one line on stderr. The exit code is then 2 if the command line itself is wrong, and 1
    otherwise. Ctrl-C and SIGTERM also print one line; their exit codes are 130 and 143. A warning is one line without the place in the
    source.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a letter that the encoding lacks is printed as its code, as on stderr
    try:
        os.getcwd()  # libraries fail without one, each in its own way
        import_module("twin").require_own("training", "hardware")
    except (OSError, ImportError) as error:
        reason = error if isinstance(error, ImportError) else "the working folder was deleted; change into a folder that exists"
        print(f"twin: error: {reason}", file=sys.stderr)
        sys.exit(FAILED)
    end_on_sigterm()
    warnings.formatwarning = lambda message, *_, **__: f"twin: warning: {as_options(' '.join(str(message).split()))}\n"
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # without a writable home directory it prints four lines of warnings
    try:
        command_line()(prog_name="twin")
    except KeyboardInterrupt as interrupt:  # before a command runs
        end_interrupted(interrupt, _print_notes)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            _end_without_room(error)
        if not _for_user(error):
            raise
        _print_error(error)
        if isinstance(error, StoreError):
            _print_unsaved(error.unsaved)
        sys.exit(MISUSED if isinstance(error, OptionError) else FAILED)


def _print_error(error: Exception) -> None:
    """Print an error as one line, and its notes. Of a device's error the line is short, and what is left out goes to a file."""
    text = as_options(" ".join(str(error).split()))
    devices = sys.modules.get("hardware.errors")  # loaded if there is a device
    notes = [as_options(note) for note in getattr(error, "__notes__", ())]
    if devices is None or not isinstance(error, devices.DeviceError) or (len(text) <= devices.LONGEST_LINE and not notes):
        print(f"twin: error: {text}", file=sys.stderr)
        _print_notes(error)
        return
    whole = "\n".join([text, *notes])
    log = Path(tempfile.gettempdir()) / f"twin-{os.getpid()}.log"
    told = ""
    with suppress(OSError):
        log.write_text(whole + "\n", encoding="utf-8")
        told = f"; details: {log}"
    print(f"twin: error: {devices.in_short(whole, devices.LONGEST_LINE - len('twin: error: ') - len(told))}{told}", file=sys.stderr)


def _end_without_room(error: OSError) -> NoReturn:
    """End after a full disk that holds no output file of the command, but the standard output or a library's cache."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # text that still waits to be printed would fail again at the end
    place = error.filename or "the standard output or a cache"
    print(f"twin: error: {place}: can't be written ({error.strerror}); free some space and give the same command again", file=sys.stderr)
    sys.exit(FAILED)


def _print_unsaved(texts: Mapping[str, str]) -> None:
    """Print the texts that could not be written. If there are several, each follows its file's name."""
    try:
        for name, text in texts.items():
            print(text if len(texts) == 1 else f"--- {name}\n{text}", flush=True)
    except OSError:  # the standard output lies on the same full disk
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _for_user(error: Exception) -> bool:
    """Whether an error tells the user what to do. The specifications' error class is imported here, because its module loads slowly."""
    from scenes.base import SpecError

    return isinstance(error, TwinError | SpecError)


def _print_notes(error: BaseException) -> None:
    """Print each note of an error on stderr. A note states a failure after the error, for example that an arm could not be stopped."""
    for note in getattr(error, "__notes__", ()):
        print(f"twin: note: {as_options(' '.join(note.split()))}", file=sys.stderr)
