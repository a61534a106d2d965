"""An arm whose every move is checked by ``hardware.safety.decide``, and which releases the object after any exception.

The release has several steps: stop, retreat, disable. ``try_each`` tries every step, even if one before it failed.
"""

import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from hardware.arms.arm import FEEDBACK_AGE_S, Arm, ArmState
from hardware.arms.motion import Kinematics
from hardware.errors import Connection, DeviceError, StaleDataError, also
from hardware.rig.geometry import LastAxis
from hardware.safety.decide import Action, Decision, DecisionCode, SafetyLimits, Sensed, clip, decide, decide_joints

# Number of newest decisions that are kept in memory.
KEPT_DECISIONS = 10_000
# Shares of the retreat's length. They are tried in this order until the limits allow one.
RETREAT_SHARES = (1.0, 0.75, 0.5, 0.25)


def try_each(**steps: Callable[[], object]) -> list[str]:
    """Call every step, even if one before it failed. A second Ctrl-C ends only the step that runs at that moment.

    Returns
    -------
    list of str
        The failures. If an exception is being handled, each failure is also added to it as a note. A failure of ``stop``, after which the
        arm may move, is added to the message.

    Raises
    ------
    BaseException
        The exception that interrupted a step (``KeyboardInterrupt``), after all steps were tried.
    """
    on_its_way, failed, interrupt = sys.exc_info()[1], [], None
    for name, act in steps.items():
        try:
            act()
        except Exception as error:
            failed.append(f"{name} failed: {error}")
            if on_its_way is not None and name == "stop":
                also(on_its_way, failed[-1])
            elif on_its_way is not None:
                on_its_way.add_note(failed[-1])
        except BaseException as error:
            failed.append(f"{name} was interrupted")
            interrupt = error
    if interrupt is not None:
        raise interrupt
    return failed


class RefusedMoveError(DeviceError):
    """A move was not allowed; ``decision`` states the reason."""

    def __init__(self, name: str, decision: Decision) -> None:
        super().__init__(f"{name}: not moved ({decision.code}, {decision.action}): {decision.reason}")
        self.decision = decision


class NoWayBackError(DeviceError):
    """The limits allow no straight path back from an object."""


@dataclass(frozen=True)
class LoggedDecision:
    """A decision, the call that it belongs to, and its time (``time.monotonic()``)."""

    time_s: float
    call: str
    decision: Decision


DecisionLog = Callable[[LoggedDecision], None]


