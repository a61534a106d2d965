"""``twin study objects``: what a model makes of objects that it never saw."""

from typing import Annotated

import typer

from twin.cli.options import CORES, Across, Out, Sensor, Workers, names_in, writable_folder
from twin.cli.study import study
from twin.types import FINE

TRAIN = "plane,ball-10,sphere,ball-40,ball-80,hexagon-rod,square-rod,round-bar,triangle-rod"
UNSEEN = "cylinder,edge"
HELP = """Train in the twin on several objects, and judge on objects that were never touched.

\b
  twin study objects --sensor mg400-331 --train plane,sphere,hexagon-rod --unseen cylinder,edge --out out/objects

Two models learn from as many simulated contacts (pins alone, every state on their way): 'mixed' from --count of each object of
--train, the other from the first of them alone. Both are judged on --tests other contacts of every object, seen or not.

Labels mean the same on every object: depth is the indentation along the surface's normal at the place nearest to the dome's
centre, the angle that from this normal, as the labels of a flat plate touched alike. --experiment gives the ranges that are judged;
the one that it names as wider is trained on.

The same command goes on where it was ended. The run that learnt several objects serves wherever a RUN is asked for:

\b
  twin servo --object can --model out/objects/mixed --out out/can

\b
Writes to --out: mixed/ and one named after the first object, each a RUN; sim/ and tests/, a data set for each object
(as 'twin dataset' writes them); objects.csv, index.html.
"""


@study.command("objects", help=HELP)
def study_objects(
    sensor: Sensor,
    out: Out,
    train: Annotated[str, typer.Option("--train", help="objects to train on, with commas between; the first also alone")] = TRAIN,
    unseen: Annotated[str, typer.Option("--unseen", help="objects never trained on, with commas between")] = UNSEEN,
    count: Annotated[int, typer.Option("--count", min=2, metavar="N", help="contacts of each object to train on")] = 100,
    tests: Annotated[int, typer.Option("--tests", min=1, metavar="N", help="other contacts of each object to judge on")] = 50,
    experiment: Annotated[str, typer.Option("--experiment", metavar="E", help="contacts to judge on ('twin experiments')")] = "objects-2d",
    randomise: Annotated[str, typer.Option("--randomise", metavar="R", help="what differs from contact to contact")] = "moves",
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the contacts and the weights")] = 0,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="of both trainings, instead of the study's own number")] = None,
    workers: Workers = CORES,
    across: Across = FINE,
) -> None:
    from scenes import load_experiment, load_object, load_randomisation, load_sensor
    from training.across_objects import study as objects
    from training.across_objects.page import write_page
    from training.dataset import load_dataset
    from training.generation import generate
    from training.sim_to_real.study import train_in_twin
    from twin.cli.progress import count_bar, epoch_bar, rate_bar
    from twin.report.table import write_table

    spec, judged = load_sensor(sensor), load_experiment(experiment)
    plan = objects.Plan(
        sensor=spec,
        experiment=judged,
        wider=load_experiment(judged.wider or experiment),
        randomisation=load_randomisation(randomise),
        train=tuple(load_object(name) for name in names_in(train)),
        unseen=tuple(load_object(name) for name in names_in(unseen)),
        count=count,
        tests=tests,
        seed=seed,
        across=across,
    )
    writable_folder(out)
    sets = {}
    for folder, config, contacts in plan.sets():
        with rate_bar(folder) as progress:
            generate(out / folder, config, contacts, workers=workers, progress=progress)
        with count_bar(f"{folder}: states") as progress:
            sets[folder] = load_dataset(out / folder, spec, judged.targets, progress=progress)
    runs = {}
    for name, data in plan.trained_on(sets).items():
        runs[name] = out / name
        with epoch_bar(name) as progress:
            train_in_twin(data, runs[name], seed=seed, split=None, epochs=epochs, progress=progress)
    rows = objects.table(plan, runs, sets)
    said = objects.verdicts(plan, rows, judged.targets)
    write_page(out, plan=plan, names=judged.targets, ranges=judged.ranges(), rows=rows, verdicts=said)
    for row in rows:
        errors = ", ".join(f"{name} {row[f'{name}_error']:.3g} ({row[f'{name}_times']:.2f} times)" for name in judged.targets)
        print(f"{row['model']}, {row['object']} ({'seen' if row['seen'] else 'never seen'}): {errors}")
    print("\n".join(said))
    for path in (write_table(out / "objects.csv", rows), out / "index.html"):
        print(f"wrote {path}")
