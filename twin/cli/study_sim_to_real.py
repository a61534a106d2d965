"""``twin study sim-to-real``: what the twin is worth on real frames."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.options import Out, Sensor, writable_folder
from twin.cli.study import study

HELP = """Train in the twin, test on real frames, against training on real frames.

\b
  twin study sim-to-real --sensor mg400-331 --frames DIR --labels 40 --seed 0 --out out/sim-to-real

Judged on a random fifth of the recording: vgnn trained on simulated contacts alone; the same with its labels corrected by
--labels real frames (drawn by --seed from the other four fifths); vgnn and a quadratic regression trained on as many real
frames, on 500 and on all. The twin is the sensor's specification as shipped. Contacts are simulated in --out/sim unless
--sim names a finished data set of 'twin dataset'. The same command goes on where it was ended.

\b
Writes to --out: sim_only/, sim_plus_real/ and real_N/, each a RUN; study.csv, index.html.
"""


@study.command("sim-to-real", help=HELP)
def study_sim_to_real(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="labelled real recording")],
    out: Out,
    labels: Annotated[int, typer.Option("--labels", min=5, metavar="N", help="labelled frames beside the simulated ones")] = 40,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the frames drawn, the contacts and the weights")] = 0,
    count: Annotated[int, typer.Option("--count", min=10, metavar="N", help="contacts to simulate")] = 500,
    sim: Annotated[Path | None, typer.Option("--sim", metavar="DIR", help="simulated data set instead")] = None,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="of every training, instead of the model's own number")] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, metavar="N", help="processes that simulate")] = 1,
) -> None:
    import numpy as np

    from scenes import load_experiment, load_object, load_randomisation, load_sensor
    from training.dataset import load_dataset
    from training.generation import GenerationConfig, generate
    from training.sim_to_real.study import choose_frames, correct, judged, quadratic_row, train_in_twin, train_on_real
    from training.study.report import write_table
    from twin.cli.progress import count_bar, epoch_bar, rate_bar
    from twin.kinematics import rig_of
    from twin.views.page import render_page

    spec = load_sensor(sensor)
    with count_bar("frames") as progress:
        real = load_dataset(frames, spec, progress=progress)
    chosen = choose_frames(len(real), labels, seed)
    writable_folder(out)
    if sim is None:
        sim, plan = out / "sim", load_experiment("surface-2d")
        config = GenerationConfig(
            sensor=spec,
            object=load_object(plan.object),
            experiment=plan,
            randomisation=load_randomisation("contact"),
            friction=rig_of(spec).friction,
            seed=seed,
            images="none",
            states="all",
        )
        with rate_bar(f"{plan.name}, {spec.name}") as progress:
            generate(sim, config, count, workers=workers, progress=progress)
    with count_bar("simulated states") as progress:
        simulated = load_dataset(sim, spec, form=real.pins.form, progress=progress)
    with epoch_bar("sim_only") as progress:
        train_in_twin(simulated, out / "sim_only", seed=seed, epochs=epochs, progress=progress)
    corrections = correct(out / "sim_only", out / "sim_plus_real", real, chosen.few)
    rows = [
        judged("simulated", 0, out / "sim_only", real, chosen.test),
        judged("simulated and real", labels, out / "sim_plus_real", real, chosen.test),
    ]
    for name, index in chosen.trained.items():
        run = out / f"real_{name}"
        with epoch_bar(run.name) as progress:
            train_on_real(real.rows(index), run, seed=seed, epochs=epochs, progress=progress)
        rows += [judged("real", len(index), run, real, chosen.test), quadratic_row("real", real, index, chosen.test)]
    columns = list(rows[0])
    page = render_page(
        "training.sim_to_real",
        sensor=spec.name,
        tested=len(chosen.test),
        frames=len(real),
        labelled=labels,
        seed=seed,
        simulated=len(simulated),
        contacts=len(np.unique(simulated.group)) if simulated.group is not None else len(simulated),
        names=real.targets.names,
        chosen=corrections,
        columns=columns,
        rows=rows,
        problems=real.problems,
    )
    (out / "index.html").write_text(page)
    for row in rows:
        errors = ", ".join(f"{key} {row[key]:.3g}" for key in columns if key.endswith(("_corrected", "_raw")))
        print(f"{row['trained_on']}, {row['labelled_frames']} labelled, {row['model']}: {errors}")
    for path in (write_table(out / "study.csv", rows), out / "index.html"):
        print(f"wrote {path}")