class SafeArm(Connection):
    """Wraps an arm. Every move is checked before it is sent, and every decision is logged.

    As a context manager it disconnects at the end. After any exception, Ctrl-C included, it stops the arm, retreats along the
    object's normal and disables the arm. ``stop``, ``emergency_stop``, ``disable``, ``clear_error`` and ``disconnect`` are never refused.

    Parameters
    ----------
    arm : Arm
    limits : SafetyLimits
    normal : (3,) float
        Direction in the base frame in which the tool leaves the object; ``normal`` can be set at any time.
    log : callable or None
        Called with every LoggedDecision. The newest are also kept in ``decisions``.

    Raises
    ------
    DeviceError
        The limits are for another number of joints than the arm has.
    """

    def __init__(
        self, arm: Arm, limits: SafetyLimits, *, normal: Sequence[float] = (0.0, 0.0, 1.0), log: DecisionLog | None = None
    ) -> None:
        if limits.joints_deg is not None and len(limits.joints_deg) != arm.axes:
            raise DeviceError(f"{arm.name} has {arm.axes} joints, the limits are for {len(limits.joints_deg)}; give those of this arm")
        self.arm, self.limits = arm, limits
        self.name, self.axes = arm.name, arm.axes
        self.kinematics: Kinematics | None = getattr(arm, "kinematics", None)
        self.normal = np.asarray(normal, float)
        self.decisions: deque[LoggedDecision] = deque(maxlen=KEPT_DECISIONS)
        self._log = log
        self._sensed: Sensed | None = None

    def sense(self, sensed: Sensed) -> None:
        """Report the estimated contact. After the first call, a move needs a frame that is new enough. NaN means unknown."""
        self._sensed = sensed

    def forget_contact(self) -> None:
        """Drop the contact of ``sense``, because the sensor leaves the object. No move needs a frame until ``sense`` is called again."""
        self._sensed = None

    @property
    def is_connected(self) -> bool:
        return self.arm.is_connected

    def connect(self) -> None:
        self.arm.connect()

    def _ungated(self, call: str) -> None:
        """Pass on a call that is never refused."""
        self._note(call, Decision(Action.MOVE, DecisionCode.UNGATED, ""))
        getattr(self.arm, call)()

    def disconnect(self) -> None:
        self._ungated("disconnect")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None:
        try:
            if kind is not None and self.is_connected:
                self.shutdown(kind.__name__)
        finally:
            super().__exit__(kind, error, trace)

    def enable(self) -> None:
        self.arm.enable()
        self.set_speed(self.limits.linear_mm_s, self.limits.angular_deg_s)

    def disable(self) -> None:
        self._ungated("disable")

    def clear_error(self) -> None:
        self._ungated("clear_error")

    def stop(self) -> None:
        self._ungated("stop")

    def emergency_stop(self) -> None:
        self._ungated("emergency_stop")

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        return self.arm.state(max_age_s=max_age_s)

    def wait_settled(self, pose: np.ndarray, **options: Any) -> ArmState:
        """See ``Arm``."""
        return self.arm.wait_settled(pose, **options)

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        """Set the speed; a speed above the limits is reduced to them."""
        linear, angular = min(linear_mm_s, self.limits.linear_mm_s), min(angular_deg_s, self.limits.angular_deg_s)
        if (linear, angular) != (linear_mm_s, angular_deg_s):
            self._note("set_speed", Decision(Action.MOVE, DecisionCode.SPEED_CAPPED, f"to {linear:g} mm/s and {angular:g} deg/s"))
        self.arm.set_speed(linear, angular)

    def move_linear(self, pose: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        """As ``Arm.move_linear``. Returns the allowed pose.

        Raises
        ------
        RefusedMoveError
            The move was not allowed. An enabled arm was stopped. If the contact is too deep, or its force or torque is too large, the
            arm also retreated.
        """
        state = self._newest_state("move_linear")
        decision = decide(pose, state, self.limits, now_s=time.monotonic(), kinematics=self.kinematics, sensed=self._sensed)
        self._obey("move_linear", decision)
        return self.arm.move_linear(decision.allowed, wait=wait, timeout_s=timeout_s)

    def clip_pose(self, pose: np.ndarray) -> np.ndarray:
        """The pose (6,), as near to the given one as the limits permit, that ``move_linear`` would allow from the arm's present pose."""
        return clip(pose, self._newest_state("clip_pose").pose, self.limits, self.kinematics)

    def move_joints(self, joints_deg: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        """As ``Arm.move_joints``. Returns the allowed joints.

        Raises
        ------
        DeviceError
            The arm's kinematics are not known.
        RefusedMoveError
            The move was not allowed; see ``move_linear``.
        """
        if self.kinematics is None:
            raise DeviceError(f"{self.name}: its kinematics are not known, so a move of its joints can't be checked; use move_linear")
        state = self._newest_state("move_joints")
        decision = decide_joints(joints_deg, state, self.limits, now_s=time.monotonic(), kinematics=self.kinematics, sensed=self._sensed)
        self._obey("move_joints", decision)
        return self.arm.move_joints(joints_deg, wait=wait, timeout_s=timeout_s)

    def retreat(self) -> np.ndarray | None:
        """Leave the object along its normal as far as the limits allow. Returns the pose reached, or None if no retreat is allowed."""
        state = self.arm.state(max_age_s=self.limits.feedback_age_s)
        free = self.limits.model_copy(update={"step_mm": None, "step_deg": None})
        self.arm.set_speed(min(self.limits.retreat_mm_s, self.limits.linear_mm_s), self.limits.angular_deg_s)
        for share in RETREAT_SHARES:
            target = state.pose.copy()
            target[:3] += share * self.limits.retreat_mm * self.normal / np.linalg.norm(self.normal)
            target, _ = LastAxis(self.kinematics).on_turn(target, state.pose[5])
            decision = decide(target, state, free, now_s=time.monotonic(), kinematics=self.kinematics)
            self._note("retreat", decision)
            if decision.action is Action.MOVE:
                return self.arm.move_linear(decision.allowed)
        return None

    def shutdown(self, why: str) -> None:
        """Stop, retreat along the normal, disable."""
        self._note("shutdown", Decision(Action.RETRACT, DecisionCode.SHUTDOWN, why))
        for failed in try_each(stop=self.arm.stop, retreat=self.retreat, disable=self.arm.disable):
            self._note("shutdown", Decision(Action.HOLD, DecisionCode.SHUTDOWN, failed))

    def _newest_state(self, call: str) -> ArmState:
        try:
            state = self.arm.state(max_age_s=self.limits.feedback_age_s)
            if time.monotonic() - state.time_s > self.limits.feedback_age_s:  # this process was stalled since then
                state = self.arm.state(max_age_s=self.limits.feedback_age_s)
            return state
        except StaleDataError as error:
            self._obey(call, Decision(Action.HOLD, DecisionCode.STALE_FEEDBACK, str(error)))
            raise

    def _obey(self, call: str, decision: Decision) -> None:
        self._note(call, decision)
        if decision.action is Action.MOVE:
            return
        try:
            if decision.code is not DecisionCode.NOT_ENABLED:  # an arm that is not enabled stands still
                self.arm.stop()
            if decision.action is Action.RETRACT:
                self.retreat()
        except DeviceError as error:
            raise RefusedMoveError(self.name, Decision(decision.action, decision.code, f"{decision.reason}; and then: {error}")) from error
        raise RefusedMoveError(self.name, decision)

    def _note(self, call: str, decision: Decision) -> None:
        entry = LoggedDecision(time.monotonic(), call, decision)
        self.decisions.append(entry)
        if self._log is not None:
            self._log(entry)
