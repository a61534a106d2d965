"""Commands that make data sets and models.

- ``twin dataset``: a simulated recording with ground truth.
- ``twin train``: a model from labelled recordings.
- ``twin evaluate``: how good a trained model is.
- ``twin predict``: the pose in each frame.
- ``twin pack``: a small copy of a trained model.
- ``twin surrogate``: a fast surrogate model of a sensor's finite elements.
- ``twin demonstrate``: episodes of a task by a scripted expert.
- ``twin learn``: a policy of a task.
- ``twin convert``: records in the formats of other tools.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Option

from twin.cli import app, options
from twin.cli.options import Formerly, call, each_once, finite, load_if_named, names_in, print_lines
from twin.errors import OptionError
from twin.progress import Progress
from twin.types import FINE, Quality

if TYPE_CHECKING:
    from training.environments.demonstrations import Demonstrations
    from training.environments.learn import Learnt
    from training.generation.run import Simulated
    from training.studies.evaluation import Evaluation, Predictions
    from training.studies.train import TrainedRun
    from training.surrogate.fit import Distilled
    from twin.records import Converted


TaskName = Annotated[str, Option("--task", metavar="T", help="EdgeFollow, SurfaceFollow, ContourFollow, GentlePress, ...")]
RandomiseEpisodes = Annotated[str | None, Option("--randomise", metavar="R", help="domain randomisation of episodes, e.g. moves")]
OwnSurrogate = Annotated[Path | None, Option("--surrogate", metavar="FILE", help="surrogate model of your own sensor")]
HISTORY, ESTIMATOR = "history-dependent friction; switch it off to measure its effect", "first train a state estimator of place and force"
FrictionHistory = Annotated[bool, Option("--friction-history/--no-friction-history", help=HISTORY), Formerly("memory")]
StateEstimator = Annotated[bool, Option("--state-estimator/--no-state-estimator", help=ESTIMATOR), Formerly("sight")]
TaskObjects = Annotated[str | None, Option("--objects", callback=each_once, help="objects instead of the task's, with commas")]


@app.command("dataset", goes_on=True)
def make_dataset(
    experiment: options.Experiment,
    sensor: options.Sensor,
    count: Annotated[int, Option(min=1, metavar="N", help="contacts")],
    out: options.Out,
    wide: Annotated[bool, Option("--wide", help="slightly larger ranges, for a training set")] = False,
    obj: options.TouchedObject = None,
    images: Annotated[Literal["raw", "gray", "processed", "none"], Option(help="kind of pictures")] = "raw",
    states: Annotated[Literal["all", "end"], Option(help="states of a contact that become frames")] = "end",
    randomise: Annotated[str | None, Option(metavar="R", help="domain randomisation: a name or a file; none by default")] = None,
    seed: Annotated[int | None, Option(min=0, help="seed of all samples; the experiment's own if not given")] = None,
    workers: options.Workers = options.CORES,
    scheduler: Annotated[str, Option(metavar="ADDRESS", help="address of a running Dask scheduler")] = "",
    quality: Annotated[Quality | None, Option(help=options.QUALITY, show_default="rasterised")] = None,
    residual: options.Residual = False,
    elements: options.Elements = FINE,
    also: options.Also = None,
    *,
    progress: Progress,
) -> "Simulated":
    """Simulate a labelled data set with ground truth.

    It simulates the contacts of an experiment and writes them in the format of recordings. For each contact a pose and a move are sampled
    from the experiment's ranges, in robot coordinates ('twin experiments' lists them). Finite elements follow the arm's path, and the last
    state, or every converged state, becomes a frame. A contact that does not converge is listed, and sampled again.

    \b
    --images raw        the camera's frames
             gray       their luminance
             processed  cropped and thresholded, like recordings
             none       pins alone, without rendering (vgnn and the other graph
                        networks train on them; 'twin train' reads them like
                        frames)
    --states all        also the states on the path, each with its own label. All
                        states of a contact share a path_id, and they are all
                        either in the training or in the validation part
    --randomise R       domain randomisation between contacts: a name ('twin
                        randomisations') or a file

    \b
    Writes:
      images/ or frames_bw/, init_0.png, targets.csv, meta.json: as in a recording
      move_executed.csv   whether the move of each frame was executed
      truth.zarr          caps (mm, px), pins with noise, forces, torque, areas in
                          contact and sliding, the object's pose: one row a frame
      draws.csv           sampled parameters of each contact; failures.csv:
                          samples that failed
      generation.json     all resolved specifications and options
      made_by.json        the code that made it; a version with other code for
                          contacts does not resume the data set, because its
                          frames would differ
      records/            one for each finished contact, from which the same
                          command resumes, also with a larger --count
      lerobot/, huggingface/, mcap/: with --also, when the data set is finished

    The result depends on the options alone. It does not depend on the number of workers or on interruptions, to the last byte.

    \b
    Examples:
      twin dataset --experiment surface-2d --sensor mg400-331 --count 1000 \\
          --images none --randomise contact --workers 8 --out sim/surface
      twin dataset --experiment edge-2d --sensor ur5-331 --count 200 \\
          --out sim/edge --scheduler tcp://192.168.0.10:8786
    """
    from scenes import load_experiment
    from training.generation.run import config_for, simulate_dataset

    config = call(config_for, locals(), experiment=load_experiment(experiment, wide=wide))
    return call(simulate_dataset, locals())


def require_one_recording(folders: list[Path], table: Path | None, no_contact: Path | None) -> list[Path]:
    """The recordings. A table or a no-contact frame from elsewhere is allowed for a single recording only, and is attached to it."""
    from twin.frames import frames_at

    if len(folders) > 1 and (table or no_contact):
        raise OptionError("`table` and `no_contact` belong to one recording; with several `data` put each table beside its frames")
    return [frames_at(folder, table, no_contact) for folder in folders]


@app.command("train", goes_on=True)
def train(
    model: Annotated[str, Option(help="vgnn, touch, steered, tac-vgnn, tac-vgnn-release, gnn, cnn-v1 or cnn-v2")],
    sensor: options.Sensor,
    data: Annotated[list[Path], Option(metavar="DIR", help="labelled recording; give it once for each of several")],
    out: Annotated[Path, Option(metavar="RUN", help="folder of the run; made if missing")],
    target: options.Target = "surface-2d",
    label_kind: Annotated[str, Option(help="corrected or raw"), Formerly("labels")] = "corrected",
    seed: Annotated[int, Option(min=0, max=options.MOST_SEED, help="seed of weights and order")] = 0,
    split: Annotated[int, Option(min=-1, max=options.MOST_SEED, help="seed of the held-out fifth; -1: nothing is held out")] = 0,
    epochs: Annotated[int | None, Option(help="epochs of training, instead of the model's own number")] = None,
    batch: Annotated[int | None, Option(help="batch size, instead of the model's own")] = None,
    members: Annotated[int | None, Option(help="networks in the ensemble")] = None,
    kernel: Annotated[
        bool | None, Option("--kernel/--no-kernel", help="Gaussian process beside the networks; slow for thousands of rows")
    ] = None,
    max_minutes: Annotated[float | None, Option(min=0, callback=finite, help="stop after the epoch that passes this time")] = None,
    threads: options.Threads = None,
    device: options.Device = "auto",
    form: options.FormOrAuto = None,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    pipeline: options.Tuning = None,
    *,
    progress: Progress,
) -> "TrainedRun":
    """Train a model that estimates the pose from a frame.

    \b
    vgnn              ours: Voronoi graph network on matched pins, ensemble,
                      calibrated 90 % intervals
    steered           ours for edges with directions on the whole circle
    touch             ours for forces: modes of the pins and light of the caps,
                      ensemble and Gaussian process; needs a few hundred frames.
                      Trained on simulated contacts, it also estimates contact
                      maps; trained on simulated drags, also slip
    tac-vgnn          the paper's network: Delaunay graph, Voronoi areas; dense
                      layers 96, 64
    tac-vgnn-release  the same with the published code's dense layers: 128, 96
    gnn               the paper's graph network: 6 nearest neighbours, no areas
    cnn-v1, cnn-v2    convolutional networks of 5 x 256 and 5 x 48 filters, on
                      128 x 128 px

    --target selects the labels, which are columns of the recording's table. It is a preset (surface-2d: pose_2 pose_6; surface-2d-shear:
    also move_1 move_6; surface-3d: pose_3 pose_4 pose_5; edge-2d; edge-3d; edge-circle; contact) or names separated by commas. With
    --label-kind corrected, the labels do not contain moves that move_executed.csv or labels_corrected.csv beside the table marks as not
    executed.

    contact stands for all labels of the table that describe a contact: poses and moves that vary, measured forces (Fx, Fy, Fz in N). For
    simulated contacts these are also force_x, force_y, force_z (N, of the skin on the object, sensor frame), torque_z (N mm, about the
    sensor's axis), contact_area (mm2), slip_share (0 to 1) and contact (0 or 1).

    Depth and angle of simulated contacts are relative to the touched surface of any shape: the indentation along the normal at the nearest
    point, and the angle from this normal. So data sets of several objects can be joined: give --data once for each.

    A random fifth of the rows is held out for 'twin evaluate'. For simulated data it is a fifth of the contacts, with all their states.
    --split is the seed of this choice; with --split -1 all rows are used for training. The choice depends on the frames' names, not on the
    order of the table.

    \b
    Writes to --out: config.json (resolved, with the sensor and the parameters of
    the pipeline), curves.csv, weights.pt, maps.safetensors and slip.safetensors
    (touch, simulated contacts and drags), and checkpoint.pt while it runs. The
    same command resumes an interrupted run, if frames and labels are still the
    same.

    \b
    Example:
      twin train --model vgnn --sensor mg400-331 --data recordings/mine \\
          --target surface-2d --out runs/mine
    """
    from training.studies.train import train_model

    recordings, kept_out = require_one_recording(data, table, no_contact), None if split < 0 else split
    return call(train_model, locals(), split=kept_out)


@app.command("evaluate")
def evaluate(
    run: Annotated[Path, Argument(help="folder of a training run, or a sensor whose weights are shipped")],
    data: Annotated[list[Path], Option(metavar="DIR", help="labelled recording; give all that the run was trained on")],
    out: options.Out,
    rows: Annotated[str, Option(help="validation or all")] = "validation",
    label_kind: Annotated[str, Option(help="truth in predictions.csv and errors.png: corrected or raw"), Formerly("labels")] = "corrected",
    robustness: Annotated[bool, Option("--robustness", help="also evaluate changed images (five times the frames)")] = False,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    *,
    progress: Progress,
) -> "Evaluation":
    """Evaluate a trained model on a labelled recording.

    \b
    --rows validation  held-out frames: the fifth of the run's own recording that
                       was not used for training, by the frames' names
    --rows all         every row, for a recording that was not used for training

    Weights for several kinds of contact, such as those of ur5-331 for its binary pictures, are evaluated with --rows all on the labels that
    vary in the recording. The share of frames that they classify as each kind is printed.

    \b
    Writes:
      predictions.csv  image_name; COLUMN_true, _pred, _lo90, _hi90 of every
                       label, by its column in the recording's table (pose_2
                       is the depth of an MG400); executed_probability, valid
      metrics.json     mean absolute errors against raw and corrected labels,
                       overall and by depth, angle and shear; coverage of the 90 %
                       intervals; slope of the angle's error on the twist (move_6)
                       where it was not executed; ms per frame
      errors.png

    With --robustness it also writes robustness.csv: errors on changed frames (1 % scale, 2 px shift, 1 deg turn, 5 pins erased, each in a
    random direction), and their increase over the errors on the unchanged frames.

    \b
    Example:
      twin evaluate runs/mine --data recordings/mine --out out/errors
    """
    from training.studies.evaluation import evaluate_run

    recordings = require_one_recording(data, table, no_contact)
    return call(evaluate_run, locals())


@app.command("predict")
def predict(
    run: Annotated[Path, Argument(help="folder of a training run, or a sensor whose weights are shipped")],
    frame: Annotated[Path, Argument(help="frame, folder of frames, video or recording")],
    maps: Annotated[Path | None, Option(metavar="DIR", help="folder for the contact maps of each frame")] = None,
    sequence: Annotated[bool, Option("--sequence", help="the frames are a sequence in time: estimate slip, too")] = False,
    table: options.Table = None,
    no_contact: options.NoContact = None,
) -> "Predictions":
    """Estimate the pose in every frame, with its 90 % interval.

    The model contains its sensor and pipeline, and a frame of another sensor is refused. If there is a frame without contact (init_0.png)
    in the recording or beside a single picture, displacements of pins are relative to that frame. The exit code is 0 if at least one frame
    gave a pose.

    With --maps DIR it also writes, for each frame, the pressure and the shear over the skin, the contact patch and the deformed skin:
    arrays (NAME.npz) and a picture (NAME.png). The model must be touch, trained on simulated contacts.

    With --sequence the frames are a sequence in time, as those of a video, and a model that was trained on simulated drags also estimates
    slip: slip_begins and slip_whole (probabilities that a tenth of the contact, and that all of it, slides), slip_sliding (share of the
    contact that slides under the drag, 0 to 1), slip_left (drag in mm until all slides) and slip_direction (deg, sensor frame, of the
    object over the skin).

    \b
    Examples:
      twin predict runs/mine frame.png
      twin predict runs/forces recordings/mine --maps out/maps
      twin predict runs/forces drag.mp4 --sequence
    """
    from training.studies.evaluation import predict_frames
    from twin.frames import frames_at

    return predict_frames(run, frames_at(frame, table, no_contact), maps=maps, sequence=sequence)


@app.command("pack")
def pack_run(run: Annotated[Path, Argument(help="folder of a run of vgnn, touch or steered")], out: options.Out) -> None:
    """Write a small copy of a finished training run.

    Its numbers have half the precision, and its size is less than a tenth. Every command that takes a RUN takes it. This packs the run of
    a study:

    \b
    Example:
      twin study sim-to-real --sensor mg400-331 --frames DIR \\
          --draws 2 --epochs 60 --out study
      twin pack study/sim_only --out training/weights/mg400-331 --force
    """
    from training.estimate.estimator import PoseEstimator
    from training.runs.run_files import WEIGHTS, pack

    PoseEstimator.load(run)  # says what is wrong with a folder that holds no run
    size = pack(run, out)
    print_lines([f"wrote {out / WEIGHTS} ({size / 1e3:.0f} kB), {out / 'config.json'}"])


@app.command("surrogate")
def make_surrogate(
    sensor: options.Sensor,
    out: Annotated[Path, Option(metavar="FILE", help="file to write, *.safetensors")],
    paths: Annotated[int, Option(metavar="N", min=10, help="solved paths to train on, about 6 s each on one core")] = 120,
    seed: Annotated[int, Option(min=0, help="seed of the sampled paths")] = 0,
    workers: options.Workers = options.CORES,
    *,
    progress: Progress,
) -> "Distilled":
    """Make a fast surrogate model of a sensor's finite elements.

    Finite elements solve random contacts: plates, balls, cylinders, edges and prisms that press, shear, twist, roll, leave and return. The
    surrogate is the linear skin at small strain, with exact contact and friction at 271 nodes, and a small network for the effects of
    large deformations. Training starts from the network of mg400-331. A surrogate takes about a sixtieth of the time, and less if many
    contacts are computed together. Every fifth path is held out; the errors on it are printed and stored in the file.

    The package contains surrogates of the shipped sensors; environments take others with surrogate=FILE.

    \b
    Example:
      twin surrogate --sensor mg400-331 --out mine.safetensors
    """
    from training.surrogate.fit import distil

    return call(distil, locals())


@app.command("demonstrate", goes_on=True)
def demonstrate(
    task: TaskName,
    sensor: options.Sensor,
    out: options.Out,
    episodes: Annotated[int, Option(min=1, metavar="N", help="solved episodes")] = 50,
    randomise: RandomiseEpisodes = None,
    surrogate: OwnSurrogate = None,
    objects: TaskObjects = None,
    video: Annotated[bool, Option("--video", help="pictures as video, which loses detail")] = False,
    seed: Annotated[int, Option(min=0, max=options.MOST_SEED, help="seed of the episodes")] = 0,
    *,
    progress: Progress,
) -> "Demonstrations":
    """Record demonstrations of a task by a scripted expert, for imitation learning.

    The expert knows the true state. Its solved episodes become a LeRobot data set (pip install 'tactip-twin[gym,records]'); the others are
    left out. The same command adds missing episodes, also with a larger --episodes.

    \b
    Each step has:
      observation.images.tactip       the sensor's frame
      observation.tactile.pins        the pins that the pipeline finds in it, px
      observation.tactile.wrench      force, N, and torque, N mm, on the object
      observation.state               the tool's pose, mm and deg
      observation.environment_state   the goal of the task
      action                          the environment's action, -1 to 1

    \b
    Example:
      twin demonstrate --task EdgeFollow --sensor mg400-331 --out out/demos
    """
    from training.environments.batch import Options
    from training.environments.demonstrations import DemonstrationPlan
    from training.environments.demonstrations import demonstrate as record

    chosen = call(Options, locals(), objects=names_in(objects) if objects else None)
    return record(call(DemonstrationPlan, locals(), options=chosen), out, video=video, progress=progress)


@app.command("learn")
def learn(
    task: TaskName,
    sensor: options.Sensor,
    out: options.Out,
    observation: Annotated[str, Option(help="pins, image, graph, pose or oracle")] = "pins",
    randomise: RandomiseEpisodes = None,
    surrogate: OwnSurrogate = None,
    objects: TaskObjects = None,
    friction_history: FrictionHistory = True,
    state_estimator: StateEstimator = True,
    minutes: Annotated[float, Option(min=0, callback=finite, help="maximum time")] = 30.0,
    environments: Annotated[int, Option(min=2, help="number of environments that are stepped together")] = 32,
    fem: Annotated[int, Option(min=0, metavar="N", help="episodes with finite elements for the evaluation")] = 0,
    seed: Annotated[int, Option(min=0, max=options.MOST_SEED, help="seed of weights and episodes")] = 0,
    *,
    progress: Progress,
) -> "Learnt":
    """Train a policy of a task by reinforcement learning.

    The task's environments run together on the surrogate model of the sensor. Proximal policy optimisation (stable-baselines3; pip install
    'tactip-twin[rl]') trains until 97 % of the newest 100 episodes are solved, or the time is over. Then the policy is evaluated on 100
    other episodes, and with --fem N on N episodes with finite elements and rasterised frames through the real pipeline.

    \b
    Writes:
      policy.safetensors  for 'twin policy'
      learning.csv, learning.png, result.json

    \b
    Example:
      twin learn --task SurfaceFollow --sensor mg400-331 --out out/learnt
    """
    from training.environments.batch import Options
    from training.environments.learn import LearnPlan, learn_policy

    chosen = call(Options, locals(), objects=names_in(objects) if objects else None)
    plan = call(LearnPlan, locals(), options=chosen, fem_episodes=fem, sight=state_estimator)
    return learn_policy(plan, out, progress=progress)


# Formats that can be written, as in ``twin.records.FORMATS``, whose import would load the pin detection.
Format = Literal["recording", "lerobot", "huggingface", "mcap"]


@app.command("convert")
def convert_command(
    sources: Annotated[list[Path], Argument(metavar="SOURCE...", help="recordings, sessions, or converted records")],
    to: Annotated[Format, Option(metavar="FORMAT", help="recording, lerobot, huggingface or mcap")],
    out: options.Out,
    sensor: Annotated[str | None, Option(metavar="S", help="sensor for the pin detection; by default that of a source")] = None,
    task: Annotated[str, Option(metavar="TEXT", help="task of the episodes; by default that of each source")] = "",
    video: Annotated[bool, Option("--video", help="with lerobot: pictures as video, which loses detail")] = False,
    *,
    progress: Progress,
) -> "Converted":
    """Convert records to other tools' formats, and back.

    A SOURCE is a recording, a simulated data set, a collection, the session of 'twin live --record' or 'twin servo --record', or the output
    of this command. One contact path, or one round of a servo, is one episode.

    \b
    --to recording    pictures with targets.csv, which every command here reads
         lerobot      LeRobotDataset v3; pictures lossless (PNG), or with --video
         huggingface  pictures with metadata, for 'imagefolder' and the viewer
         mcap         a file with ROS 2 messages for each episode

    Every format contains the picture, the time, and, if the source has them, pins, pose, move, wrench, estimate and action. Pins are
    found in the pictures if the source has none and its sensor is known. docs/records.md has names, units, frames and axes.

    After an interruption the same command resumes. It also adds new sources: several rounds become one data set. Existing episodes are
    not written again.

    \b
    Examples:
      twin convert out/servo/session --to lerobot --out out/dataset
      twin convert sim/surface --to mcap --out out/bags
      twin convert recordings/mine --sensor mine.toml --to huggingface \\
          --out out/pictures
    """
    from scenes import load_sensor
    from twin.records import convert

    return convert(sources, out, to, sensor=load_if_named(load_sensor, sensor), task=task, video=video, progress=progress)
