"""Looks at the whole way before the first motion: the camera, the path to the object, and a way back from every planned pose."""

import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from hardware.arms.arm import Arm, ArmState
from hardware.cameras.source import FrameSource, await_frame
from hardware.errors import DeviceError
from hardware.rig.approach import path_around
from hardware.rig.geometry import matrix_of
from hardware.safety.decide import Action, decide
from hardware.safety.eyes import NEAR_MM
from hardware.safety.safe_arm import RETREAT_SHARES, SafeArm
from hardware.workcell.build import Rig
from twin.errors import FrameError
from twin.pins import Pipeline
from twin.types import Frame

# Time, s, in which the camera's frames are counted.
COUNT_S = 0.5


def check_plan(
    rig: Rig,
    pipeline: Pipeline,
    clear: np.ndarray,
    planned: list[np.ndarray],
    *,
    linear_mm_s: float,
    spent_s: float,
    at_rest: Callable[[Frame], object] | None = None,
) -> list[str]:
    """Check a plan on a connected rig. Nothing moves.

    Parameters
    ----------
    pipeline : Pipeline
        Finds the sensor's pins.
    clear : (6,) float
        The pose clear of the object to which the arm goes first.
    planned : list of (6,) float
        The poses in contact, as far as they are known; the first one is the start.
    linear_mm_s : float
        Speed of the arm.
    spent_s : float
        Time of the work at the object, as far as it is known.
    at_rest : callable, optional
        Refuses a frame that can't be one without contact with a ``FrameError``. It gets the present frame if the arm stands clear of the
        object.

    Returns
    -------
    list of str
        The plan, one line for each part.

    Raises
    ------
    DeviceError
        The camera gives no frames, or frames without this sensor's pins; or the limits forbid the way to the object, the start, or the way
        back from the start.
    """
    state = rig.arm.state()
    stands_clear = -rig.placed.touch(state.pose).indent_mm > NEAR_MM
    seen = check_sight(rig.source, pipeline, at_rest=at_rest if stands_clear else None)
    way = [state.pose, *path_around(rig.placed, state.pose, clear), planned[0]]
    for start, end in pairwise(way):
        if why := _forbidden(rig.arm, start, end):
            raise DeviceError(
                f"{rig.arm.name}: the limits forbid the path to the {rig.placed.spec.name}: {why}; correct 'placement' in the file for "
                "`servo` (a Magician reaches that of `servo=magician`), or `safety`"
            )
    blocked = [n for n, pose in enumerate(planned) if not _can_retreat(rig, pose)]
    if blocked[:1] == [0]:
        raise DeviceError(f"{rig.arm.name}: the limits allow no path back from the start; correct 'placement' in the file for `servo`")
    way_mm = sum(float(np.linalg.norm(end[:3] - start[:3])) for start, end in pairwise(way))
    back = f"a path back from all {len(planned)} planned poses"
    if blocked:
        back = f"no straight path back from {len(blocked)} of {len(planned)} planned poses: from there the arm returns on its own path"
    return [
        *seen,
        f"path: {len(way) - 1} moves, {way_mm:.0f} mm, to {' '.join(f'{value:.1f}' for value in planned[0])} (mm, deg)",
        f"limits: {back}",
        f"time: about {way_mm / linear_mm_s + spent_s:.0f} s",
    ]


def check_sight(source: FrameSource, pipeline: Pipeline, *, at_rest: Callable[[Frame], object] | None = None) -> list[str]:
    """Check that a connected camera gives frames of the sensor; parameters, lines and errors as for ``check_plan``."""
    frame = await_frame(source, after_s=time.monotonic()) if source.is_live else source.read_latest()
    before = getattr(source, "arrived", 0)
    rate = ""
    if source.streams:
        time.sleep(COUNT_S)
        rate = f", {(source.arrived - before) / COUNT_S:.0f} frames/s" if hasattr(source, "arrived") else ""
    try:
        pins = pipeline(frame)
        if not pins.valid:
            raise FrameError(f"{pins.reason}; uncover and light the sensor, or give the camera of {pipeline.spec.name}")
        if at_rest is not None:
            at_rest(frame)
    except FrameError as error:
        raise DeviceError(f"{source.name}: nothing was moved: {error}") from error
    plain = "" if at_rest is None else ", as without contact"
    return [
        f"camera: {source.name}, {frame.image.shape[1]} x {frame.image.shape[0]} px{rate}",
        f"sensor: {pins.found} of {pins.expected} pins of {pipeline.spec.name} found{plain}",
    ]


def check_standing(source: FrameSource, arm: SafeArm, pipeline: Pipeline) -> list[str]:
    """Check a connected arm that a person will move in small steps from where it stands; parameters, lines and errors as for
    ``check_plan``."""
    seen, here = check_sight(source, pipeline), arm.state().pose
    if why := _forbidden(arm, here, here):
        raise DeviceError(f"{arm.name}: stands outside its limits, so it could not step back here: {why}; move it inside by hand")
    return [*seen, "limits: the path back of each step is inside"]


def _forbidden(arm: Arm, start: np.ndarray, end: np.ndarray) -> str:
    """Why the limits forbid a straight move between poses (6,); "" if they don't, or there are none."""
    if not isinstance(arm, SafeArm):
        return ""
    limits = arm.limits.model_copy(update={"step_mm": None, "step_deg": None})
    near = start if arm.kinematics is None else arm.kinematics.nearest_pose(start)
    state = ArmState(near, np.zeros(arm.axes), time.monotonic(), True, False)
    decision = decide(end, state, limits, now_s=state.time_s, kinematics=arm.kinematics)
    return "" if decision.action is Action.MOVE else decision.reason


def _can_retreat(rig: Rig, pose: np.ndarray) -> bool:
    """Whether the limits allow a part of the retreat from a pose (6,) in contact."""
    if not isinstance(rig.arm, SafeArm):
        return True
    back = np.zeros(6)
    back[:3] = -matrix_of(pose)[:3, :3] @ rig.mounting.axis * rig.arm.limits.retreat_mm
    return any(not _forbidden(rig.arm, pose, pose + share * back) for share in RETREAT_SHARES)
