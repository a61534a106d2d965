"""Commands of ``twin study``: experiments that compare models.

- ``twin study servo``: several models follow the outlines of several objects.
- ``twin study objects``: how well a model estimates poses on unseen objects.
- ``twin study sim-to-real``: how well models that are trained in the twin do on real frames.
- ``twin study tac-vgnn``: the comparison of the Tac-VGNN paper.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import BadParameter, Option

from twin.cli import group, options
from twin.cli.options import Formerly, call, each_once, finite, names_in
from twin.errors import ErrorsAs
from twin.progress import Progress
from twin.types import FINE

if TYPE_CHECKING:
    from hardware.servo.following import ServoStudy
    from training.studies import objects, sim_to_real, tac_vgnn

study = group("study", "Experiments that compare models.")

# The objects of the Tac-VGNN paper.
OBJECTS = "can,mesh-can,square,prism,tin-box"


@study.command("servo")
def study_servo_command(
    models: Annotated[list[Path], Option("--model", metavar="RUN", help="folder of a training run; give it once for each model")],
    out: options.Out,
    objects: Annotated[str, Option(callback=each_once, help="names separated by commas")] = OBJECTS,
    servo: options.ServoName = "surface",
    steps: Annotated[int | None, Option(min=1, help="steps on each object, instead of once around it")] = None,
    seed: Annotated[int, Option(min=0, help="seed of the twin's noise")] = 0,
    plain_light: options.PlainLight = False,
    *,
    progress: Progress,
) -> "ServoStudy":
    """Follow the Tac-VGNN paper's five objects with each model.

    It runs in the twin, and compares the errors of the models.

    \b
    Example:
      twin study servo --model out/gnn --model out/tac-vgnn --out out/study

    Writes to --out: a folder for each model and object as 'twin servo' writes it, index.html, study.csv, study.png.
    """
    from hardware.servo.following import ServoStudyPlan, study_servo
    from training.estimate.estimator import load_by_name

    return study_servo(call(ServoStudyPlan, locals(), models=load_by_name(models)), out, progress=progress)


TRAIN = "plane,ball-10,sphere,ball-40,ball-80,hexagon-rod,square-rod,round-bar,triangle-rod"
UNSEEN = "cylinder,edge"


@study.command("objects", goes_on=True)
def study_objects(
    sensor: options.Sensor,
    out: options.Out,
    train: Annotated[str, Option(help="training objects, separated by commas; the first also alone")] = TRAIN,
    unseen: Annotated[str, Option(help="unseen objects, separated by commas")] = UNSEEN,
    count: Annotated[int, Option(min=2, metavar="N", help="training contacts of each object")] = 100,
    tests: Annotated[int, Option(min=1, metavar="N", help="held-out contacts of each object for the evaluation")] = 50,
    experiment: Annotated[str, Option(metavar="E", help="contacts for the evaluation ('twin experiments')")] = "objects-2d",
    randomise: Annotated[str, Option(metavar="R", help="domain randomisation ('twin randomisations')")] = "moves",
    seed: Annotated[int, Option(min=0, max=options.MOST_SEED, help="seed of the contacts and the weights")] = 0,
    epochs: Annotated[int | None, Option(min=1, help="epochs of both trainings, instead of the study's own")] = None,
    workers: options.Workers = options.CORES,
    elements: options.Elements = FINE,
    *,
    progress: Progress,
) -> "objects.ObjectsResult":
    """Train on several objects, and evaluate on others.

    \b
    Example:
      twin study objects --sensor mg400-331 --train plane,sphere,hexagon-rod \\
          --unseen cylinder,edge --out out/objects

    Two models are trained on the same number of simulated contacts (pins alone, every state on the path). 'mixed' is trained
    on --count contacts of each object of --train, the other on the first of these objects alone. Both are evaluated on --tests held-out
    contacts of every object, including the unseen objects (--unseen).

    Labels have the same meaning on every object. The depth is the indentation along the surface's normal at the point nearest to the dome's
    centre, and the angle is measured from this normal, as on a flat plate. --experiment gives the ranges in which the
    models are evaluated; they are trained on its wider ranges.

    The same command resumes an interrupted study. Every command that takes a RUN takes the run that was trained on several objects:

    \b
    Example:
      twin servo --object can --model out/objects/mixed --out out/can

    \b
    Writes to --out: mixed/ and one named after the first object, each a RUN; sim/
    and tests/, a data set for each object (as 'twin dataset' writes them);
    objects.csv, index.html.
    """
    from training.studies import objects

    return objects.run(call(objects.ObjectsPlan, locals()), out, progress=progress)


@study.command("sim-to-real", goes_on=True)
def study_sim_to_real(
    sensor: options.Sensor,
    frames: Annotated[Path, Option(metavar="DIR", help="labelled real recording")],
    out: options.Out,
    num_labelled: Annotated[int, Option(min=8, metavar="N", help="labelled real frames"), Formerly("labels")] = 40,
    seed: Annotated[int, Option(min=0, max=options.MOST_SEED, help="seed of the choice of frames, the contacts and the weights")] = 0,
    experiment: Annotated[str, Option(metavar="E", help="experiment of the recording")] = "surface-2d",
    contacts: Annotated[str | None, Option(metavar="E", help="experiment to simulate; by default one wider than --experiment")] = None,
    draws: Annotated[int, Option(min=1, help="samples of the pins' discrepancy for each contact")] = 2,
    count: Annotated[int, Option(min=10, metavar="N", help="contacts to simulate")] = 500,
    sim: Annotated[
        list[Path] | None, Option(metavar="DIR", exists=True, file_okay=False, help="existing simulated data set; several are joined")
    ] = None,
    calibrate: Annotated[bool, Option("--calibrate", help="fit the specification to the labelled frames first")] = False,
    ablate: Annotated[bool, Option("--ablate", help="also train without one ingredient at a time (ablation)")] = False,
    epochs: Annotated[int | None, Option(min=1, help="epochs of every training, instead of the model's own")] = None,
    workers: options.Workers = options.CORES,
    elements: options.Elements = FINE,
    *,
    progress: Progress,
) -> "sim_to_real.SimToRealResult":
    """Train in the twin or on real frames, evaluate on real ones.

    \b
    Example:
      twin study sim-to-real --sensor mg400-331 --frames DIR --num-labelled 40 \\
          --seed 0 --out out/sim-to-real

    --experiment is the experiment of the recording, with its labels; --contacts is the experiment that is simulated.

    First, --num-labelled real frames are sampled at random from four fifths of the recording. The friction of the simulated contacts is
    sampled from the friction of these frames (domain randomisation). A Gaussian process of the label is fitted to the discrepancy between
    the twin's pins and the real pins on these frames, and sampled --draws times for every simulated contact. With --calibrate the
    specification is fitted to these frames first ('twin calibrate contact'; about an hour). All models are evaluated on the held-out fifth:

    \b
      simulated            vgnn trained on simulated contacts alone (steered, if
                           a label is a direction on the whole circle); its 90 %
                           intervals are calibrated on the labelled frames
      simulated and real   the same, averaged with a Gaussian process of the pins
                           of both simulated contacts and labelled frames
                           (co-kriging); also model inversion, with 0 to 500
                           labelled frames
      ..., N without labels
                           vgnn or steered, trained on the labelled frames and on
                           N others, whose labels model inversion estimates
      real                 vgnn or steered, and a quadratic regression, trained on
                           as many real frames, on 500 and on all
      ..., even            the same with frames that are nearest to an even
                           sequence ('twin collect --design even')
      --ablate             also models trained on simulated contacts with one
                           change each: without the discrepancy of the pins,
                           with a fifth of the contacts, a coarse mesh, one
                           friction, any friction, no moves, sampled tolerances of
                           skin and gel, and without calibration; this simulates
                           six more sets of contacts

    The contacts are simulated in --out/sim, without pictures. With --sim finished data sets of 'twin dataset' or 'twin study objects'
    are used instead (give it once for each). If a data set has pictures, the pins are those that the pipeline finds in them. The same
    command resumes an interrupted study.

    Writes to --out: sim_only/, sim_plus_real/, sim_taught/ and real_N/, each a RUN; study.csv and index.html.
    """
    from training.studies import sim_to_real

    return sim_to_real.run(call(sim_to_real.SimToRealPlan, locals()), out, progress=progress)


def numbers_in(text: str, option: str, least: int) -> tuple[int, ...]:
    """The comma-separated whole numbers, each at least ``least`` and at most the largest seed."""
    refusal = BadParameter(f"takes whole numbers with commas between, got {text!r}", param_hint=option)
    with ErrorsAs(ValueError, lambda error: refusal):
        numbers = tuple(int(part) for part in names_in(text))
    if any(not least <= number <= options.MOST_SEED for number in numbers):
        raise BadParameter(f"takes whole numbers from {least} to {options.MOST_SEED}, got {text!r}", param_hint=option)
    return numbers


MODELS = "gnn,tac-vgnn,vgnn,cnn-v2,cnn-v1"


@study.command("tac-vgnn", goes_on=True)
def study_tac_vgnn(
    data: Annotated[Path, Option(metavar="DIR", help="labelled recording")],
    sensor: options.Sensor,
    out: options.Out,
    models: Annotated[str, Option(help="names separated by commas")] = MODELS,
    seeds: Annotated[str, Option(help="seeds of weights and order, separated by commas")] = "0",
    label_kind: Annotated[str, Option(help="labels to train on: raw (as in the paper) or corrected"), Formerly("labels")] = "raw",
    target: options.Target = "surface-2d",
    split: Annotated[int, Option(min=0, max=options.MOST_SEED, help="seed of the held-out fifth")] = 0,
    epochs: Annotated[int | None, Option(min=1, help="epochs of training, instead of each model's own number")] = None,
    max_minutes: Annotated[float | None, Option(min=0, callback=finite, help="time for all trainings together")] = None,
    batches: Annotated[str, Option(help="batch sizes of the efficiency figure, separated by commas; empty: no figure")] = "64,256,512",
    contacts: Annotated[bool, Option("--contacts/--no-contacts", help="press and render the contacts of the area figure")] = True,
    device: options.Device = "auto",
    threads: options.Threads = None,
    form: options.FormOrAuto = None,
    *,
    progress: Progress,
) -> "tac_vgnn.TacVgnnResult":
    """Repeat the Tac-VGNN paper's comparison on a recording.

    It compares graphs, models and training efficiency, and shows the dependence of the Voronoi areas on depth.

    \b
    Example:
      twin study tac-vgnn --data DIR --sensor mg400-331 --out out/study \\
          --max-minutes 120

    The models (--models) are gnn, tac-vgnn, tac-vgnn-release, cnn-v1, cnn-v2, and this project's vgnn. vgnn-without-graph,
    vgnn-without-modes and vgnn-without-kernel are ablations of vgnn.

    All models are trained on the same rows and labels, and evaluated on the same held-out fifth. Each run is a folder below --out/runs, as
    'twin train' writes it. The same command resumes an interrupted study, so a study may take several days. --max-minutes is divided
    evenly among the remaining runs. A run that this limit stopped is reported as ended early.

    \b
    Writes to --out: models.csv, graphs.csv, efficiency.csv, contacts.csv,
    curves.png, efficiency.png, contacts.png, index.html, runs/.
    """
    from training.studies import tac_vgnn
    from training.studies.train import columns_of

    lists = {"models": tuple(names_in(models)), "seeds": numbers_in(seeds, "--seeds", 0), "batches": numbers_in(batches, "--batches", 1)}
    plan = call(tac_vgnn.TacVgnnPlan, locals(), target=columns_of(target), **lists)
    return tac_vgnn.run(plan, out, progress=progress)
