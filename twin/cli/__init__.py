"""The command line ``twin``: the outermost composition root, so it may import every package."""

import sys

import typer

from scenes.base import SpecError
from twin.errors import TwinError

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
    """The program with all its commands; each module registers its own when it is imported."""
    from twin.cli import calibration, frames, learning, live, start, studies  # noqa: F401

    return app


def main() -> None:
    """Run the command line; an error meant for the user is one line on stderr and exit code 1."""
    try:
        command_line()()
    except (TwinError, SpecError) as error:
        print(f"twin: error: {' '.join(str(error).split())}", file=sys.stderr)
        print_notes(error)
        sys.exit(1)
    except KeyboardInterrupt:
        print("twin: interrupted", file=sys.stderr)
        sys.exit(130)


def print_notes(error: BaseException) -> None:
    """A line on stderr for each note on an error: what went wrong on top of it, as an arm that could not be stopped."""
    for note in getattr(error, "__notes__", ()):
        print(f"twin: note: {' '.join(note.split())}", file=sys.stderr)
