"""``twin study tac-vgnn``: the paper's whole comparison."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.options import Device, FormOrAuto, Out, Sensor, Target, columns_of, names_in, writable_folder
from twin.cli.study import study

MODELS = "gnn,tac-vgnn,vgnn,cnn-v2,cnn-v1"
HELP = """Repeat the Tac-VGNN paper's comparison on a recording: graphs, models, training efficiency, what the areas show.

\b
  twin study tac-vgnn --data DIR --sensor mg400-331 --out out/study --max-minutes 120

Models (--models): gnn, tac-vgnn, tac-vgnn-release, cnn-v1, cnn-v2, ours vgnn, and what its parts earn:
vgnn-without-graph, vgnn-without-modes, vgnn-without-kernel.

All are trained on the same rows and labels and judged on the same fifth. Each run is a folder below --out/runs as 'twin train'
writes it; the same command goes on where it was ended, so a study can take many evenings. --max-minutes is shared evenly among
the runs still to come; what a run reached in its time is reported as such.

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
    import numpy as np
    import torch

    from scenes import load_sensor
    from training.dataset import load_dataset
    from training.models import model_named
    from training.networks import choose_device
    from training.recipes import TrainingError
    from training.study.contacts import recorded_contacts, twin_contacts
    from training.study.efficiency import measure_training
    from training.study.graphs import compare_graphs
    from training.study.models import SHOWN, error_columns, plan_run, table_row, train_all
    from training.study.report import draw_contacts, draw_curves, draw_efficiency, write_page
    from twin.cli.progress import count_bar, epoch_bar
    from twin.report.table import write_table

    if labels not in ("corrected", "raw"):
        raise TrainingError(f"--labels must be corrected or raw, got {labels!r}")
    device = choose_device(device)
    if threads:
        torch.set_num_threads(threads)
    numbers = {"--seeds": _numbers(seeds, "--seeds"), "--batches": _numbers(batches, "--batches")}
    names = names_in(models)
    plans = [plan_run(name, labels=labels, seed=seed, split=split, epochs=epochs) for seed in numbers["--seeds"] for name in names]
    if not plans:
        raise TrainingError("nothing to compare: give at least one of --models and of --seeds")
    with count_bar("frames") as progress:
        found = load_dataset(data, load_sensor(sensor), columns_of(target), form=form, progress=progress)
    runs = writable_folder(out) / "runs"
    graphs = compare_graphs(found.pins)
    spent = train_all(plans, found, runs, max_minutes=max_minutes, device=device, bar=epoch_bar)
    rows = [table_row(plan, found, runs, spent.get(plan.folder)) for plan in plans]
    for row in rows:
        errors = (f"{label} {row[f'{label}_raw']:.4g} raw, {row[f'{label}_corrected']:.4g} corrected" for label in found.targets.names)
        said = "; ".join(errors) if "epochs" in row else ""
        print(f"{row['model']}, seed {row['seed']}: {row['state']}{', ' if said else ''}{said}")
    written = [write_table(out / "models.csv", rows), write_table(out / "graphs.csv", graphs), draw_curves(out / "curves.png", plans, runs)]
    efficiency = []
    for model in dict.fromkeys(plan.config.model for plan in plans) if numbers["--batches"] else ():
        inputs = model_named(model).prepare(found, np.arange(len(found))).inputs
        efficiency += [measure_training(model, found.pins, inputs, batch, device=device) for batch in numbers["--batches"]]
    if efficiency:
        written += [write_table(out / "efficiency.csv", efficiency), draw_efficiency(out / "efficiency.png", efficiency)]
    changes = recorded_contacts(found)
    if contacts:
        with count_bar("contacts") as progress:
            changes = twin_contacts(found.pins.sensor, found.pins.form, progress=progress) + changes
    figures = [change.figures() for change in changes]
    if figures:
        written += [write_table(out / "contacts.csv", figures), draw_contacts(out / "contacts.png", changes)]
    notes = {"device": device, "threads": torch.get_num_threads(), "labels": labels, "max_minutes": max_minutes}
    notes["columns"] = [*SHOWN, *error_columns(found)]
    written.append(write_page(out, data=found, models=rows, graphs=graphs, efficiency=efficiency, contacts=figures, notes=notes))
    for path in written:
        print(f"wrote {path}")


def _numbers(text: str, option: str) -> list[int]:
    from training.recipes import TrainingError

    try:
        return [int(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise TrainingError(f"{option} takes whole numbers with commas between, got {text!r}") from error
