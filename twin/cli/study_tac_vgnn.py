"""``twin study tac-vgnn``: the paper's whole comparison."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.options import Device, FormOrAuto, Out, Sensor, Target, names_in, numbers_in, writable_folder
from twin.cli.study import study

MODELS = "gnn,tac-vgnn,vgnn,cnn-v2,cnn-v1"
HELP = """Repeat the Tac-VGNN paper's comparison on a recording: graphs, models, training efficiency, what the areas show.

\b
  twin study tac-vgnn --data DIR --sensor mg400-331 --out out/study --max-minutes 120

Models (--models): gnn, tac-vgnn, tac-vgnn-release, cnn-v1, cnn-v2, and ours, vgnn. vgnn-without-graph, vgnn-without-modes and
vgnn-without-kernel show what its parts earn.

All are trained on the same rows and labels, and judged on the same fifth. Each run is a folder below --out/runs as 'twin train'
writes it. The same command goes on where it was ended, so a study can take many evenings. --max-minutes is shared evenly among
the runs still to come. A run that was ended by it is reported as ended early.

\b
Writes to --out: models.csv, graphs.csv, efficiency.csv, contacts.csv, curves.png, efficiency.png, contacts.png, index.html, runs/.
"""


@study.command("tac-vgnn", help=HELP)
def study_tac_vgnn(
    data: Annotated[Path, typer.Option("--data", metavar="DIR", help="labelled recording")],
    sensor: Sensor,
    out: Out,
    models: Annotated[str, typer.Option("--models", help="names with commas between")] = MODELS,
    seeds: Annotated[str, typer.Option("--seeds", help="of weights and order, with commas between")] = "0",
    labels: Annotated[str, typer.Option("--labels", help="that are learnt: raw (as the paper) or corrected")] = "raw",
    target: Target = "surface-2d",
    split: Annotated[int, typer.Option("--split", min=0, help="seed of the fifth kept out of training")] = 0,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="instead of each model's own number")] = None,
    max_minutes: Annotated[float | None, typer.Option("--max-minutes", min=0, help="for all training together")] = None,
    batches: Annotated[
        str, typer.Option("--batches", help="of the efficiency figure, with commas between; empty: no figure")
    ] = "64,256,512",
    contacts: Annotated[bool, typer.Option("--contacts/--no-contacts", help="press and render the contacts of the area figure")] = True,
    device: Device = "auto",
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="CPU threads")] = None,
    form: FormOrAuto = None,
) -> None:
    from scenes import load_sensor
    from training.studies import tac_vgnn
    from training.train import columns_of
    from twin.cli.output import tell
    from twin.cli.progress import shown

    plan = tac_vgnn.Plan(
        data=data,
        sensor=load_sensor(sensor),
        models=tuple(names_in(models)),
        seeds=numbers_in(seeds, "--seeds"),
        labels=labels,
        target=columns_of(target),
        split=split,
        epochs=epochs,
        max_minutes=max_minutes,
        batches=numbers_in(batches, "--batches"),
        contacts=contacts,
        device=device,
        threads=threads,
        form=form,
    )
    with shown() as progress:
        found = tac_vgnn.run(plan, writable_folder(out), progress=progress)
    tell(found)
