"""A loop for several sensors on a gripper that an arm carries: a frame of each sensor, their pins, a decision, a move and a width.

A gripper is at a digital output, behind ROS 2, in a scene, or of another package.

The arm moves only while all cameras give fresh frames. If one does not, or its pins are not found, arm and gripper hold still, and the loop
ends with an error if that lasts. At the end the arm is stopped and disabled; the gripper keeps its width, so that it drops nothing. A
``SafeArm`` checks the workspace, the step, the speed and the age of the oldest frame before each move. It gets no depth and no force: the
arm does not press the sensors, the gripper does. Only the policy and the gripper's own limit of force guard the grip.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Protocol, cast

import numpy as np

from hardware.arms.arm import Arm, ArmState, happens
from hardware.arms.mg400 import MG400
from hardware.arms.open_arm import kind_of
from hardware.arms.ros2 import CONNECT_S, topic_in
from hardware.cameras.source import FrameSource, no_frame, open_camera
from hardware.cameras.twin import TwinCamera
from hardware.errors import DeviceError
from hardware.ros2.dds import Participant, Writer
from hardware.safety.decide import Sensed
from hardware.safety.eyes import ArmWatch, FreshFrames
from hardware.safety.safe_arm import SafeArm, try_each
from hardware.workcell.build import FRAME_S, TWIN_FRAME_S, DryRunDone, check_standing, open_guarded_arm
from hardware.workcell.ros2 import publishing
from scenes.files import quote
from scenes.plugins import others
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs, OptionError
from twin.pins import Pipeline
from twin.progress import Progress, silent, stage
from twin.records import ALSO, KeptAlso
from twin.records import ros2 as ros
from twin.records.session import SessionWriter
from twin.store import writes
from twin.types import Form, Frame, Observation

LOG = logging.getLogger(__name__)
POSITIONS = "std_msgs/Float64MultiArray"
GRIPPER_FORMS = "output:N,OPEN_MM,CLOSED_MM (a digital output of an MG400), ros2:TOPIC[,JOINTS]"


class Gripper(Protocol):
    """A parallel gripper. It is connected with the arm."""

    name: str

    @property
    def width_mm(self) -> float:
        """The width that was commanded last."""

    def move(self, width_mm: float) -> None:
        """Open or close to a width, as near to it as the gripper can. It returns at once."""


class OutputGripper:
    """A gripper that is open or closed, at a digital output of an MG400.

    Parameters
    ----------
    arm : MG400 or SafeArm
    output : int
        Number of the output; its level is 1 while the gripper is closed.
    open_mm, closed_mm : float
        Its two widths. A width nearer to ``closed_mm`` closes it.
    """

    def __init__(self, arm: Arm, output: int, *, open_mm: float, closed_mm: float) -> None:
        device = arm.arm if isinstance(arm, SafeArm) else arm
        if not isinstance(device, MG400):
            raise DeviceError(f"{arm.name}: has no digital outputs for a gripper; give an MG400")
        self.name, self.width_mm = f"gripper at output {output} of {arm.name}", open_mm
        self._arm, self._output, self._widths = device, output, (open_mm, closed_mm)

    def move(self, width_mm: float) -> None:
        self.width_mm = min(self._widths, key=lambda width: abs(width - width_mm))
        self._arm.set_output(self._output, self.width_mm == self._widths[1])


class Ros2Gripper:
    """A gripper whose controller takes positions of its joints from a topic, as ``forward_command_controller`` does. It connects at a move.

    Parameters
    ----------
    topic : str
        Topic of ``std_msgs/Float64MultiArray``.
    joints : int
        Number of joints, m, that share the width equally: 1 if the controller takes the width itself, 2 for two fingers.
    """

    def __init__(self, topic: str, joints: int = 1) -> None:
        self._topic, self._joints, self.width_mm = topic_in("", topic), joints, float("nan")
        self.name = f"ROS 2 gripper at {self._topic}"
        self._writer: Writer | None = None

    def move(self, width_mm: float) -> None:
        writer = self._writer = self._writer or Participant().writer(self._topic, POSITIONS)
        if not happens(lambda: writer.heard, CONNECT_S):
            raise DeviceError(f"{self.name}: nobody takes {POSITIONS} there; start its controller, or name its topic of commands")
        writer.write(ros.encode(POSITIONS, {"data": np.full(self._joints, width_mm / ros.MM_PER_M / self._joints)}), time.time_ns())
        self.width_mm = width_mm


def open_gripper(text: str, arm: Arm, sensor: SensorSpec) -> Gripper:
    """A gripper from its specification: one of ``GRIPPER_FORMS``, or ``NAME:REST`` of a plug-in (``scenes.plugins``).

    Raises
    ------
    DeviceError
        The specification is not understood, or the arm has no outputs.
    """
    kind, _, rest = text.partition(":")
    if kind in (there := others("grippers", ("output", "ros2"))):
        gripper: Gripper = there[kind](rest, sensor)
        return gripper
    first, *numbers = rest.split(",")
    with ErrorsAs(ValueError, lambda _: DeviceError(f"no gripper '{quote(text)}'; there are: {', '.join((GRIPPER_FORMS, *there))}")):
        if kind == "output":
            open_mm, closed_mm = map(float, numbers)
            return OutputGripper(arm, int(first), open_mm=open_mm, closed_mm=closed_mm)
        if kind == "ros2":
            (joints,) = map(int, numbers or ["1"])
            return Ros2Gripper(first, joints)
        raise ValueError(kind)


@dataclass(frozen=True)
class GripperRig:
    """Sensors on a gripper that an arm carries; not connected yet. ``sources`` are the sensors' cameras by the sensors' names."""

    sources: Mapping[str, FrameSource]
    arm: Arm
    gripper: Gripper

    @contextmanager
    def connect(self) -> Iterator[None]:
        """Context in which the arm and the cameras are connected."""
        with ExitStack() as stack:
            stack.enter_context(self.arm)
            for source in self.sources.values():
                stack.enter_context(source)
            yield


@dataclass(frozen=True)
class GripStep:
    """What a step was decided on: the arm's state, the gripper's width, and each sensor's frame and pins."""

    index: int
    state: ArmState
    width_mm: float
    frames: Mapping[str, Frame]
    pins: Mapping[str, Observation]


