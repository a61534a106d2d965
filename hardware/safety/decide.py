"""Safety limits of an arm, and the decision before every move whether it is allowed. A decision has a code and no side effects."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from hardware.arms.arm import FEEDBACK_AGE_S, ArmState
from hardware.arms.motion import LINKAGE_ABOVE, LINKAGE_BELOW, Kinematics, OutOfReachError, check_line, finite_numbers, turn_between_deg
from hardware.errors import DeviceError
from hardware.rig.geometry import distance_to_axis
from scenes.base import Fraction, NonNegative, Positive, Section, SpecError
from scenes.files import LONGEST_PATH, quote
from scenes.load import read_section
from scenes.plugins import other_files
from twin.errors import ErrorsAs

# Number of bisections of a path in the search for its last allowed place: 100 mm are divided to 0.01 mm.
CLIP_HALVINGS = 14
SHIPPED_LIMITS = Path(__file__).parents[1] / "limits"


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise ValueError(f"the first of {pair} must be the smaller")
    return pair


Range = Annotated[tuple[float, float], AfterValidator(_rising)]


class SafetyLimits(Section):
    """Limits of an arm's moves in a loop.

    An optional limit that is left out does not apply. The defaults are cautious values for a desktop arm with a soft sensor. The arms'
    manuals do not require them.

    Attributes
    ----------
    box_mm : three pairs
        Range of the tool's x, y and z in the base frame.
    annulus_mm : (nearest, farthest), optional
        Range of the tool's distance from the base's axis.
    joints_deg : pairs, optional
        Range of each joint.
    linkage_deg : float, optional
        Largest J3 - J2 of an arm with a parallel linkage.
    step_mm, step_deg : float, optional
        Longest move and largest turn of one step; a longer one is shortened.
    linear_mm_s, angular_deg_s : float
        Largest speeds.
    contact_mm : float
        Largest depth that the sensor may report.
    force_n, torque_nmm : float, optional
        Largest force, and largest torque about the sensor's axis, that the sensor may report. If one is exceeded, the arm retreats.
    hold_force_n, hold_torque_nmm : float, optional
        Force and torque above which the arm holds still. A servo loop ends and retreats if this lasts longer than its ``give_up_s``.
    slip_share : float, optional
        Largest share of the contact that may slide. If it is exceeded, the arm holds still.
    slip_begins : float, optional
        Largest probability that the contact has begun to slide, for a model that remembers earlier frames. If it is exceeded, the arm holds
        still.
    frame_age_s : float
        Largest age of the frame on which a move is decided.
    feedback_age_s : float
        Largest age of the arm's own feedback.
    retreat_mm : float
        Distance of the tool from the object at the end and after a failure.
    retreat_mm_s : float
        Speed of that retreat.
    """

    box_mm: tuple[Range, Range, Range]
    annulus_mm: tuple[NonNegative, Positive] | None = None
    joints_deg: tuple[Range, ...] | None = None
    linkage_deg: Positive | None = None
    step_mm: Positive | None = None
    step_deg: Positive | None = None
    linear_mm_s: Positive = 100.0
    angular_deg_s: Positive = 90.0
    contact_mm: Positive = 6.0
    force_n: Positive | None = None
    torque_nmm: Positive | None = None
    hold_force_n: Positive | None = None
    hold_torque_nmm: Positive | None = None
    slip_share: Fraction | None = None
    slip_begins: Fraction | None = None
    frame_age_s: Positive = 0.5
    feedback_age_s: Positive = FEEDBACK_AGE_S
    retreat_mm: Positive = 50.0
    retreat_mm_s: Positive = 50.0


def load_limits(name_or_path: str | Path) -> SafetyLimits:
    """Limits by name (``mg400``, ``magician``) or by the path of their TOML file.

    A text that is no name is a path if it has a suffix, or if a file has this path.

    Raises
    ------
    DeviceError
        There are no such limits, the file does not exist, or its content is not valid.
    """
    shipped = {file.stem: file for file in sorted(SHIPPED_LIMITS.glob("*.toml"))}
    shipped |= other_files("limits", shipped)
    path, example = shipped.get(str(name_or_path), Path(name_or_path)), SHIPPED_LIMITS / "mg400.toml"
    if not str(name_or_path) or not os.path.exists(path):  # unlike ``Path.exists``, this returns False for a text that can be no path
        problem = f"{quote(path, LONGEST_PATH)}: no such file" if path.suffix else f"no limits are called '{quote(name_or_path)}'"
        raise DeviceError(f"{problem}; give one of {', '.join(shipped)}, or the path of a TOML file like {example}")
    with ErrorsAs(SpecError, lambda error: DeviceError(f"{error}; a file like {example} is expected")):
        return read_section(path, SafetyLimits)


class DecisionCode(StrEnum):
    """Reason of a decision."""

    OK = "ok"
    STEP_SHORTENED = "step-shortened"
    NOT_A_NUMBER = "not-a-number"
    NOT_ENABLED = "not-enabled"
    ARM_ERROR = "arm-error"
    STALE_FEEDBACK = "stale-feedback"
    STALE_FRAME = "stale-frame"
    TOO_DEEP = "too-deep"
    TOO_STRONG = "too-strong"
    TOO_TWISTED = "too-twisted"
    HELD_FORCE = "held-force"
    SLIPPING = "slipping"
    OUTSIDE_BOX = "outside-box"
    OUTSIDE_ANNULUS = "outside-annulus"
    OUT_OF_REACH = "out-of-reach"
    JOINT_LIMIT = "joint-limit"
    LINKAGE_LIMIT = "linkage-limit"
    LINE_BLOCKED = "line-blocked"
    STEP_TOO_LONG = "step-too-long"
    UNGATED = "ungated"  # stop, emergency_stop, disable, clear_error: these are never refused
    SPEED_CAPPED = "speed-capped"
    SHUTDOWN = "shutdown"


class Action(StrEnum):
    """Action that follows from a decision."""

    MOVE = "move"
    REFUSE = "refuse"  # do not send the move; stop an earlier move
    HOLD = "hold"  # stop and stand still
    RETRACT = "retract"  # stop, and leave the object along its normal


@dataclass(frozen=True)
class Decision:
    """The decision about a move. ``pose`` (6,) is the pose that may be sent; None if none may be sent."""

    action: Action
    code: DecisionCode
    reason: str
    pose: np.ndarray | None = None

    @property
    def allowed(self) -> np.ndarray:
        """The pose (6,) that may be sent; raises ``ValueError`` if the decision allows none."""
        if self.pose is None:
            raise ValueError(f"nothing may be sent: {self.reason}")
        return self.pose


@dataclass(frozen=True)
class Sensed:
    """The sensor's estimate of the contact. A value that the model does not estimate is NaN, and no limit applies to it.

    Attributes
    ----------
    depth_mm : float
    frame_time_s : float
        Time of the frame's exposure (``time.monotonic()``).
    force_n : float
        Size of the force.
    torque_nmm : float
        Torque about the sensor's axis, of either sign.
    slip_share : float
        Share of the contact that slides, 0 to 1.
    slip_begins : float
        Probability that the contact has begun to slide.
    """

    depth_mm: float
    frame_time_s: float
    force_n: float = float("nan")
    torque_nmm: float = float("nan")
    slip_share: float = float("nan")
    slip_begins: float = float("nan")

    @property
    def turning_nmm(self) -> float:
        """Size of the torque about the sensor's axis."""
        return abs(self.torque_nmm)

    @classmethod
    def of(cls, depth_mm: float, frame_time_s: float, names: Sequence[str], value: np.ndarray) -> "Sensed":
        """The contact from the labels (K,) of an estimate.

        They are ``force_x, force_y, force_z`` or ``Fx, Fy, Fz``, ``torque_z`` or ``Tz``, ``slip_share`` and ``slip_begins``.
        """
        known = dict(zip(names, np.asarray(value, float).tolist(), strict=True))
        missing = float("nan")
        force = [known.get(f"force_{axis}", known.get(f"F{axis}", missing)) for axis in "xyz"]
        torque = known.get("torque_z", known.get("Tz", missing))
        slip = [known.get(name, missing) for name in ("slip_share", "slip_begins")]
        return cls(depth_mm, frame_time_s, float(np.linalg.norm(force)), torque, *slip)


