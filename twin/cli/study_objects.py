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

Two models learn from the same number of simulated contacts (pins alone, every state on their way). 'mixed' learns from --count
contacts of each object of --train, the other from the first of these objects alone. Both are judged on --tests other contacts of every
object, seen or not.

Labels mean the same on every object. The depth is the indentation along the surface's normal at the place nearest to the dome's
centre, and the angle is measured from this normal, as if a flat plate were touched there. --experiment gives the ranges that are
judged; the experiment that it names as wider is trained on.

The same command goes on where it was ended. The run that learnt several objects can be given wherever a RUN is asked for:

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
    from training.studies import objects
    from twin.cli.output import tell
    from twin.cli.progress import shown

    plan = objects.Plan(
        sensor=load_sensor(sensor),
        experiment=load_experiment(experiment),
        randomisation=load_randomisation(randomise),
        train=tuple(map(load_object, names_in(train))),
        unseen=tuple(map(load_object, names_in(unseen))),
        count=count,
        tests=tests,
        seed=seed,
        across=across,
        epochs=epochs,
        workers=workers,
    )
    with shown() as progress:
        found = objects.run(plan, writable_folder(out), progress=progress)
    tell(found)
