"""Collects labelled frames in the recordings' own format. Each contact consists of a pose, a tap, a shear and one frame.

``collect_frames`` goes from a plan to labelled frames in a folder, and continues an interrupted collection. The arm starts ``CLEAR_MM``
from the object and lifts off by ``LIFT_MM`` between two contacts. Between two lifted poses it moves around the object on a path of
``hardware.rig.geometry``; in front of an infinite object it moves straight. A frame counts only if it was exposed after the arm reported
that it stands at the commanded pose. The table holds the reported pose.
"""

import csv
import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.arm import ArmState
from hardware.cameras.mjpeg import without_secrets
from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject
from hardware.workcell.build import Mover, Rig, RigPlan, build_rig, check_plan
from scenes import SensorSpec
from scenes.experiment import LABELS, ExperimentSpec
from scenes.files import quote
from twin.errors import ErrorsAs, FrameError, format_count
from twin.frames.folders import pictures_folder
from twin.frames.images import write_image
from twin.pins import Pipeline, measure_reference
from twin.progress import Progress, Step, silent, stage, unheard
from twin.records import KeptAlso
from twin.records.folder import read_json
from twin.rig.arm_pose import matrix_of, pose_of
from twin.store import contents, made_by, output, write_json, write_text, writes
from twin.types import Form, Frame

LOGGER = logging.getLogger(__name__)
# Distance from the object at the start and at the end, in mm.
CLEAR_MM = 50.0
# Distance from the object between two contacts, in mm.
LIFT_MM = 10.0
# Largest number of contacts that are checked before anything moves, and the usual time of a contact in s.
CHECKED_CONTACTS, CONTACT_S = 100, 4.0
# Most contacts of a collection. At a few seconds each, they take an arm months.
MOST_CONTACTS = 1_000_000
# Files of a collection, as in the published recordings: labels, description, times, and the frame without contact.
TABLE, META, LOG, REST = "targets.csv", "meta.json", "contacts.jsonl", "init_0.png"
# Distributions of contacts over an experiment's ranges: each at random; or evenly, even for the first contacts alone.
DESIGNS = ("random", "even")
COLUMNS = ("image_name", "data_name", "obj_id", "pose_id", *LABELS)


@dataclass(frozen=True)
class PlannedContact:
    """One contact to make: the label of the pose after the move (6,), and the move (6,), in mm and deg."""

    pose: np.ndarray
    move: np.ndarray


@dataclass
class Collection:
    """A folder into which labelled frames are collected.

    Parameters
    ----------
    folder : Path
        A new or empty folder, or the folder of a collection with the same ``about``, which is continued. A folder in which a start failed
        before the first frame counts as empty.
    about : dict
        Everything that the frames depend on, in types that JSON can hold.
    form : Form
        Form of the frames.
    """

    folder: Path
    about: dict[str, Any]
    form: Form

    def __post_init__(self) -> None:
        """Open the folder: check its content, and drop an unfinished line.

        Raises
        ------
        DeviceError
            The folder holds something else, or a collection with other settings.
        """
        self.pictures = self.folder / pictures_folder(self.form)
        self.folder.mkdir(parents=True, exist_ok=True)
        meta, table, about = self.folder / META, self.folder / TABLE, json.loads(json.dumps(self.about))
        other: list[str] = []
        if known := meta.is_file():
            before = read_json(meta, error=DeviceError, again="remove it if the folder holds no contacts yet")
            other = [key for key in about if before.get(key) != about[key]]
            begun = table.is_file() and table.read_bytes().count(b"\n") > 1  # whatever the lines after the header are
            if other and (begun or self.rest.is_file()):  # else a start failed, and nothing is lost
                settings = ", ".join(other)
                raise DeviceError(f"{self.folder}: holds a collection with other settings ({settings}); repeat them or give another `out`")
        elif contents(self.folder):
            raise DeviceError(f"{self.folder}: holds something else; give an empty or a new folder")
        if other or not known:
            write_json(meta, about | {"made_by": made_by(collect, inputs=about)})
        self.pictures.mkdir(exist_ok=True)
        for lines in (table, self.folder / LOG):
            if lines.is_file():
                with _on_damage(lines):
                    text = lines.read_text(encoding="utf-8")
                if not text.endswith("\n"):  # the last line is torn
                    write_text(lines, text[: text.rfind("\n") + 1])
        if not table.is_file() or not table.read_text(encoding="utf-8"):
            write_text(table, ",".join(COLUMNS) + "\n")

    @property
    def count(self) -> int:
        """Number of contacts collected so far.

        Raises
        ------
        DeviceError
            The table is damaged.
        """
        table = self.folder / TABLE
        with _on_damage(table), table.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
        if rows[:1] != [list(COLUMNS)] or any(len(row) != len(COLUMNS) for row in rows):
            raise DeviceError(f"{table}: is not the table of a collection; give another `out`")
        return len(rows) - 1

    @property
    def rest(self) -> Path:
        """Path of the frame without contact, once it has been taken."""
        return self.pictures / REST

    def keep_rest(self, frame: Frame) -> None:
        """Keep the frame without contact."""
        write_image(self.rest, frame.image)

    def keep(self, index: int, frame: Frame, label: np.ndarray, move: np.ndarray, log: dict[str, Any]) -> None:
        """Write a contact in this order: picture, line of the log, row of the table. Therefore the picture of every row exists."""
        name = f"frame_{index}_0.png"
        write_image(self.pictures / name, frame.image)
        with (self.folder / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"image_name": name, **log}) + "\n")
        row = [name, f"frame_{index}", 1, index + 1, *(f"{value:.9g}" for value in (*label, *move))]
        with (self.folder / TABLE).open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow(row)
            file.flush()
            os.fsync(file.fileno())


