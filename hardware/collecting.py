"""A whole collection: from a plan to labelled frames in a folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hardware.collect import Collection, collect
from hardware.rig import Rig, build_rig
from scenes import ExperimentSpec, ObjectSpec, SensorSpec, ServoSpec
from twin.preprocess import require_untouched
from twin.progress import Progress, silent, stage
from twin.types import Form, Frame


@dataclass(frozen=True)
class CollectPlan:
    """What to collect, with what.

    Attributes
    ----------
    sensor : SensorSpec
    stimulus : ObjectSpec
        The object that is touched.
    experiment : ExperimentSpec
        Which contacts are made.
    servo : ServoSpec
        The arm's speeds, and where the object stands.
    camera, arm : str
        As ``build_rig`` takes them.
    count : int
        Contacts in the folder at the end.
    seed : int or None
        Of the draws; None: the experiment's own.
    form : Form or None
        Of the frames; None: that of the sensor's recordings where it has one.
    limits : str or None
        Safety limits, by name or file; those of the arm's kind by default.
    plain_light : bool
        The twin's frames without path tracing; see ``build_rig``.
    """

    sensor: SensorSpec
    stimulus: ObjectSpec
    experiment: ExperimentSpec
    servo: ServoSpec
    camera: str
    arm: str
    count: int
    seed: int | None = None
    form: Form | None = None
    limits: str | None = None
    plain_light: bool = False

    @property
    def drawn_with(self) -> int:
        """The seed that counts."""
        return self.experiment.seed if self.seed is None else self.seed


@dataclass(frozen=True)
class Collected:
    """Contacts in the folder, and those that were there before."""

    folder: Path
    count: int
    before: int

    def lines(self) -> list[str]:
        """For people."""
        return [f"{self.count} contacts in {self.folder} ({self.count - self.before} new)"]


def collect_frames(plan: CollectPlan, out: Path, *, progress: Progress = silent) -> Collected:
    """Collect labelled frames into a folder, or go on with a collection that was made with the same plan.

    Raises
    ------
    DeviceError
        The folder holds something else, or see ``hardware.collect.collect``.
    FrameError
        The sensor seems pressed in the frame without contact.
    """
    rig = build_rig(
        plan.sensor,
        plan.stimulus,
        plan.servo.placement,
        plan.experiment,
        camera=plan.camera,
        arm=plan.arm,
        form=plan.form,
        limits=plan.limits,
        seed=plan.drawn_with,
        plain_light=plan.plain_light,
        at_once=True,
    )
    collection = Collection(out, _about(plan, rig), rig.source.form)
    before = collection.count

    def require_rest(frame: Frame) -> None:
        remedy = (
            f"look what touches it, remove {collection.rest} and give the same command again to have it taken anew; "
            "or the same command alone, to go on with it"
        )
        require_untouched(plan.sensor, rig.source.form, frame, remedy)

    if before < plan.count:
        with rig, stage(progress, "contacts") as step:
            rig.await_frame()
            collect(
                rig.source,
                rig.arm,
                plan.experiment,
                rig.placed,
                collection,
                plan.count,
                seed=plan.drawn_with,
                speed=(plan.servo.linear_mm_s, plan.servo.angular_deg_s),
                frame_timeout_s=rig.frame_timeout_s,
                on_rest=require_rest,
                progress=step,
            )
    return Collected(out, collection.count, before)


def _about(plan: CollectPlan, rig: Rig) -> dict[str, Any]:
    """What the frames depend on: a collection is gone on with only where all of it is the same."""
    low, high = zip(*plan.experiment.ranges().values(), strict=True)
    return {
        "comments": f"collected: {plan.experiment.name}, {plan.sensor.name}, {plan.stimulus.name}",
        "camera": plan.camera,
        "arm": plan.arm,
        "sensor": plan.sensor.name,
        "form": str(rig.source.form),
        "seed": plan.drawn_with,
        "experiment": plan.experiment.model_dump(mode="json"),
        "placement": plan.servo.placement.model_dump(mode="json"),
        "tap_move": plan.experiment.tap,
        "poses_rng": [high[:6], low[:6]],
        "moves_rng": [high[6:], low[6:]],
        "linear_speed": plan.servo.linear_mm_s,
        "angular_speed": plan.servo.angular_deg_s,
    }