Decide = Callable[[GripStep], tuple[np.ndarray, float]]
"""The tool's motion (6,) in the arm's base frame, mm and deg, and the gripper's next width, mm."""


def run_gripper(
    rig: GripperRig,
    pipelines: Mapping[str, Pipeline],
    decide: Decide,
    *,
    steps: int,
    out: Path | None = None,
    speed: tuple[float, float] = (50.0, 30.0),
    period_s: float = 0.0,
    timeout_s: float = FRAME_S,
    give_up_s: float = 3.0,
    ros2: str | None = None,
) -> list[GripStep]:
    """Run a policy on a gripper with several sensors.

    Parameters
    ----------
    pipelines : mapping of str to Pipeline
        Finds the pins, for each of the rig's sources.
    decide : callable
        The policy. It is asked once for each step with valid pins of all sensors.
    out : Path, optional
        New folder for the records: for each sensor a session, whose lines have the same steps, with its pins.
    speed : (float, float)
        mm/s and deg/s.
    period_s : float
        Least time between two decisions.
    timeout_s, give_up_s : float
        Longest wait for a frame, and longest time without valid pins.
    ros2 : str, optional
        Namespace in which each sensor has its own, ``NAME/left``, with its frames and pins and the arm's pose as ROS 2 topics.

    Returns
    -------
    list of GripStep

    Raises
    ------
    DeviceError
        The arm fails or refuses a move, or there are no frames or no valid pins for too long.
    """
    found, failed = list[GripStep](), list[str]()

    def blind() -> str:
        return "; ".join(f"{name}: {why}" for name, source in rig.sources.items() if (why := source.blind()))

    cameras = cast(FrameSource, SimpleNamespace(name="cameras", same_s=None, blind=blind))  # as one: it is blind if any of them is
    with ExitStack() as stack:
        stack.enter_context(rig.connect())
        about = {"arm": rig.arm.name, "gripper": rig.gripper.name, "sensors": list(rig.sources)}
        watch, eyes = ArmWatch(rig.arm), FreshFrames(rig.arm, cameras)
        records = {}
        for name, source in rig.sources.items():
            if out is not None:
                entries = about | {"sensor": pipelines[name].spec.name, "camera": source.name}
                records[name] = stack.enter_context(SessionWriter(out / name, entries))
            of = ros2 and f"{ros2}/{name}"
            stack.enter_context(publishing(of, source, pipelines[name], estimates=False, arm=lambda: watch.newest))
        stack.enter_context(watch.alert())
        stack.callback(lambda: failed.extend(try_each(stop=rig.arm.stop, disable=rig.arm.disable)))
        stack.enter_context(watch.watching())
        stack.enter_context(eyes.watching())
        asked_s = due_s = time.monotonic()
        valid_s = np.inf  # the patience begins with the first frames
        while len(found) < steps:
            with no_frame():
                frames = {name: watch.frame_after(source, asked_s, timeout_s=timeout_s) for name, source in rig.sources.items()}
            valid_s = min(valid_s, time.monotonic())
            pins = {name: pipelines[name](frame) for name, frame in frames.items()}
            asked_s = time.monotonic()
            if reasons := [f"{name}: {each.reason}" for name, each in pins.items() if not each.valid]:
                if asked_s - valid_s > give_up_s:
                    raise DeviceError(f"{rig.arm.name}: held still for {give_up_s:g} s, then ended: {'; '.join(reasons)}")
                continue
            if not found:
                eyes.await_frame(timeout_s=timeout_s)
                rig.arm.enable()
                rig.arm.set_speed(*speed)
            if isinstance(rig.arm, SafeArm):
                rig.arm.sense(Sensed(np.nan, min(frame.time_s for frame in frames.values())))
            step = GripStep(len(found), rig.arm.state(), rig.gripper.width_mm, frames, pins)
            motion, width_mm = decide(step)
            sent = eyes.move(partial(rig.arm.move_linear, step.state.pose + motion))
            rig.gripper.move(width_mm)
            found.append(step)
            line = {"index": step.index, "time_s": time.monotonic(), "exposed_pose": step.state.pose, "sent": sent}
            line |= {"width_mm": step.width_mm, "sent_mm": rig.gripper.width_mm}
            for name, record in records.items():
                record.append(frames[name], line | {"pins": pins[name].pins_px})
            time.sleep(max(0.0, due_s - time.monotonic()))
            asked_s = valid_s = time.monotonic()
            due_s = max(due_s, asked_s) + period_s
    if failed:
        raise DeviceError("; ".join(failed))
    return found