_TURNED, _STILL = "the torque about the sensor's axis is {0:.0f} N mm", "the arm holds still above {1:g}"
_SLIDES = "the contact begins to slide (probability {0:.0%}, allowed {1:.0%}); press harder"
_SLIPS = "{0:.0%} of the contact slides (allowed {1:.0%}); press harder"
# The arm's reaction if a value of the contact exceeds a limit, in the order of priority. Value and limit are named by their attributes.
_RULES = (
    ("depth_mm", "contact_mm", Action.RETRACT, DecisionCode.TOO_DEEP, "the contact is {0:.1f} mm deep (allowed {1:g} mm)"),
    ("force_n", "force_n", Action.RETRACT, DecisionCode.TOO_STRONG, "the force on the sensor is {0:.1f} N (allowed {1:g} N)"),
    ("turning_nmm", "torque_nmm", Action.RETRACT, DecisionCode.TOO_TWISTED, f"{_TURNED} (allowed {{1:g}} N mm)"),
    ("force_n", "hold_force_n", Action.HOLD, DecisionCode.HELD_FORCE, f"the force on the sensor is {{0:.1f}} N ({_STILL} N)"),
    ("turning_nmm", "hold_torque_nmm", Action.HOLD, DecisionCode.HELD_FORCE, f"{_TURNED} ({_STILL} N mm)"),
    ("slip_begins", "slip_begins", Action.HOLD, DecisionCode.SLIPPING, _SLIDES),
    ("slip_share", "slip_share", Action.HOLD, DecisionCode.SLIPPING, _SLIPS),
)


