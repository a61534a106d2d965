"""``twin train``: a model from a labelled recording."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Device, FormOrAuto, Sensor, Target

HELP = """Train a model that tells the pose from a frame.

\b
vgnn              ours: Voronoi graph network on matched pins, ensemble, calibrated 90 % intervals
tac-vgnn          the paper's network: Delaunay graph, Voronoi areas; dense layers 96, 64
tac-vgnn-release  the same with the dense layers of the published code: 128, 96
gnn               the paper's graph network on 6 nearest neighbours, without areas
cnn-v1, cnn-v2    convolutional networks of 5 x 256 and 5 x 48 filters on 128 x 128 px

Labels are columns of the recording's table: a preset (surface-2d: pose_2 pose_6; surface-2d-shear: also move_1 move_6;
surface-3d: pose_3 pose_4 pose_5; edge-2d, edge-3d) or names with commas between. With --labels corrected, moves that
were not executed are taken out, where move_executed.csv or labels_corrected.csv beside the table tells which.

Depth and angle of simulated contacts are those of the surface that was touched, whatever its shape: indentation along its normal
at the nearest place, and the angle from that normal. So data sets of several objects can be joined: give --data once for each.

A random fifth of the rows is kept out of training for 'twin evaluate'; of simulated data a fifth of the contacts, with all their
states. --split gives its seed; --split -1 trains on all.

\b
Writes to --out: config.json (resolved, with the sensor and the pipeline's parameters), curves.csv, weights.pt, and
while it runs checkpoint.pt. A run that was ended goes on where it was when it is started again with the same options.
"""


@app.command("train", help=HELP)
def train(
    model: Annotated[str, typer.Option("--model", help="vgnn, tac-vgnn, tac-vgnn-release, gnn, cnn-v1 or cnn-v2")],
    sensor: Sensor,
    data: Annotated[list[Path], typer.Option("--data", metavar="DIR", help="labelled recording; give it once for each of several")],
    out: Annotated[Path, typer.Option("--out", metavar="RUN", help="folder of the run; made if missing")],
    target: Target = "surface-2d",
    labels: Annotated[str, typer.Option("--labels", help="corrected or raw")] = "corrected",
    seed: Annotated[int, typer.Option("--seed", help="of weights and order")] = 0,
    split: Annotated[int, typer.Option("--split", help="seed of the fifth kept out of training; -1: none")] = 0,
    epochs: Annotated[int | None, typer.Option("--epochs", help="instead of the model's own number")] = None,
    batch: Annotated[int | None, typer.Option("--batch", help="instead of the model's own size")] = None,
    members: Annotated[int | None, typer.Option("--members", help="networks in the ensemble")] = None,
    kernel: Annotated[
        bool | None,
        typer.Option("--kernel/--no-kernel", help="Gaussian process beside the networks; slow for thousands of rows"),
    ] = None,
    max_minutes: Annotated[float | None, typer.Option("--max-minutes", help="stop after the epoch that passes this time")] = None,
    threads: Annotated[int | None, typer.Option("--threads", help="CPU threads")] = None,
    device: Device = "auto",
    form: FormOrAuto = None,
) -> None:
    from scenes import load_sensor
    from training.train import train_model
    from twin.cli.output import tell
    from twin.cli.progress import shown

    with shown() as progress:
        made = train_model(
            model,
            load_sensor(sensor),
            data,
            out,
            target=target,
            labels=labels,
            seed=seed,
            split=None if split < 0 else split,
            epochs=epochs,
            batch=batch,
            members=members,
            kernel=kernel,
            max_minutes=max_minutes,
            threads=threads,
            device=device,
            form=form,
            progress=progress,
        )
    tell(made)