@dataclass(frozen=True)
class GripPlan:
    """Settings of a run, and its devices.

    Attributes
    ----------
    sensor : SensorSpec
        That of both fingers.
    gripper : str
        As for ``open_gripper``. A gripper of a scene moves its hand as the simulated arm goes, and brings the sensors' cameras.
    left, right : str
        Cameras, as for ``open_camera``.
    arm, limits : str
        As for ``build_rig``.
    also : tuple of str
        Further formats in which the records are kept.
    dry_run : bool
        End after the check of the cameras and of the arm's place, before anything moves.
    ros2 : str or None
        As for ``run_gripper``.
    """

    sensor: SensorSpec
    gripper: str = "mujoco:gripper"
    left: str = ""
    right: str = ""
    arm: str = "simulated"
    limits: str | None = None
    also: tuple[str, ...] = ()
    dry_run: bool = False
    ros2: str | None = None

    @property
    def form(self) -> Form:
        """Form of the frames."""
        return Form.PROCESSED if self.sensor.recording else Form.RAW

    def build(self) -> GripperRig:
        """The rig.

        Raises
        ------
        DeviceError, OptionError
            A part is not known, or they don't fit together.
        """
        arm, cameras = open_guarded_arm(self.arm, self.limits, at_once=True), {"left": self.left, "right": self.right}
        gripper = open_gripper(self.gripper, arm, self.sensor)
        worlds = {site.removesuffix("_tactip"): world for site, world in getattr(gripper, "worlds", dict)().items()}
        if worlds and (any(cameras.values()) or kind_of(self.arm) != "simulated"):
            raise OptionError(f"`gripper` {quote(self.gripper)} is in a scene; leave out `left`, `right` and `arm`, or give a real gripper")
        if worlds:
            draw = partial(TwinCamera, self.sensor, None, arm.state, self.form, on_demand=True)
            of = {name: draw(seed=number, world=world) for number, (name, world) in enumerate(worlds.items())}
            return GripperRig(of, arm, gripper)
        if not all(cameras.values()):
            raise OptionError(f"`gripper` {quote(self.gripper)} is real; give the sensors' cameras with `left` and `right`")
        return GripperRig({name: open_camera(text, self.sensor, self.form) for name, text in cameras.items()}, arm, gripper)


@dataclass(frozen=True)
class Gripped:
    """The result of ``grip``: its steps, and the folders of the records."""

    steps: list[GripStep]
    written: list[Path] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The result as lines of text."""
        heights_mm, first, last = [step.state.pose[2] for step in self.steps], self.steps[0], self.steps[-1]
        spent_s = last.state.time_s - first.state.time_s
        return [
            f"{len(self.steps)} steps in {spent_s:.1f} s",
            f"hand lifted by {max(heights_mm) - heights_mm[0]:.1f} mm; gripper from {first.width_mm:.1f} to {last.width_mm:.1f} mm",
        ]


@writes("left", "right", *ALSO)
def grip(
    plan: GripPlan, policy: Decide, out: Path, *, steps: int, period_s: float = 0.0, progress: Progress = silent
) -> Gripped | DryRunDone:
    """Run a policy, and write the records to ``out``: a session for each sensor, and all of them in further formats.

    Raises
    ------
    TwinError
        As ``run_gripper``. The records up to there stay.
    """
    kept, rig = KeptAlso(out, plan.also, plan.sensor), plan.build()
    pipelines, found = {name: Pipeline(plan.sensor, plan.form) for name in rig.sources}, list[GripStep]()
    if plan.dry_run:
        with rig.connect():
            for name, source in rig.sources.items():
                for line in check_standing(source, rig.arm, pipelines[name]):
                    LOG.warning("%s: %s", name, line)
        return DryRunDone()
    with stage(progress, f"policy on {rig.gripper.name}") as report, kept:

        def decide(step: GripStep) -> tuple[np.ndarray, float]:
            found.append(step)
            report(step.index, steps)
            return policy(step)

        try:
            timeout_s = TWIN_FRAME_S if any(isinstance(source, TwinCamera) for source in rig.sources.values()) else FRAME_S
            run_gripper(rig, pipelines, decide, steps=steps, out=out, period_s=period_s, timeout_s=timeout_s, ros2=plan.ros2)
        finally:
            if len(found) > 1:  # a step is written after its move
                kept.catch_up()
    return Gripped(found, [out / name for name in (*rig.sources, *kept.formats)])
