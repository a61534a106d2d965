"""``twin study sim-to-real``: what the twin is worth on real frames."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.options import CORES, Across, Out, Sensor, Workers, writable_folder
from twin.cli.study import study
from twin.types import FINE

HELP = """Train in the twin, test on real frames, against training on real frames.

\b
  twin study sim-to-real --sensor mg400-331 --frames DIR --labels 40 --seed 0 --out out/sim-to-real

The recording's --experiment says how the arm went and what is learnt; --contacts is the experiment that is simulated.

--labels real frames are drawn by --seed from four fifths of the recording. Friction is drawn as it was on them. What the twin's
pins miss on them is learnt as a Gaussian process of the label, and drawn --draws times for every simulated contact; with
--calibrate the specification is fitted to them first ('twin calibrate contact'; about an hour). Judged on the random fifth that
is left:

\b
  simulated            vgnn trained on simulated contacts alone; its 90 %
                       intervals are what the labelled frames say
  simulated and real   the same, averaged with a Gaussian process of the pins
                       of both simulated contacts and labelled frames
  real                 vgnn and a quadratic regression trained on as many real
                       frames, on 500 and on all
  --ablate             simulated: without what the twin misses, with a fifth
                       of the contacts, a coarse mesh, one friction, any
                       friction, no moves, tolerances of skin and gel drawn
                       as well, and uncalibrated; this simulates six more
                       sets of contacts

Contacts are simulated in --out/sim, without pictures, unless --sim (may be given several times: other objects) names finished data
sets of 'twin dataset' or 'twin study objects'; of one with pictures the pins are those that the pipeline sees. The same command
goes on where it was ended.