def _on_damage(file: Path) -> ErrorsAs[Exception]:
    """Context of reading a file of a collection, whose errors become a ``DeviceError``."""
    return ErrorsAs((ValueError, csv.Error), lambda error: DeviceError(f"{file}: is damaged ({quote(error)}); give another `out`"))


def draw_contact(experiment: ExperimentSpec, seed: int, index: int, design: str = "random") -> PlannedContact:
    """Pose and move of contact ``index`` within the experiment's ranges. They depend only on these arguments.

    With the design "even", the first contacts fill the ranges evenly, whatever their number is: they are a scrambled Sobol sequence (Sobol
    1967; scrambled by Owen 1998). In recordings of a plate, a model from 10 such contacts has the same error in depth as one from nearly 20
    random contacts.
    """
    low, high = np.array(list(experiment.ranges().values())).T
    if design == "random":
        numbers = np.random.default_rng([seed, index]).uniform(low, high)
    else:
        from scipy.stats.qmc import Sobol

        numbers, varied = low.copy(), high > low
        sequence = Sobol(int(varied.sum()), scramble=True, rng=np.random.default_rng(seed))
        shares = sequence.fast_forward(index).random(1)[0] if index else sequence.random(1)[0]
        numbers[varied] += shares * (high - low)[varied]
    return PlannedContact(numbers[:6], numbers[6:])


