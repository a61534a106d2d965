"""One run of surface following, from a plan to results that are also written to disk, and a comparison of models by such runs."""

import logging
import re
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.open_arm import kind_of, open_arm
from hardware.cameras.mjpeg import without_secrets
from hardware.errors import DeviceError, in_short
from hardware.rig.geometry import LastAxis, PlacedObject, poses_along, shift_in_tool, turns_back_mm
from hardware.servo.loop import LoopHooks, LoopSettings, ServoLoop, StepRecord, require_labels
from hardware.servo.timing import Timing
from hardware.servo.trajectory import Measures, Trajectory, comparison_figure, measure, trajectory_figure, trajectory_of, write_csv
from hardware.workcell.build import TWIN, DryRunDone, Rig, RigPlan, build_rig, check_plan, load_rest_frame
from scenes import ObjectSpec, ServoSpec, load_experiment
from scenes.files import quote
from twin.errors import OptionError, StoreError, TwinError, format_count
from twin.estimate import Estimate, SensorModel
from twin.policy import KnownContacts, Policy, PolicyError, PolicyModel, load_policy
from twin.progress import Progress, silent, stage
from twin.records import KeptAlso
from twin.records.session import SessionWriter, plain
from twin.report.charts import write_chart
from twin.report.page import Cell, Column, Page, PagePicture, write_rows
from twin.rig.arm_pose import matrix_of, pose_of
from twin.rig.kinematics import Mounting
from twin.store import write_json, writes
from twin.types import FIRST, Frame, ReadableResult

AROUND = ("SurfaceFollow", "ContourFollow")
"""Tasks whose policies follow an object's outline, as a loop with an arm needs it."""
# Measures that are printed, with their headings.
SHOWN = {
    "smoothness": "S",
    "local_smoothness": "local S",
    "path_error_mm": "path mm",
    "depth_error_mm": "depth mm",
    "angle_error_deg": "angle deg",
    "completed": "completed",
    "lost_contacts": "lost",
}
LOG = logging.getLogger(__name__)
# Subfolder of the results with the session.
SESSION = "session"
# Time, s, without a usable frame after which following ends.
GIVE_UP_S = 5.0
# Rate, Hz, that determines the loop's period if no rate is given. Then each decision waits for the move before it, and the period is only
# the pause after a frame that could not be used.
STREAM_HZ = 10.0
# Range of the rate, decisions per second. No camera is faster than the second, and an arm waits too long with a rate below the first.
SLOWEST_HZ, FASTEST_HZ = 0.1, 1000.0
# Distance, mm, between the poses along the outline that are checked before anything moves.
CHECK_MM = 10.0
# Most steps of a run. They take an arm days.
MOST_STEPS = 1_000_000


def policy_law(policy: Policy, mounting: Mounting) -> Callable[[np.ndarray, Estimate], np.ndarray]:
    """Function from the arm's pose (6,) and the policy's answer to a frame to the next pose (6,)."""

    def law(pose: np.ndarray, answer: Estimate) -> np.ndarray:
        shift, turn = policy.step(np.asarray(answer.value, float)).reshape(2, 3) @ mounting.work_axes.T  # in the tool frame
        T = matrix_of(shift_in_tool(pose, shift))
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(turn, degrees=True).as_matrix()
        return pose_of(T, pose)

    return law


def load_for_outlines(path: Path, contacts_of: Callable[[Policy], KnownContacts | None] = lambda _: None) -> PolicyModel:
    """Load a policy that follows an object's outline, ready for frames. ``contacts_of`` gives the contacts that it knows.

    Raises
    ------
    PolicyError
        The file holds no policy, or one of another task.
    """
    policy = load_policy(path)
    if policy.about["task"] not in AROUND:
        raise PolicyError(f"{path}: a policy of {policy.about['task']}; to follow an outline give a policy of {' or '.join(AROUND)}")
    return PolicyModel(policy, contacts=contacts_of(policy))


