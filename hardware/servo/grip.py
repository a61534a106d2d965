"""A loop for several sensors on a gripper that an arm carries: a frame of each sensor, their pins, a decision, a move and a width.

The arm moves only while all cameras give fresh frames. If one does not, or its pins are not found, arm and gripper hold still, and the loop
ends with an error if that lasts. At the end the arm is stopped and disabled; the gripper keeps its width, so that it drops nothing.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from hardware.arms.arm import Arm, ArmState
from hardware.arms.mg400 import MG400
from hardware.cameras.source import FrameSource, no_frame
from hardware.errors import DeviceError
from hardware.safety.eyes import ArmWatch, FreshFrames
from hardware.safety.safe_arm import SafeArm, try_each
from twin.pins import Pipeline
from twin.records.session import SessionWriter
from twin.types import Frame, Observation


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


@dataclass(frozen=True)
class GripperRig:
    """Sensors on a gripper that an arm carries; not connected yet. ``sources`` are the sensors' cameras by the sensors' names."""

    sources: Mapping[str, FrameSource]
    arm: Arm
    gripper: Gripper


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


@dataclass(frozen=True)
class _AllSources:
    """The cameras as one, with all that ``FreshFrames`` uses: it is blind if any of them is."""

    sources: Mapping[str, FrameSource]
    name = "cameras"
    same_s = None

    def blind(self) -> str:
        return "; ".join(f"{name}: {why}" for name, source in self.sources.items() if (why := source.blind()))


def run_gripper(
    rig: GripperRig,
    pipelines: Mapping[str, Pipeline],
    decide: Decide,
    *,
    steps: int,
    out: Path | None = None,
    speed: tuple[float, float] = (50.0, 30.0),
    timeout_s: float = 5.0,
    give_up_s: float = 3.0,
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
    timeout_s, give_up_s : float
        Longest wait for a frame, and longest time without valid pins.

    Returns
    -------
    list of GripStep

    Raises
    ------
    DeviceError
        The arm fails or refuses a move, or there are no frames or no valid pins for too long.
    """
    found: list[GripStep] = []
    with ExitStack() as stack:
        stack.enter_context(rig.arm)
        for source in rig.sources.values():
            stack.enter_context(source)
        about = {"arm": rig.arm.name, "gripper": rig.gripper.name, "sensors": list(rig.sources)}
        records = {}
        for name, source in rig.sources.items():
            if out is not None:
                entries = about | {"sensor": pipelines[name].spec.name, "camera": source.name}
                records[name] = stack.enter_context(SessionWriter(out / name, entries))
        watch, eyes = ArmWatch(rig.arm), FreshFrames(rig.arm, cast(FrameSource, _AllSources(rig.sources)))
        stack.enter_context(watch.alert())
        stack.callback(lambda: try_each(stop=rig.arm.stop, disable=rig.arm.disable))
        stack.enter_context(watch.watching())
        stack.enter_context(eyes.watching())
        asked_s = valid_s = time.monotonic()
        while len(found) < steps:
            with no_frame():
                frames = {name: watch.frame_after(source, asked_s, timeout_s=timeout_s) for name, source in rig.sources.items()}
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
            step = GripStep(len(found), rig.arm.state(), rig.gripper.width_mm, frames, pins)
            motion, width_mm = decide(step)
            sent = eyes.move(partial(rig.arm.move_linear, step.state.pose + motion))
            rig.gripper.move(width_mm)
            found.append(step)
            asked_s = valid_s = time.monotonic()
            line = {"index": step.index, "time_s": asked_s, "pose": step.state.pose, "sent": sent, "width_mm": width_mm}
            for name, record in records.items():
                record.append(frames[name], line | {"pins": pins[name].pins_px})
    return found
