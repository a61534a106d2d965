"""One run of surface following, from its options to its results on disk."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from hardware.loop import ServoLoop
from hardware.servo_plots import save_figure, trajectory_figure
from hardware.session import SessionWriter, plain
from hardware.step import LoopSettings
from hardware.timing import Timing
from hardware.trajectory import Measures, Trajectory, measure, trajectory_of, write_csv
from scenes import ObjectSpec, SensorSpec, ServoSpec, load_experiment
from twin.cli.at_rest import FIRST, counting_from_first, given_frame
from twin.cli.rig import build_rig, servo_loop, steps_round
from twin.errors import TwinError
from twin.types import Form

GIVE_UP_S = 5.0


@dataclass(frozen=True)
class ServoRun:
    """What to follow, with what.

    Attributes
    ----------
    steps : int or None
        None: once around the object.
    stream_hz : float or None
        Decisions a second; None: each waits for the move before.
    known_place : bool
        The object stands where the servo's placement has it, so that there is a truth to measure against (always so in the twin).
    at_rest : str
        What pins are counted from: ``first`` (the frame that is taken clear of the object), ``none``, or a file.
    """

    sensor: SensorSpec
    form: Form
    stimulus: ObjectSpec
    servo: ServoSpec
    camera: str = "twin"
    arm: str = "simulated"
    steps: int | None = None
    stream_hz: float | None = None
    limits: str | None = None
    record: bool = False
    seed: int = 0
    plain_light: bool = False
    known_place: bool = False
    at_rest: str = FIRST


@dataclass(frozen=True)
class Followed:
    """What came of it; ``failure`` says why it ended early ("" if it did not)."""

    measures: Measures
    timing: Timing
    path: Trajectory
    outline_mm: np.ndarray
    failure: str
    notes: list
    written: list = field(default_factory=list)

    def lines(self) -> list[str]:
        """For people; what is not known is left out."""
        m = self.measures
        smooth = {"smoothness S": m.smoothness, "local": m.local_smoothness, "jerk in mm per step^3": m.jerk}
        out = [
            f"{m.steps} steps on fresh frames",
            ", ".join(f"{what} {value:.3f}" for what, value in smooth.items() if np.isfinite(value)),
            *self.timing.lines(),
            *(f"note: {note}" for note in self.notes),
        ]
        if np.isfinite(m.completed):
            out[0] += f", {m.completed:.0%} of the way, contact lost {m.lost_contacts:g} times"
            out[2:2] = [
                f"path error {m.path_error_mm:.3f} mm; estimates off by {m.depth_error_mm:.3f} mm, {m.angle_error_deg:.2f} deg; "
                f"held to {m.hold_depth_mm:.3f} mm, {m.hold_angle_deg:.2f} deg"
            ]
        else:
            out[0] += "; where the object truly stands is not known, so nothing is measured against it ('--known-place' says it is)"
        return out + ([f"ended early: {self.failure}"] if self.failure else [])


def follow(
    run: ServoRun, estimator, out: Path, *, about: dict | None = None, progress: Callable[[int, int], None] | None = None
) -> Followed:
    """Follow an object and write what came of it to ``out``; an end before the last step is a result, too.

    Raises
    ------
    TwinError
        It could not be begun.
    """
    rest = given_frame(run.at_rest, estimator)
    if rest is not None:
        estimator = estimator.at_rest(rest)
    rig = build_rig(
        run.sensor,
        run.stimulus,
        run.servo.placement,
        load_experiment(run.servo.experiment),
        camera=run.camera,
        arm=run.arm,
        form=run.form,
        limits=run.limits,
        seed=run.seed,
        plain_light=run.plain_light,
        at_once=run.stream_hz is None,
    )
    round_steps, wanted_mm = steps_round(rig.placed, run.servo, 1.0)
    steps = run.steps or round_steps
    if run.steps:
        wanted_mm = min(wanted_mm, run.steps * run.servo.feed_mm)
    told = {
        "sensor": run.sensor.name,
        "object": run.stimulus.name,
        "camera": run.camera,
        "arm": run.arm,
        "servo": run.servo.model_dump(),
        **(about or {}),
    }
    settings = LoopSettings(
        steps,
        blocking=run.stream_hz is None,
        period_s=1.0 / (run.stream_hz or 10.0),
        frame_timeout_s=rig.frame_timeout_s,
        give_up_s=GIVE_UP_S,
    )

    def on_step(record, frame, estimate) -> None:
        if session is not None:
            session.append(frame, record.plain())
        if progress is not None:
            progress(record.index + 1, steps)

    def take_rest(frame):
        if session is not None:
            session.keep_rest(frame)
        return counting_from_first(estimator, frame)

    failure, followed, session = "", None, None
    with rig:
        first = rig.await_frame()
        loop = servo_loop(rig, run.servo, estimator, settings, on_step)
        loop.require_labels(estimator(first).names)
        if run.record:
            session = SessionWriter(out / "session", told)
            if rest is not None:
                session.keep_rest(rest)
        if run.at_rest == FIRST and estimator.counts_from_rest and rig.source.is_live:
            loop.take_rest = take_rest
        try:
            loop.run(rig.placed.start_pose(run.servo.indent_mm))
        except TwinError as error:
            if not loop.records:
                raise
            failure = str(error)
        finally:
            if session is not None:
                session.close()
            if loop.records:
                followed = _results(run, rig, loop, wanted_mm, failure)
                followed.written.extend(_write(out, run, followed, told))
    return followed


def _results(run: ServoRun, rig, loop: ServoLoop, wanted_mm: float, failure: str) -> Followed:
    path = trajectory_of(loop.records, rig.mounting, rig.placed if rig.knows_truth or run.known_place else None)
    measures = measure(path, indent_mm=run.servo.indent_mm, angle_deg=run.servo.angle_deg, wanted_mm=wanted_mm)
    flat = rig.placed.outline()
    turn, origin = rig.placed.T_base_object[:2, [0, 2]], rig.placed.T_base_object[:2, 3]
    return Followed(measures, loop.timing(), path, flat @ turn.T + origin, failure, loop.notes)


def _write(out: Path, run: ServoRun, followed: Followed, told: dict) -> list[Path]:
    figure = trajectory_figure(followed.path, followed.measures, f"{run.stimulus.name}, {run.sensor.name}", outline_mm=followed.outline_mm)
    content = {
        **told,
        "measures": asdict(followed.measures),
        "timing": asdict(followed.timing),
        "failure": followed.failure,
        "notes": followed.notes,
    }
    measures = out / "measures.json"
    measures.write_text(json.dumps(plain(content), indent=1) + "\n")
    return [write_csv(out / "trajectory.csv", followed.path), save_figure(out / "trajectory.png", figure), measures]