@dataclass(frozen=True, kw_only=True)
class FollowPlan(RigPlan):
    """Settings of a run, and its devices. The sensor and the form of its frames are those of the model.

    Attributes
    ----------
    camera, arm : str
        As in ``RigPlan``. If no camera is given, the twin's frames are drawn. This is allowed for a simulated arm only, because a real
        arm would follow a contact that does not exist.
    steps : int or None
        Number of steps; None: once around the object.
    stream_hz : float or None
        Decisions per second; None: each decision waits for the move before it.
    record : bool
        Keep every frame and step in a session.
    seed : int
        Seed of the twin's noise.
    known_place : bool
        Whether the object really stands at the servo's placement, so that the results can be compared with the truth. This is always true
        in the twin.
    at_rest : str
        The pins at rest: ``first`` (from the frame that is taken clear of the object), ``none`` (those that the model knows, or that follow
        from the contacts), or a file.
    also : tuple of str
        Further formats in which the session is kept at its end, each in a subfolder of it.
    """

    camera: str = ""
    arm: str = "simulated"
    steps: int | None = None
    stream_hz: float | None = None
    record: bool = False
    seed: int = 0
    known_place: bool = False
    at_rest: str = FIRST

    def __post_init__(self) -> None:
        if self.also and not self.record:
            raise OptionError("`also` needs `record`: it keeps the recorded session in a further format")
        if self.stream_hz is not None and not SLOWEST_HZ <= self.stream_hz <= FASTEST_HZ:
            raise DeviceError(f"`rate` {self.stream_hz:g}: expected {SLOWEST_HZ:g} to {FASTEST_HZ:g} decisions a second")
        if self.steps is not None and not 1 <= self.steps <= MOST_STEPS:
            raise DeviceError(f"`steps` {self.steps}: expected 1 to {MOST_STEPS}")
        if not self.camera:
            if kind_of(self.arm) != "simulated":
                open_arm(self.arm)  # an arm that does not exist is reported first; nothing is opened
                twin = "`camera=twin` renders frames for the pose that the arm reports, and these do not show the real contact"
                raise OptionError(f"`arm` {quote(self.arm)} needs a camera: give the sensor's with `camera`; {twin}")
            object.__setattr__(self, "camera", TWIN)


