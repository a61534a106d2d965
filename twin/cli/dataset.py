"""``twin dataset``: simulated recordings with ground truth."""

from enum import StrEnum
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import CORES, Across, Out, Quality, Sensor, Workers, if_given
from twin.types import FINE

HELP = """Simulate a labelled data set: the contacts of an experiment, in the recordings' own format, with ground truth.

For each contact a pose and a move are drawn from the experiment's ranges ('twin experiments' lists them; robot coordinates).
The arm's way is followed by finite elements, and the last state, or every converged one, becomes a frame. A contact that
does not converge is listed, and drawn anew.

\b
--images raw        the camera's frames
         gray       their luminance
         recording  cropped and thresholded, as the recordings are
         none       pins alone, without rendering (vgnn and the other graph
                    networks train on them; 'twin train' reads them like frames)
--states all        also the states on the way, labelled by how far tap and move have
                    gone; all states of a contact share a path_id, and training and
                    validation parts are split by it
--randomise R       what differs from contact to contact ('twin randomisations')

\b
Writes:
  images/ or frames_bw/, init_0.png, targets.csv, meta.json   as in a recording
  move_executed.csv   whether each frame's move had been made
  truth.zarr          caps (mm, px), pins with noise, forces, torque, areas in contact
                      and sliding, the object's pose: one row a frame
  draws.csv           what was drawn for each contact; failures.csv: draws that failed
  generation.json     everything resolved
  made_by.json        the code that makes it; a version whose code for contacts differs
                      does not go on with it, as its frames would differ
  records/            one for each finished contact; with them the same command goes on
                      after any end, or to a larger --count

The result depends on the options alone. It is the same, byte by byte, with any number of workers and after any interruption.

\b
Examples:
  twin dataset --experiment surface-2d --sensor mg400-331 --count 1000 --images none \\
      --randomise contact --workers 8 --out sim/surface
  twin dataset --experiment edge-2d --sensor ur5-331 --count 200 --out sim/edge \\
      --scheduler tcp://192.168.0.10:8786
"""


class Images(StrEnum):
    """What pictures a data set holds."""

    RAW = "raw"
    GRAY = "gray"
    RECORDING = "recording"
    NONE = "none"


class States(StrEnum):
    """Which states of a contact become frames."""

    ALL = "all"
    END = "end"


@app.command("dataset", help=HELP)
def dataset(
    experiment: Annotated[str, typer.Option("--experiment", metavar="E", help="experiment name ('twin experiments') or file")],
    sensor: Sensor,
    count: Annotated[int, typer.Option("--count", min=1, metavar="N", help="contacts")],
    out: Out,
    object_: Annotated[
        str | None, typer.Option("--object", metavar="O", help="object name, specification or mesh file; the experiment's own if not given")
    ] = None,
    images: Annotated[Images, typer.Option("--images", help="what pictures to make")] = Images.RAW,
    states: Annotated[States, typer.Option("--states", help="which states of a contact become frames")] = States.END,
    randomise: Annotated[
        str | None, typer.Option("--randomise", metavar="R", help="randomisation name or file; nothing if not given")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="of all that is drawn; the experiment's own if not given")] = None,
    workers: Workers = CORES,
    scheduler: Annotated[str, typer.Option("--scheduler", metavar="ADDRESS", help="of a running Dask scheduler, whose workers do it")] = "",
    quality: Annotated[
        Quality | None, typer.Option(help="samples per pixel", show_default="preview for --images recording, else standard")
    ] = None,
    across: Across = FINE,
) -> None:
    from scenes import load_experiment, load_object, load_randomisation, load_sensor
    from training.generation.simulate import config_for, simulate_dataset
    from twin.cli.output import tell
    from twin.cli.progress import shown

    config = config_for(
        load_sensor(sensor),
        load_experiment(experiment),
        touched=if_given(load_object, object_),
        images=images.value,
        states=states.value,
        randomisation=if_given(load_randomisation, randomise),
        seed=seed,
        quality=quality.value if quality else None,
        across=across,
    )
    with shown() as progress:
        made = simulate_dataset(config, out, count, workers=workers, scheduler=scheduler, progress=progress)
    tell(made)
