"""``twin study``: experiments that compare."""

import typer

from twin.cli import app

study = typer.Typer(help="Experiments that compare models.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(study, name="study")