def decide(
    target: np.ndarray,
    state: ArmState,
    limits: SafetyLimits,
    *,
    now_s: float,
    kinematics: Kinematics | None = None,
    sensed: Sensed | None = None,
) -> Decision:
    """Decide whether the tool may move straight to a pose.

    Parameters
    ----------
    target : (6,) float
        mm and deg.
    state : ArmState
        Newest feedback.
    now_s : float
        ``time.monotonic()``.
    kinematics : Kinematics or None
        None: joints, linkage and reach are not checked.
    sensed : Sensed or None
        None: neither the frame's age nor the contact (depth, force, torque, slip) is checked.
    """
    if halted := _halt(state, limits, now_s=now_s, sensed=sensed):
        return halted
    try:
        target = finite_numbers("the target", target, 6)
    except DeviceError as error:
        return _refuse(DecisionCode.NOT_A_NUMBER, str(error))
    pose, shortened = _on_turn(state.pose, target, limits, kinematics)
    if refused := _place(pose, state.pose, limits) or _joints(pose, state.pose, limits, kinematics):
        return refused
    why = f"shortened to a step of {limits.step_mm} mm, {limits.step_deg} deg" if shortened else ""
    return Decision(Action.MOVE, DecisionCode.STEP_SHORTENED if shortened else DecisionCode.OK, why, pose)


def clip(target: np.ndarray, start: np.ndarray, limits: SafetyLimits, kinematics: Kinematics | None = None) -> np.ndarray:
    """The end pose (6,) of a straight move from ``start`` (6,) that the limits allow, as near to the target (6,) as a simple search finds.

    It is the target moved into the box and shortened to a step. If other limits forbid this pose, it is the last allowed place on the path.
    """
    pose = np.array(target, float)
    if not np.isfinite(pose).all():
        return pose
    low, high = np.array(limits.box_mm).T
    pose[:3] = np.clip(pose[:3], low, high)
    pose, _ = _on_turn(start, pose, limits, kinematics)
    way, allowed, refused = pose - start, 0.0, 2.0
    for _ in range(CLIP_HALVINGS + 1):  # the first trial is the whole path
        share = (allowed + refused) / 2
        at = start + share * way
        if _place(at, start, limits) or _joints(at, start, limits, kinematics):
            refused = share
        else:
            allowed = share
        if allowed == 1.0:
            return pose
    return start + allowed * way


def decide_joints(
    joints_deg: np.ndarray, state: ArmState, limits: SafetyLimits, *, now_s: float, kinematics: Kinematics, sensed: Sensed | None = None
) -> Decision:
    """Decide whether the joints may move to angles. Every degree of the path is checked. Too long a move is refused, not shortened."""
    if halted := _halt(state, limits, now_s=now_s, sensed=sensed):
        return halted
    try:
        end = finite_numbers("the joints", joints_deg, len(state.joints_deg))
    except DeviceError as error:
        return _refuse(DecisionCode.NOT_A_NUMBER, str(error))
    steps = max(1, int(np.ceil(np.abs(end - state.joints_deg).max())))
    for n in range(1, steps + 1):
        joints = state.joints_deg + n / steps * (end - state.joints_deg)
        pose = kinematics.forward(joints)
        if refused := _broken_joints(joints, limits, kinematics) or _place(pose, pose, limits):
            return refused
    if shorten(state.pose, pose, limits)[1]:
        return _refuse(DecisionCode.STEP_TOO_LONG, f"it would carry the tool farther than a step of {limits.step_mm} mm; go in steps")
    return Decision(Action.MOVE, DecisionCode.OK, "", pose)


def shorten(start: np.ndarray, target: np.ndarray, limits: SafetyLimits, *, unwrapped: bool = False) -> tuple[np.ndarray, bool]:
    """Shorten a move to the longest allowed step. Returns the target, or a point on the path to it, and whether the move was shortened.

    A turn takes the shorter direction. If it is ``unwrapped`` (R of an arm of four axes), it is executed as given.
    """
    way = target - start
    if not unwrapped:
        way[3:] = (way[3:] + 180.0) % 360.0 - 180.0
    length, turn = float(np.linalg.norm(way[:3])), abs(way[5]) if unwrapped else turn_between_deg(start, target)
    shares = [limit / size for limit, size in ((limits.step_mm, length), (limits.step_deg, turn)) if limit is not None and size > limit]
    return (start + min(shares) * way, True) if shares else (target.copy(), False)


