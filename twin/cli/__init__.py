"""The command line ``twin``: the outermost composition root, so it may import every package.

Each module of this package holds the commands of one kind of work. A command imports what it runs inside its function, so that
``--help`` does not wait for libraries that it does not need.
"""

import sys
from importlib import import_module

import typer

from twin.errors import TwinError

# Modules of commands, in the order in which 'twin --help' lists them.
COMMANDS = ("start", "frames", "calibration", "learning", "studies", "live")

app = typer.Typer(
    name="twin",
    help="A rendered-sensor digital twin of the TacTip optical tactile sensor.\n\n"
    "Press a skin by finite elements, path-trace what the camera inside sees, find the pins, build the graph: "
    "on rendered, recorded and live frames alike.\n\n"
    "Start with 'twin doctor', then 'twin demo --out out/demo'.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)


def command_line() -> typer.Typer:
    """The program with all its commands. Each module adds its own commands when it is imported."""
    for name in COMMANDS:
        import_module(f"twin.cli.{name}")
    return app


def main() -> None:
    """Run the command line. An error that a user can act on is printed as one line on stderr, and the exit code is 1."""
    try:
        command_line()()
    except KeyboardInterrupt:
        print("twin: interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if not _for_user(error):
            raise
        print(f"twin: error: {' '.join(str(error).split())}", file=sys.stderr)
        print_notes(error)
        sys.exit(1)


def _for_user(error: Exception) -> bool:
    """Whether an error tells the user what to do. The specifications' error is imported only now, because their models load slowly."""
    from scenes.base import SpecError

    return isinstance(error, TwinError | SpecError)


def print_notes(error: BaseException) -> None:
    """Print each note of an error on stderr. Notes tell what failed after the error, for example that an arm could not be stopped."""
    for note in getattr(error, "__notes__", ()):
        print(f"twin: note: {' '.join(note.split())}", file=sys.stderr)