\b
Writes to --out: sim_only/, sim_plus_real/ and real_N/, each a RUN; study.csv, index.html.
"""

SEEDS_APART = 1000  # of the draws of one study, so that those of --seed 0, 1, 2... differ


@study.command("sim-to-real", help=HELP)
def study_sim_to_real(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="labelled real recording")],
    out: Out,
    labels: Annotated[int, typer.Option("--labels", min=8, metavar="N", help="labelled frames beside the simulated ones")] = 40,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the frames drawn, the contacts and the weights")] = 0,
    experiment: Annotated[str, typer.Option("--experiment", metavar="E", help="how the frames were recorded")] = "surface-2d",
    contacts: Annotated[
        str | None,
        typer.Option("--contacts", metavar="E", help="experiment to simulate; if not given, one wider than the frames' own"),
    ] = None,
    draws: Annotated[int, typer.Option("--draws", min=1, help="of what the twin misses, for each contact")] = 2,
    count: Annotated[int, typer.Option("--count", min=10, metavar="N", help="contacts to simulate")] = 500,
    sim: Annotated[list[Path] | None, typer.Option("--sim", metavar="DIR", help="simulated data set instead; several are joined")] = None,
    calibrate: Annotated[bool, typer.Option("--calibrate", help="fit the specification to the labelled frames first")] = False,
    ablate: Annotated[bool, typer.Option("--ablate", help="also train without one ingredient at a time")] = False,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="of every training, instead of the model's own number")] = None,
    workers: Workers = CORES,
    across: Across = FINE,
) -> None:
    from dataclasses import replace

    import numpy as np

    from scenes import load_experiment, load_object, load_randomisation, load_sensor
    from training.contact_calibration import fit_contact
    from training.contact_calibration.simulate import Setup
    from training.dataset import joined, load_dataset
    from training.generation import generate
    from training.sim_to_real.discrepancy import Discrepancy, measure_residuals
    from training.sim_to_real.page import write_page
    from training.sim_to_real.study import (
        arm_labels,
        choose_frames,
        judged,
        measured_of,
        put_beside,
        quadratic_row,
        states_like,
        states_touching,
        train_in_twin,
        train_on_real,
        with_missing,
    )
    from training.sim_to_real.twins import Twin, as_mounted, without_one_ingredient
    from twin.cli.progress import count_bar, epoch_bar, rate_bar
    from twin.report.table import write_table

    spec, plan = load_sensor(sensor), load_experiment(experiment)
    simulated_plan, touched = load_experiment(contacts or plan.wider or experiment), load_object(plan.object)
    with count_bar("frames") as progress:
        real = load_dataset(frames, spec, plan.targets, progress=progress)
    chosen = choose_frames(len(real), labels, seed)
    writable_folder(out)
    few = real.rows(chosen.few)
    measured, uncalibrated = measured_of(few), as_mounted(spec)
    if calibrate:
        setup = Setup(spec, plan, touched, measured.form, across, out / "calibration", workers)
        with rate_bar("calibration") as progress:
            spec = fit_contact(setup, measured, progress=progress).sensor
    setup, moves = Setup(spec, plan, touched, measured.form, across, out / "labelled", workers, ()), load_randomisation("moves")
    with rate_bar("labelled frames") as progress:
        residuals = measure_residuals(setup, measured, progress)
    seen = moves.model_copy(update={"friction": residuals.friction_spread() or moves.friction})
    full = Twin("sim_only", "simulated", "sim", spec, simulated_plan, seen, across)
    twins = [full, *(without_one_ingredient(full, uncalibrated, moves, load_randomisation("contact")) if ablate else ())]

    known = {(full.across, full.frictions): Discrepancy(residuals)}
    sets, rows, about, left_out = {}, [], {}, np.empty(0)
    for twin in twins:
        tried = twin.across, twin.frictions
        if twin.learns and tried not in known:
            with rate_bar(f"{twin.name}: labelled frames") as progress:
                part = measure_residuals(replace(setup, across=twin.across), measured, progress, frictions=twin.frictions)
            known[tried] = Discrepancy(part)
        missing = known[tried] if twin.learns else None
        if twin.contacts not in sets:
            folders = sim if sim and twin is full else [out / twin.contacts]
            if folders is not sim:
                with rate_bar(f"{twin.name}: {twin.experiment.name}") as progress:
                    generate(folders[0], twin.config(touched, seed), count, workers=workers, progress=progress)
            sets[twin.contacts] = []
            for folder in folders:
                with count_bar(f"states of {folder.name}") as progress:
                    sets[twin.contacts].append(load_dataset(folder, spec, plan.targets, form=real.pins.form, progress=progress))
        states, drawn = sets[twin.contacts], []
        told = [arm_labels(each) for each in states]
        for k in range(draws if missing else 0):
            with count_bar(f"{twin.name}: draw {k + 1}") as progress:
                pairs = zip(states, told, strict=True)
                drawn.append(joined([with_missing(each, by, missing, seed + SEEDS_APART * k, progress) for each, by in pairs]))
        learnt = [twin.part(each) for each in drawn or [joined(states)]]
        run = out / twin.name
        with epoch_bar(twin.name) as progress:
            train_in_twin(
                learnt[0].beside([each.pins for each in learnt[1:]]),
                run,
                seed=seed,
                split=seed,
                epochs=epochs,
                labelled=tuple(measured.names) if missing else (),
                progress=progress,
            )
        if twin is full:
            bare = states_touching(states, touched)
            left_out = put_beside(run, out / "sim_plus_real", bare.rows(states_like(bare, few)), few, seed=seed)
            about = {"error_px": residuals.error_px, "modes": missing.summary()[:4]}
            about |= {"friction": seen.friction, "simulated": len(learnt[0]), "contacts": len(np.unique(learnt[0].group))}
        rows.append(judged(twin.says, 0, run, real, chosen.test))
        if twin is full:
            rows.append(judged("simulated and real", labels, out / "sim_plus_real", real, chosen.test))
    for name, index in chosen.trained.items():
        run = out / f"real_{name}"
        with epoch_bar(run.name) as progress:
            train_on_real(real.rows(index), run, seed=seed, epochs=epochs, progress=progress)
        rows += [judged("real", len(index), run, real, chosen.test), quadratic_row("real", real, index, chosen.test)]
    columns = list(rows[0])
    write_page(
        out,
        sensor=spec.name,
        tested=len(chosen.test),
        frames=len(real),
        labelled=labels,
        seed=seed,
        calibrated=calibrate,
        **about,
        names=real.targets.names,
        left_out=left_out,
        columns=columns,
        rows=rows,
        problems=real.problems,
    )
    for row in rows:
        errors = ", ".join(f"{key} {row[key]:.3g}" for key in columns if key.endswith(("_corrected", "_raw")))
        print(f"{row['trained_on']}, {row['labelled_frames']} labelled, {row['model']}: {errors}")
    for path in (write_table(out / "study.csv", rows), out / "index.html"):
        print(f"wrote {path}")