def _on_turn(start: np.ndarray, target: np.ndarray, limits: SafetyLimits, kinematics: Kinematics | None) -> tuple[np.ndarray, bool]:
    """As ``shorten``, with the target on the turn of the last axis that is nearest to the middle of its range."""
    if kinematics is None:
        return shorten(start, target, limits)
    return shorten(start, kinematics.nearest_pose(target), limits, unwrapped=kinematics.axes == 4)


_refuse, _hold = partial(Decision, Action.REFUSE), partial(Decision, Action.HOLD)


def _halt(state: ArmState, limits: SafetyLimits, *, now_s: float, sensed: Sensed | None) -> Decision | None:
    if (age_s := now_s - state.time_s) > limits.feedback_age_s:
        return _hold(DecisionCode.STALE_FEEDBACK, f"feedback is {age_s:.2f} s old (allowed {limits.feedback_age_s:g} s)")
    if not (np.isfinite(state.pose).all() and np.isfinite(state.joints_deg).all()):
        return _hold(DecisionCode.NOT_A_NUMBER, f"the arm reports the impossible pose {state.pose}; restart it")
    if state.error:
        return _hold(DecisionCode.ARM_ERROR, state.error)
    if not state.enabled:
        return _refuse(DecisionCode.NOT_ENABLED, "the arm is not enabled; call enable() first")
    if sensed is None:
        return None
    if not (age_s := now_s - sensed.frame_time_s) <= limits.frame_age_s:
        return _hold(DecisionCode.STALE_FRAME, f"the sensor's frame is {age_s:.2f} s old (allowed {limits.frame_age_s:g} s)")
    for value, limit, action, code, text in _RULES:
        reading, allowed = getattr(sensed, value), getattr(limits, limit)
        if allowed is not None and reading > allowed:  # NaN never exceeds a limit
            return Decision(action, code, text.format(reading, allowed))
    return None


def _place(pose: np.ndarray, start: np.ndarray, limits: SafetyLimits) -> Decision | None:
    for axis, value, (low, high) in zip("xyz", pose[:3], limits.box_mm, strict=True):
        if not low <= value <= high:
            return _refuse(DecisionCode.OUTSIDE_BOX, f"{axis} {value:.1f} mm is outside the box's [{low:g}, {high:g}] mm")
    if limits.annulus_mm is None:
        return None
    inner, outer = limits.annulus_mm
    nearest = min(distance_to_axis(start[:2], pose[:2]), float(np.hypot(*pose[:2])))
    if np.hypot(*pose[:2]) > outer or (nearest < inner and nearest < np.hypot(*start[:2])):
        reason = f"comes within {nearest:.1f} mm of the base's axis or beyond [{inner:g}, {outer:g}] mm"
        return _refuse(DecisionCode.OUTSIDE_ANNULUS, reason)
    return None


def _joints(pose: np.ndarray, start: np.ndarray, limits: SafetyLimits, kinematics: Kinematics | None) -> Decision | None:
    if kinematics is None:
        return None
    pose = kinematics.nearest_pose(pose)
    try:
        joints = kinematics.inverse(pose)
    except OutOfReachError as error:
        return _refuse(DecisionCode.OUT_OF_REACH, str(error))
    if broken := _broken_joints(joints, limits, kinematics):
        return broken
    blocked = check_line(kinematics, kinematics.nearest_pose(start), pose)
    return _refuse(DecisionCode.LINE_BLOCKED, blocked.text) if blocked else None


def _broken_joints(joints: np.ndarray, limits: SafetyLimits, kinematics: Kinematics) -> Decision | None:
    if own := kinematics.violation(joints):
        code = DecisionCode.LINKAGE_LIMIT if own.code in (LINKAGE_ABOVE, LINKAGE_BELOW) else DecisionCode.JOINT_LIMIT
        return _refuse(code, own.text)
    for n, (angle, (low, high)) in enumerate(zip(joints, limits.joints_deg or (), strict=False), start=1):
        if not low <= angle <= high:
            return _refuse(DecisionCode.JOINT_LIMIT, f"J{n} at {angle:.1f} deg is outside [{low:g}, {high:g}] deg")
    if limits.linkage_deg is not None and joints[2] - joints[1] > limits.linkage_deg:
        return _refuse(DecisionCode.LINKAGE_LIMIT, f"J3 - J2 = {joints[2] - joints[1]:.1f} deg is more than {limits.linkage_deg:g}")
    return None
