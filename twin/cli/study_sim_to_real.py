"""``twin study sim-to-real``: what the twin is worth on real frames."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.options import CORES, Across, Out, Sensor, Workers, if_given, writable_folder
from twin.cli.study import study
from twin.types import FINE

HELP = """Train in the twin, test on real frames, against training on real frames.

\b
  twin study sim-to-real --sensor mg400-331 --frames DIR --labels 40 --seed 0 --out out/sim-to-real

The recording's --experiment says how the arm went and what is learnt; --contacts is the experiment that is simulated.

--seed draws --labels real frames from four fifths of the recording. The friction of simulated contacts is drawn as it was on these
frames. What the twin's pins miss on them is learnt as a Gaussian process of the label, and drawn --draws times for every simulated
contact. With --calibrate the specification is fitted to these frames first ('twin calibrate contact'; about an hour). All models are
judged on the random fifth that is left:

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
    from scenes import load_experiment, load_sensor
    from training.studies import sim_to_real
    from twin.cli.output import tell
    from twin.cli.progress import shown

    plan = sim_to_real.Plan(
        sensor=load_sensor(sensor),
        frames=frames,
        experiment=load_experiment(experiment),
        contacts=if_given(load_experiment, contacts),
        labels=labels,
        seed=seed,
        draws=draws,
        count=count,
        simulated=tuple(sim or ()),
        calibrate=calibrate,
        ablate=ablate,
        epochs=epochs,
        workers=workers,
        across=across,
    )
    with shown() as progress:
        found = sim_to_real.run(plan, writable_folder(out), progress=progress)
    tell(found)
