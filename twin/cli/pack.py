"""``twin pack``: a small copy of a run."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Out, writable_folder

HELP = """Write a small copy of a finished training run, half as precise and less than a tenth as large.

It serves wherever a RUN does. Those that go with the package, below training/weights, were made so:

\b
  twin study sim-to-real --sensor mg400-331 --frames DIR --contacts surface-2d-wide --draws 2 --epochs 60 --out study
  twin pack study/sim_only --out training/weights/mg400-331
"""


@app.command("pack", help=HELP)
def pack(run: Annotated[Path, typer.Argument(help="folder of a run of vgnn, trained with --no-kernel")], out: Out) -> None:
    from training.estimator import PoseEstimator
    from training.packed import WEIGHTS, pack
    from twin.cli.output import say

    PoseEstimator.load(run)  # says what is wrong with a folder that holds no run
    size = pack(run, writable_folder(out))
    say([f"wrote {out / WEIGHTS} ({size / 1e3:.0f} kB), {out / 'config.json'}"])