@dataclass(frozen=True)
class Followed:
    """The result of ``follow``. ``failure`` states why it ended early ("" if it did not); ``outline_mm`` (N, 2) is in the base frame.

    ``lines()`` shortens the failure; ``measures.json`` holds all of it.
    """

    measures: Measures
    timing: Timing
    path: Trajectory
    outline_mm: np.ndarray
    failure: str
    notes: list[str]
    written: list[Path] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The result as lines of text, without unknown values."""
        m = self.measures
        smooth = {"smoothness S": m.smoothness, "local": m.local_smoothness, "jerk in mm per step^3": m.jerk}
        out = [
            f"{format_count(m.steps, 'steps')} on fresh frames",
            ", ".join(f"{what} {value:.3f}" for what, value in smooth.items() if np.isfinite(value)),
            *self.timing.lines(),
            *(f"note: {note}" for note in self.notes),
        ]
        if np.isfinite(m.completed):
            round_mm = np.linalg.norm(np.diff(self.outline_mm, axis=0), axis=1).sum()
            out[0] += f", {self.path.along_mm.max():.0f} of {round_mm:.0f} mm along the outline, losses of contact: {m.lost_contacts:g}"
            off = f"path error {m.path_error_mm:.3f} mm; estimates off by {m.depth_error_mm:.3f} mm, {m.angle_error_deg:.2f} deg; "
            off = off if np.isfinite(m.path_error_mm) else ""  # a policy gives no estimate
            out.insert(2, f"{off}held to {m.hold_depth_mm:.3f} mm, {m.hold_angle_deg:.2f} deg")
        else:
            out[0] += "; the true position of the object is unknown, so errors against it are not measured (`known_place` if it is known)"
        return out + ([in_short(f"ended early: {self.failure}")] if self.failure else [])


@writes("index.html", "trajectory.csv", "trajectory*.png", "measures.json", SESSION)
def follow(
    plan: FollowPlan, model: SensorModel, out: Path, *, about: dict[str, Any] | None = None, progress: Progress = silent
) -> Followed | DryRunDone:
    """Follow an object and write the results to ``out``. A run that ends before its last step also has results.

    Parameters
    ----------
    model : SensorModel
        Model that estimates the pose in each frame.
    about : dict, optional
        Further entries for the stored measures, such as the model's name (JSON).

    Raises
    ------
    TwinError
        The run could not begin, or it ended before its first step.
    """
    kept = KeptAlso(out / SESSION, plan.also, model.sensor)
    rest = load_rest_frame(plan.at_rest, model)
    if rest is not None:
        model = model.at_rest(rest)
    elif plan.at_rest != FIRST:
        model = model.seeking_rest()
    experiment, at_once = load_experiment(plan.servo.experiment), plan.stream_hz is None
    rig = build_rig(plan, model.sensor, experiment, form=model.form, seed=plan.seed, at_once=at_once)
    round_steps, wanted_mm = steps_round(rig.placed, plan.servo, 1.0)
    steps = plan.steps or round_steps
    if plan.steps:
        wanted_mm = min(wanted_mm, plan.steps * plan.servo.feed_mm)
    entries = {"sensor": model.sensor.name, "object": plan.obj.name, "camera": without_secrets(plan.camera), "arm": plan.arm}
    entries |= {"servo": plan.servo.model_dump()} | (about or {})
    failure, followed = "", None
    with rig, stage(progress, f"following the {plan.obj.name}") as step, ExitStack() as stack:
        takes_rest = plan.at_rest == FIRST and model.counts_from_rest and rig.source.is_live
        _say_plan(plan, rig, model, wanted_mm, steps, takes_rest)
        first = rig.await_frame()
        law = policy_law(model.policy, rig.mounting) if isinstance(model, PolicyModel) else None
        if law is None:
            require_labels(rig.mounting, model(first).names)
        _say_turns(rig, plan.servo, wanted_mm)
        if plan.dry_run:
            return DryRunDone()
        session = stack.enter_context(SessionWriter(out / SESSION, entries)) if plan.record else None
        if session is not None and rest is not None:
            session.keep_rest(rest)

        def take_rest(frame: Frame) -> SensorModel:
            """Store the frame that was taken clear of the object, and use its pins as the pins at rest."""
            if session is not None:
                session.keep_rest(frame)
            return model.at_rest(frame)

        def note_step(record: StepRecord, frame: Frame, estimate: Estimate) -> None:
            if session is not None:
                session.append(frame, asdict(record))
            step(record.index + 1, steps)

        publish = stack.enter_context(rig.publishing(plan.ros2, model.pipeline))
        hooks = LoopHooks(law, take_rest if takes_rest else None, note_step, publish)
        period_s = 1.0 / (plan.stream_hz or STREAM_HZ)
        settings = LoopSettings(steps, plan.stream_hz is None, period_s, rig.frame_timeout_s, GIVE_UP_S)
        loop = ServoLoop(rig, plan.servo, model, settings, hooks)
        try:
            loop.run(rig.placed.start_pose(plan.servo.indent_mm))
        except TwinError as error:
            if not loop.records:
                raise
            failure = str(error)
        finally:  # also after Ctrl-C, so that the steps so far are stored
            if loop.records:
                followed = _results(plan, rig, loop, wanted_mm, failure)
                followed.written.extend(_write(out, plan, model, followed, entries))
                with kept:
                    kept.catch_up()
    if followed is None:
        raise DeviceError(f"{rig.source.name}: ended before the first step, nothing was followed; give a camera or a longer recording")
    return followed


def steps_round(placed: PlacedObject, servo: ServoSpec, rounds: float) -> tuple[int, float]:
    """The number of steps for ``rounds`` around the object, and the distance along its outline in mm.

    The tool stands off the surface, so its path around a closed outline is longer than the outline. The number of steps takes this into
    account.
    """
    outline = placed.outline()
    length_mm = float(np.linalg.norm(np.diff(outline, axis=0), axis=1).sum())
    tool_mm = placed.mounting.apex_mm @ placed.mounting.axis - servo.indent_mm  # distance of the tool from the surface
    closed = bool(np.allclose(outline[0], outline[-1]))
    way_mm = rounds * (length_mm + closed * 2 * np.pi * max(tool_mm, 0.0))
    return int(np.ceil(way_mm / servo.feed_mm)), rounds * length_mm


def _say_plan(plan: FollowPlan, rig: Rig, model: SensorModel, wanted_mm: float, steps: int, takes_rest: bool) -> None:
    """Check the plan and report it. Of the outline every ``CHECK_MM`` is checked."""
    planned = [pose for distance, pose in poses_along(rig.placed, plan.servo.indent_mm, wanted_mm)]
    axis, along, near = LastAxis(getattr(rig.arm, "kinematics", None)), [planned[0]], planned[0]
    for pose in planned:
        if np.linalg.norm(pose[:3] - near[:3]) >= CHECK_MM:
            near = axis.on_turn(pose, near[5])[0]
            along.append(near)
    clear = shift_in_tool(planned[0], -plan.servo.clear_mm * rig.mounting.axis)
    spent_s = steps / plan.stream_hz if plan.stream_hz else steps * plan.servo.feed_mm / plan.servo.linear_mm_s
    at_rest = model.at_rest if takes_rest else None
    for line in check_plan(rig, model.pipeline, clear, along, linear_mm_s=plan.servo.linear_mm_s, spent_s=spent_s, at_rest=at_rest):
        LOG.warning("%s", line)


def _say_turns(rig: Rig, servo: ServoSpec, wanted_mm: float) -> None:
    """Report in advance where on its path an arm of four axes will turn back its last axis."""
    axis = LastAxis(getattr(rig.arm, "kinematics", None), rig.mounting.centre_mm)
    for distance_mm in turns_back_mm(rig.placed, axis, servo.indent_mm, wanted_mm):
        LOG.warning("%s: its last axis will turn back by a full turn after about %.0f mm, clear of the object", rig.arm.name, distance_mm)


def _results(plan: FollowPlan, rig: Rig, loop: ServoLoop, wanted_mm: float, failure: str) -> Followed:
    path = trajectory_of(loop.records, rig.mounting, rig.placed if rig.knows_truth or plan.known_place else None)
    measures = measure(path, indent_mm=plan.servo.indent_mm, angle_deg=plan.servo.angle_deg, wanted_mm=wanted_mm)
    flat = rig.placed.outline()
    turn, origin = rig.placed.T_base_object[:2, [0, 2]], rig.placed.T_base_object[:2, 3]
    return Followed(measures, loop.timing(), path, flat @ turn.T + origin, failure, loop.notes)


def _write(out: Path, plan: FollowPlan, model: SensorModel, followed: Followed, entries: dict[str, Any]) -> list[Path]:
    title, (lead, *lines) = f"{plan.obj.name}, {model.sensor.name}", followed.lines()
    content = entries | {"measures": asdict(followed.measures), "timing": asdict(followed.timing)}
    content |= {"failure": followed.failure, "notes": followed.notes}
    files = [write_csv(out / "trajectory.csv", followed.path), write_json(out / "measures.json", plain(content))]
    draw = partial(trajectory_figure, followed.path, followed.measures, title, outline_mm=followed.outline_mm)
    picture = write_chart(out / "trajectory.png", draw)
    page = Page(f"Following: {title}", "twin servo", topic="TacTip twin: servoing", lead=f"{lead}.")
    page.items(lines)
    page.figures(PagePicture(picture, "The tool's path around the object, depth and angle at each step", width_px=1000))
    for path in files:
        page.download(path)
    return [page.write(out / "index.html"), *files, picture]


@dataclass(frozen=True)
class ServoStudyPlan:
    """Models, objects and settings of the comparison.

    Attributes
    ----------
    models : mapping of str to SensorModel
        The keys are the models' names in the results.
    objects : tuple of ObjectSpec
    servo : ServoSpec
    steps : int or None
        Number of steps for each object. None: once around the object.
    seed : int
        Seed of the twin's noise.
    plain_light : bool
        See ``build_rig``.
    """

    models: Mapping[str, SensorModel]
    objects: tuple[ObjectSpec, ...]
    servo: ServoSpec
    steps: int | None = None
    seed: int = 0
    plain_light: bool = False


@dataclass(frozen=True, repr=False)
class ServoStudy(ReadableResult):
    """The result of ``study_servo``.

    Attributes
    ----------
    found : dict
        For each model and object: the run, or the reason why it did not make a single step.
    written : list of Path
    """

    found: dict[tuple[str, str], Followed | str]
    written: list[Path]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """``model``, ``object``, every measure and ``failure`` of each run that made a step."""
        runs = [(key, run) for key, run in self.found.items() if isinstance(run, Followed)]
        return [{"model": model, "object": name, **asdict(run.measures), "failure": run.failure} for (model, name), run in runs]

    def lines(self) -> list[str]:
        """The comparison as a table in plain text."""
        wide = max((len(model) for model, _ in self.found), default=0)
        lines = [f"{'model':{wide}} {'object':10}" + "".join(f"{head:>11}" for head in SHOWN.values())]
        for (model, name), run in self.found.items():
            lines.append(f"{model:{wide}} {name:10}{f'  failed: {run}' if isinstance(run, str) else _cells(run)}")
        return lines


@writes("index.html", "study.csv", "study*.png")
def study_servo(plan: ServoStudyPlan, out: Path, *, progress: Progress = silent) -> ServoStudy:
    """Follow each object with each model in the twin, and write each run and the comparison to ``out``.

    It writes a folder for each model and object as ``follow`` does, ``index.html``, ``study.csv`` and ``study.png``. A run that
    can't make a single step is also a result of the study.

    Raises
    ------
    StoreError
        A run can't be written.
    TwinError
        No run made a step.
    """
    found: dict[tuple[str, str], Followed | str] = {}
    for label, model in plan.models.items():
        for obj in plan.objects:
            run_plan = FollowPlan(obj, plan.servo, steps=plan.steps, seed=plan.seed, plain_light=plan.plain_light)
            folder = out / folder_name(label) / obj.name
            try:
                followed = follow(run_plan, model, folder, about={"model": label})
                assert isinstance(followed, Followed)
                found[label, obj.name] = followed
            except StoreError:
                raise
            except TwinError as error:
                found[label, obj.name] = str(error)
            progress("objects followed", len(found), len(plan.models) * len(plan.objects))
    reasons = [said for said in found.values() if isinstance(said, str)]
    if reasons and len(reasons) == len(found):
        raise TwinError(f"none of {format_count(len(found), 'runs')} made a step; the first: {reasons[0]}")
    study = ServoStudy(found, [])
    pictures = [(*key, run.path, run.outline_mm) for key, run in found.items() if isinstance(run, Followed)]
    files = [write_rows(out / "study.csv", study.rows), write_chart(out / "study.png", partial(comparison_figure, pictures))]
    study.written.extend([_write_study(out, study), *files])
    return study


def _write_study(out: Path, study: ServoStudy) -> Path:
    """Write the study's page, whose rows lead to the pages of the runs, and return its path."""
    page = Page("Following outlines", "twin study servo", topic="TacTip twin: study")
    page.lead = "Each model follows the outline of each object once in the twin."
    columns = [Column(key, key, "%", scale=100) if key == "completed" else Column.of(key) for key in SHOWN]
    rows: list[dict[str, Any]] = []
    for (model, name), run in study.found.items():
        if isinstance(run, str):
            rows.append({"model": model, "object": name, "end": run})
        else:
            page_of_run = Cell(name, href=f"{folder_name(model)}/{name}/index.html")
            rows.append({"model": model, "object": page_of_run, "end": run.failure or "all steps made", **asdict(run.measures)})
    caption = "Smoothness is the paper's S; local smoothness does not depend on the axes."
    page.table(rows, ["model", "object", *columns, "end"], caption=caption)
    page.figures(PagePicture(out / "study.png", "The tool's path (thin) around each object (wide), for each model", width_px=1000))
    page.download(out / "study.csv", "all measures")
    return page.write(out / "index.html")


def folder_name(label: str) -> str:
    """A model's name as a valid name of a folder: one part of a path, and never the parent folder."""
    return re.sub(r"^\.+|[^\w.-]+", "_", label) or "_"


def _cells(run: Followed) -> str:
    measures = asdict(run.measures)
    cells = (f"{measures[key]:>11.0%}" if key == "completed" else f"{measures[key]:>11.4g}" for key in SHOWN)
    return "".join(cells) + (f"  ended early: {run.failure}" if run.failure else "")