class WorkFrame:
    """The robot's coordinates of an experiment in front of an object (the work frame).

    Labels are those of the mounting: after ``clear`` and ``tap``, the pose with labels of 0 has the depth and the angle from the surface's
    normal that labels of 0 mean.

    Parameters
    ----------
    experiment : ExperimentSpec
    placed : PlacedObject
    """

    def __init__(self, experiment: ExperimentSpec, placed: PlacedObject) -> None:
        self._offset = np.array(experiment.clear) + np.array(experiment.tap)
        mounting = placed.mounting
        self._T = matrix_of(placed.start_pose(mounting.depth_mm(0.0)))
        turn = np.radians(mounting.angle_deg(0.0)) * mounting.out_of_plane
        self._T[:3, :3] = self._T[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        self._T[:3, 3] -= self._T[:3, :3] @ self._offset[:3]
        self._toward = mounting.axis

    def base_pose(self, label: np.ndarray, near: np.ndarray, *, away_mm: float = 0.0) -> np.ndarray:
        """The arm's pose (6,) at work coordinates (6,), ``away_mm`` back along the approach. ``near`` (6,) selects the turn about z."""
        T = matrix_of(label)
        T[:3, 3] -= away_mm * self._toward
        return pose_of(self._T @ T, near)

    def label(self, base_pose: np.ndarray) -> np.ndarray:
        """The label (6,) of the arm's pose (6,) after the tap."""
        return pose_of(np.linalg.inv(self._T) @ matrix_of(base_pose), np.zeros(6)) - self._offset


def collect(
    rig: Rig,
    experiment: ExperimentSpec,
    collection: Collection,
    count: int,
    *,
    seed: int,
    design: str = "random",
    speed: tuple[float, float],
    on_rest: Callable[[Frame], None] | None = None,
    progress: Step = unheard,
) -> int:
    """Collect contacts until the collection holds ``count``. Contacts that it already holds are not made again.

    At every end, Ctrl-C included, the arm is stopped, withdrawn (if it has come to the object) and disabled.

    Parameters
    ----------
    rig : Rig
        Connected.
    count : int
        Number of contacts in the collection at the end.
    seed : int
        Seed of the sampled contacts.
    design : {"random", "even"}
        See ``draw_contact``.
    speed : (float, float)
        Speed of the arm in mm/s and deg/s.
    on_rest : callable, optional
        Called with the frame without contact after it was kept.
    progress : Step, optional

    Returns
    -------
    int
        Number of contacts in the collection.

    Raises
    ------
    DeviceError
        The source is not live, no path leads to the object, the arm did not reach its target, the release of the arm failed, or no frame
        came.
    StoreError
        Another run collects into the folder, or the folder can't be written to.
    """
    if experiment.tap_frame != "work":
        raise DeviceError(f"{experiment.name}: its tap follows the tool's axes, but a collection taps along the work frame's; give another")
    if not rig.source.is_live:
        raise DeviceError(f"{rig.source.name}: a recording does not show this arm; give a live `camera`")
    timeout_s = rig.frame_timeout_s
    stops = _Stops(Mover(rig, speed, clear_mm=CLEAR_MM, patience_s=timeout_s), WorkFrame(experiment, rig.placed), timeout_s)
    with output(collection.folder), stops.mover.watching():
        at_object = False
        try:
            with stops.mover.watch.alert():
                stops.mover.enable()
                state = stops.go(np.zeros(6), CLEAR_MM, around=True)
                at_object = True
                if not collection.rest.is_file():
                    rest = stops.frame_after(state)
                    collection.keep_rest(rest)
                    if on_rest is not None:
                        on_rest(rest)
                for index in range(collection.count, count):
                    _collect_one(stops, experiment, collection, index, draw_contact(experiment, seed, index, design))
                    progress(index + 1, count)
        finally:
            failed = stops.mover.release(touching=at_object)
    if failed:
        raise DeviceError("; ".join(failed))
    return collection.count


def _collect_one(stops: "_Stops", experiment: ExperimentSpec, collection: Collection, index: int, contact: PlannedContact) -> None:
    """Make one contact and keep its frame: go above the place, tap, move along the surface, take the frame, lift off.

    A frame is awaited at every stop, because the skin's state depends on where the arm has been.
    """
    clear, tap = np.array(experiment.clear), np.array(experiment.tap)
    before = contact.pose - contact.move + clear
    stops.go(before, LIFT_MM, around=True)
    stops.frame_after(stops.go(before))
    stops.frame_after(stops.go(before + tap))
    confirmed = stops.go(contact.pose + clear + tap)
    frame = stops.frame_after(confirmed)
    after = stops.mover.arm.state()
    moved_mm = float(np.linalg.norm(after.pose[:3] - confirmed.pose[:3]))
    log = {"asked": [*contact.pose.tolist(), *contact.move.tolist()], "confirmed_pose": confirmed.pose.tolist()}
    log |= {"confirmed_s": confirmed.time_s, "frame_s": frame.time_s, "sequence": frame.sequence, "moved_meanwhile_mm": moved_mm}
    collection.keep(index, frame, stops.work.label(confirmed.pose), contact.move, log)
    stops.frame_after(stops.go(contact.pose + clear + tap, LIFT_MM))


@dataclass(frozen=True)
class _Stops:
    """Moves an arm from stop to stop in its work frame, and takes frames while it stands still."""

    mover: Mover
    work: WorkFrame
    frame_timeout_s: float

    def go(self, label: np.ndarray, away_mm: float = 0.0, *, around: bool = False) -> ArmState:
        """Move to work coordinates (6,), ``away_mm`` back along the approach, straight or around the object. Returns the state there."""
        with self.mover.watch.doing("moving"):
            pose = self.work.base_pose(label, self.mover.arm.state().pose, away_mm=away_mm)
            return self.mover.go_around(pose) if around else self.mover.go(pose)

    def frame_after(self, state: ArmState) -> Frame:
        """The first frame exposed after a state."""
        remedy = "check the camera, then repeat the command to continue"
        with ErrorsAs(TimeoutError, lambda error: DeviceError(f"the arm stands still, but {error}; {remedy}")):
            return self.mover.watch.frame_after(self.mover.source, state.time_s, timeout_s=self.frame_timeout_s)


@dataclass(frozen=True, kw_only=True)
class CollectPlan(RigPlan):
    """Settings of a collection, and its devices.

    Attributes
    ----------
    sensor : SensorSpec
    experiment : ExperimentSpec
        Experiment that defines the contacts.
    count : int
        Number of contacts in the folder at the end.
    seed : int or None
        Seed of the sampled contacts. None: the experiment's own seed.
    design : {"random", "even"}
        Distribution of the contacts over the experiment's ranges.
    form : Form or None
        Form of the frames. None: the form of the sensor's recordings if it has one.
    also : tuple of str
        Further formats in which each contact is kept as soon as it is made, each in a subfolder.
    """

    sensor: SensorSpec
    experiment: ExperimentSpec
    count: int
    seed: int | None = None
    design: str = "random"
    form: Form | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.count <= MOST_CONTACTS:
            raise DeviceError(f"`count` {self.count}: a collection has 1 to {MOST_CONTACTS} contacts")
        if self.design not in DESIGNS:
            raise DeviceError(f"`design` {self.design}: must be {' or '.join(DESIGNS)}")

    @property
    def sampling_seed(self) -> int:
        """The seed of the sampled contacts: the plan's, else the experiment's."""
        return self.experiment.seed if self.seed is None else self.seed


@dataclass(frozen=True)
class Collected:
    """Number of contacts in the folder, and the number that was there before."""

    folder: Path
    count: int
    before: int

    def lines(self) -> list[str]:
        """The result as lines of text."""
        return [f"{format_count(self.count, 'contacts')} in {self.folder} ({self.count - self.before} new)"]


@writes("images", "frames_bw", gone_on=(TABLE, META, LOG))
def collect_frames(plan: CollectPlan, out: Path, *, progress: Progress = silent) -> Collected:
    """Collect labelled frames into a folder, or continue a collection that was made with the same plan.

    Raises
    ------
    DeviceError
        The folder holds something else, or one of the reasons of ``collect``.
    FrameError
        The frame without contact shows a contact, or not this sensor.
    """
    kept = KeptAlso(out, plan.also, plan.sensor)
    rig = build_rig(plan, plan.sensor, plan.experiment, form=plan.form, seed=plan.sampling_seed, at_once=True)
    collection = Collection(out, _about(plan, rig), rig.source.form)
    before = collection.count

    def require_rest(frame: Frame) -> None:
        remedy = f"remove {collection.rest} and repeat the command, which takes it again"
        with ErrorsAs(FrameError, lambda error: FrameError(f"{error}; {remedy}")):
            measure_reference(plan.sensor, rig.source.form, frame)

    def report_contact(done: float, total: float = 1.0, note: str = "") -> None:
        kept.catch_up()  # each contact is kept in the further formats before the next one is made
        step(done, total, note)

    with kept:
        if before < plan.count:
            with rig, stage(progress, "contacts") as step:
                _say_plan(plan, rig, before)
                if not plan.dry_run:
                    speed = plan.servo.linear_mm_s, plan.servo.angular_deg_s
                    options: dict[str, Any] = {"seed": plan.sampling_seed, "design": plan.design, "speed": speed}
                    with rig.publishing(plan.ros2, Pipeline(plan.sensor, rig.source.form), estimates=False):
                        collect(rig, plan.experiment, collection, plan.count, **options, on_rest=require_rest, progress=report_contact)
        kept.catch_up()
    return Collected(out, collection.count, before)


def _say_plan(plan: CollectPlan, rig: Rig, made: int) -> None:
    """Check the plan and report it. Of the contacts the next ``CHECKED_CONTACTS`` are checked."""
    work, near = WorkFrame(plan.experiment, rig.placed), rig.arm.state().pose
    pressed = np.array(plan.experiment.clear) + np.array(plan.experiment.tap)
    numbers = range(made, min(plan.count, made + CHECKED_CONTACTS))
    contacts = [draw_contact(plan.experiment, plan.sampling_seed, number, plan.design) for number in numbers]
    planned = [work.base_pose(one.pose + pressed, near) for one in contacts]
    clear = work.base_pose(np.zeros(6), near, away_mm=CLEAR_MM)
    spent_s = (plan.count - made) * CONTACT_S
    pipeline, at_rest = Pipeline(plan.sensor, rig.source.form), partial(measure_reference, plan.sensor, rig.source.form)
    for line in check_plan(rig, pipeline, clear, planned, linear_mm_s=plan.servo.linear_mm_s, spent_s=spent_s, at_rest=at_rest):
        LOGGER.warning("%s", line)


def _about(plan: CollectPlan, rig: Rig) -> dict[str, Any]:
    """Everything that the frames depend on. A collection is continued only if all of this is the same."""
    low, high = zip(*plan.experiment.ranges().values(), strict=True)
    about: dict[str, Any] = {"comments": f"collected: {plan.experiment.name}, {plan.sensor.name}, {plan.obj.name}"}
    about |= {"camera": without_secrets(plan.camera), "arm": plan.arm, "sensor": plan.sensor.name, "form": str(rig.source.form)}
    about |= {"seed": plan.sampling_seed, "experiment": plan.experiment.model_dump(mode="json")}
    about |= {"placement": plan.servo.placement.model_dump(mode="json"), "tap_move": plan.experiment.tap}
    about |= {"poses_rng": [high[:6], low[:6]], "moves_rng": [high[6:], low[6:]]}
    about |= {"linear_speed": plan.servo.linear_mm_s, "angular_speed": plan.servo.angular_deg_s}
    # left out for "random", so that older collections can be continued
    return about | ({} if plan.design == "random" else {"design": plan.design})
