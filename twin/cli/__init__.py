"""The command line ``twin``: the outermost composition root, so it may import every package."""

import sys

import typer

from scenes.errors import SpecError
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


def main() -> None:
    """Run the command line; an error meant for the user is one line on stderr and exit code 1."""
    from twin.cli import (  # noqa: F401  (each registers its commands)
        audit,
        calibrate,
        catalog,
        collect,
        dataset,
        demo,
        doctor,
        emulate,
        emulate_camera,
        evaluate,
        graph,
        live,
        predict,
        preprocess,
        realism,
        render,
        servo,
        study,
        train,
        validate,
    )

    try:
        app()
    except (TwinError, SpecError) as error:
        _tell("error", str(error), error)
        sys.exit(1)
    except KeyboardInterrupt as interrupt:
        _tell("interrupted", "", interrupt)
        sys.exit(130)


def _tell(what: str, text: str, error: BaseException) -> None:
    """A line on stderr, and one for each note: what went wrong on top of it, as an arm that could not be stopped."""
    print(f"twin: {what}" + (f": {' '.join(text.split())}" if text else ""), file=sys.stderr)
    for note in getattr(error, "__notes__", ()):
        print(f"twin: note: {' '.join(note.split())}", file=sys.stderr)
