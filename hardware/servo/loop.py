"""The servo loop: frame, estimate, law, move. It uses any frame source, estimator and arm through their protocols.

A frame is exposed while the arm moves. Therefore the loop keeps the newest states of the arm (``ArmWatch``), and takes the pose at the
frame's exposure from them. The thread of ``ArmWatch`` also stops an arm that no longer answers.

The servo law, ``servo_step``, is a pure function: from the surface in a frame and the arm's present pose to its next pose. An estimate of
depth and angle, together with the arm's pose when the frame was exposed, puts the surface's tangent into the base frame. The law compares
the present pose of the arm with that tangent, so a frame may be older than the last move. Depth d and angle w of the tool against the
tangent, reference r, sums S of the errors (bounded),

    e = r - (d, w),   S' = clip(S + e),   (d, w)' = (d, w) + kp e + ki S',   along' = along + feed

(Lepora & Lloyd's pose-based tactile servoing; positions are commanded, so the arm itself is one integrator).
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.arm import ArmState
from hardware.cameras.source import no_frame
from hardware.errors import DeviceError, StaleDataError
from hardware.rig.geometry import HOLD_DEG
from hardware.safety.decide import DecisionCode, Sensed
from hardware.safety.eyes import NEAR_MM, BlindError, pieces_to
from hardware.safety.safe_arm import RefusedMoveError
from hardware.servo.timing import TimeSpread, Timing
from hardware.workcell.build import MOVE_TIMEOUT_S, Mover, Rig
from scenes.servo import ServoSpec
from twin.errors import ErrorsAs
from twin.estimate import Estimate, Estimator
from twin.rig.arm_pose import matrix_of, pose_of
from twin.rig.kinematics import Mounting
from twin.types import Frame


@dataclass(frozen=True)
class Memory:
    """Sums of the errors of depth (mm) and angle (deg) over the steps."""

    depth_mm: float = 0.0
    angle_deg: float = 0.0


@dataclass(frozen=True)
class Reading:
    """Depth of the tool beyond first touch, and its angle from the surface's normal."""

    depth_mm: float
    angle_deg: float


@dataclass(frozen=True)
class LawStep:
    """The result of one step of the law.

    Attributes
    ----------
    pose : (6,) float
        The arm's next pose.
    memory : Memory
    """

    pose: np.ndarray
    memory: Memory


def tangent_of(mounting: Mounting, pose: np.ndarray, reading: Reading) -> np.ndarray:
    """``T_base_surface`` (4, 4), the pose of a tool that just touches the surface and stands normal to it.

    Parameters
    ----------
    mounting : Mounting
    pose : (6,) float
        The arm's pose when the frame was exposed.
    reading : Reading
    """
    T = matrix_of(pose)
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(-np.radians(reading.angle_deg) * mounting.out_of_plane).as_matrix()
    T[:3, 3] -= reading.depth_mm * (T[:3, :3] @ mounting.axis)
    return T


def reading_at(mounting: Mounting, T_base_surface: np.ndarray, pose: np.ndarray) -> Reading:
    """Depth and angle of a tool at a pose (6,) against a tangent (4, 4)."""
    seen = np.linalg.inv(T_base_surface) @ matrix_of(pose)
    turn = Rotation.from_matrix(seen[:3, :3]).as_rotvec(degrees=True)
    return Reading(float(mounting.axis @ seen[:3, 3]), float(mounting.out_of_plane @ turn))


def servo_step(
    spec: ServoSpec, mounting: Mounting, T_base_surface: np.ndarray, pose: np.ndarray, memory: Memory, *, fresh: bool = True
) -> LawStep:
    """The arm's next pose.

    Parameters
    ----------
    spec : ServoSpec
    mounting : Mounting
    T_base_surface : (4, 4) float
        The surface's tangent from ``tangent_of``.
    pose : (6,) float
        The arm's present pose, or the last pose to which it was sent.
    memory : Memory
    fresh : bool
        Whether the tangent comes from a new frame; an old frame does not change the sums.
    """
    axis, out_of_plane = mounting.axis, mounting.out_of_plane
    now = reading_at(mounting, T_base_surface, pose)
    error_mm, error_deg = spec.indent_mm - now.depth_mm, spec.angle_deg - now.angle_deg
    if fresh:
        bounds = np.array([spec.integral_mm, spec.integral_deg])
        memory = Memory(*np.clip([memory.depth_mm + error_mm, memory.angle_deg + error_deg], -bounds, bounds).tolist())
    press_mm = spec.kp_depth * error_mm + spec.ki_depth * memory.depth_mm
    turn_deg = spec.kp_angle * error_deg + spec.ki_angle * memory.angle_deg
    turn_deg = float(np.clip(turn_deg, -spec.largest_turn_deg, spec.largest_turn_deg))
    step_mm = spec.feed_mm * mounting.across + press_mm * axis
    step_mm *= min(1.0, spec.largest_move_mm / max(float(np.linalg.norm(step_mm)), 1e-9))
    T = matrix_of(pose)
    T[:3, :3] = T_base_surface[:3, :3] @ Rotation.from_rotvec(np.radians(now.angle_deg + turn_deg) * out_of_plane).as_matrix()
    T[:3, 3] += T_base_surface[:3, :3] @ step_mm
    return LawStep(pose_of(T, pose), memory)


LOG = logging.getLogger(__name__)
# Largest lag of the arm behind its target, in largest moves of the servo. An arm that lags farther gets no new target.
BEHIND_MOVES = 2.0
# Reasons for which a refused move only makes the arm hold still.
HELD = (DecisionCode.STALE_FRAME, DecisionCode.SLIPPING, DecisionCode.HELD_FORCE)


@dataclass(frozen=True, slots=True)
class StepRecord:
    """The record of one step.

    Attributes
    ----------
    index : int
    time_s : float
        ``time.monotonic()`` when the command was given.
    sequence : int
        Sequence number of the frame on which the step was decided.
    frame_s : float
        Time of the frame's exposure.
    age_s : float
        Age of the frame when the loop received it.
    fresh : bool
        Whether no earlier step used the frame.
    latency_s : float
        Time from the exposure to the command.
    compute_s : float
        Time from receiving the frame to the command.
    names : tuple of str
        Names of the estimated labels.
    value, low, high : (K,) float
        The estimate and the limits of its interval; NaN if the estimate is not valid.
    depth_mm, angle_deg : float
        Estimated depth of the tool, and estimated angle between the tool and the surface's normal.
    pose : (6,) float
        The pose from which the step was decided: where the arm is, or the end of its present move.
    exposed_pose : (6,) float
        The arm's pose at the frame's exposure.
    joints_deg : (J,) float
    sent : (6,) float
        The pose that was commanded.
    """

    index: int
    time_s: float
    sequence: int
    frame_s: float
    age_s: float
    fresh: bool
    latency_s: float
    compute_s: float
    names: tuple[str, ...]
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    depth_mm: float
    angle_deg: float
    pose: np.ndarray
    exposed_pose: np.ndarray
    joints_deg: np.ndarray
    sent: np.ndarray


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the loop.

    Attributes
    ----------
    steps : int
    blocking : bool
        If true, the loop waits for the end of each move and takes a frame that was exposed after it. Otherwise it decides on the newest
        frame every ``period_s``.
    period_s : float
    frame_timeout_s : float
        Longest wait for a frame. It applies with ``blocking``, and to the first frame in any case.
    give_up_s : float
        The loop ends with an error after it has held still for this time.
    """

    steps: int
    blocking: bool = True
    period_s: float = 0.1
    frame_timeout_s: float = 3.0
    give_up_s: float = 3.0


@dataclass(frozen=True)
class LoopHooks:
    """Functions that a loop calls.

    Attributes
    ----------
    law : callable, optional
        Replaces the servo law: gives the next pose (6,) from the arm's pose (6,) and the estimate.
    take_rest : callable, optional
        Gets a frame without contact, taken clear of the object, and returns the estimator to use from then on.
    on_step : callable, optional
        Called with each record, its frame and its estimate after the move was commanded.
    on_estimate : callable, optional
        Called with each used frame and its estimate, valid or not. It must return at once.
    """

    law: Callable[[np.ndarray, Estimate], np.ndarray] | None = None
    take_rest: Callable[[Frame], Estimator] | None = None
    on_step: Callable[[StepRecord, Frame, Estimate], object] | None = None
    on_estimate: Callable[[Frame, Estimate], object] | None = None


class Decided(StrEnum):
    """The decision with which a round of the loop ends."""

    MOVE = "moved"
    AWAIT_ARM = "let the arm catch up"
    AWAIT_FRAME = "awaited a newer frame"  # the arm is too far from the place in the last frame
    HOLD = "held still"


@dataclass
class _NewestFrame:
    """The result of the newest used frame.

    Attributes
    ----------
    frame, estimate : Frame, Estimate
        None before the first one.
    reading : Reading
    doubt : str
        Reason why the estimate can't be trusted ("" if it can).
    exposed_pose : (6,) float
        The arm's pose when the last trusted frame was exposed.
    tangent : (4, 4) float
        Tangent of the surface in this frame; None before the first trusted frame.
    """

    frame: Frame | None = None
    estimate: Estimate | None = None
    reading: Reading = Reading(np.nan, np.nan)
    doubt: str = ""
    exposed_pose: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    tangent: np.ndarray | None = None


class ServoLoop:
    """Runs the law on the frames of a connected rig.

    Parameters
    ----------
    rig : Rig
    servo : ServoSpec
    estimator : Estimator
    settings : LoopSettings
    hooks : LoopHooks, optional

    Attributes
    ----------
    notes : list of str
        Problems of the run.
    """

    def __init__(self, rig: Rig, servo: ServoSpec, estimator: Estimator, settings: LoopSettings, hooks: LoopHooks | None = None) -> None:
        self.source, self.arm, self.mounting = rig.source, rig.arm, rig.mounting
        self.servo, self.estimator, self.settings, self.hooks = servo, estimator, settings, hooks or LoopHooks()
        self.mover = Mover(rig, (servo.linear_mm_s, servo.angular_deg_s), clear_mm=servo.clear_mm, patience_s=settings.give_up_s)
        self.records: list[StepRecord] = []
        self.decided: list[tuple[Decided, float]] = []  # every decision, with the age (s) of its frame (NaN without a frame)
        self._held_since: float | None = None  # when the arm began to hold still
        self._sent: np.ndarray | None = None  # pose (6,) where the arm's queue ends, if it has a queue
        self._behind_since: float | None = None  # when the arm began to lag too far behind for a new target
        self._view, self._memory = _NewestFrame(), Memory()
        self._watch, self._axis, self.notes = self.mover.watch, self.mover.axis, self.mover.notes
        self._arrived_s: float | None = None  # when the arm came to the object; None once a frame exposed after that was used
        self._started_s = self._ended_s = 0.0

    def run(self, start_pose: np.ndarray) -> Timing:
        """Approach the start pose (6,), follow the surface for the number of steps of the settings, retreat.

        At every end, Ctrl-C included, the arm is stopped, retreats along the sensor's axis and is disabled.

        Raises
        ------
        DeviceError
            No usable frame or estimate for ``give_up_s``, or the arm failed.
        """
        touching = False
        with self.mover.watching():
            try:
                with self._watch.alert():
                    self._approach(start_pose)
                    touching = True
                    with self._watch.doing("moving to the object"):
                        self._touch(start_pose)
                    self._follow()
            finally:
                self._ended_s = time.monotonic()
                self.mover.release(touching=touching)
        return self.timing()

    def _approach(self, start_pose: np.ndarray) -> None:
        """Move to the pose clear of the object, and take the frame without contact there."""
        self.mover.enable()
        with self._watch.doing("moving clear of the object"):
            self.mover.go_around(self.mover.away_from(start_pose))
        if self.hooks.take_rest is not None:
            with no_frame():
                rest = self._exposed_after(self.mover.state().time_s)
            self.estimator = self.hooks.take_rest(rest)

    def _touch(self, target: np.ndarray) -> None:
        """Move straight to a pose (6,) in contact. Near the object each piece of the way follows a frame that shows its beginning."""
        near_mm = max(self.servo.indent_mm, 0.0) + NEAR_MM if self.source.streams else 0.0
        for pose in pieces_to(self.mover.state().pose, self.mover.turned_for(target), near_mm):
            if near_mm:
                with ErrorsAs(TimeoutError, lambda error: BlindError(f"{error}; {self.arm.name} moves only with fresh frames")):
                    self._exposed_after(self.mover.state().time_s)
            self.mover.go(pose)

    def timing(self) -> Timing:
        """Figures of the steps so far."""
        fresh = [record for record in self.records if record.fresh]
        spent_s = max(self._ended_s - self._started_s, 1e-9)
        rate_hz, fresh_hz, decided_hz = (len(made) / spent_s for made in (self.records, fresh, self.decided))
        latency, compute = (TimeSpread.of([getattr(record, key) for record in fresh]) for key in ("latency_s", "compute_s"))
        age = TimeSpread.of([age_s for _, age_s in self.decided if np.isfinite(age_s)])
        decided = {str(code): count for code in Decided if (count := sum(one is code for one, _ in self.decided))}
        dropped, notes = self.source.dropped, self.source.notes()
        return Timing(len(self.records), rate_hz, fresh_hz, latency, age, compute, dropped, decided_hz, decided, notes)

    def _follow(self) -> None:
        """Take frames and decide on each one, until all steps are made or the recording ends."""
        self._started_s = self._arrived_s = due_s = time.monotonic()
        while len(self.records) < self.settings.steps:
            if not self.settings.blocking:
                time.sleep(max(0.0, due_s - time.monotonic()))
                due_s = max(due_s + self.settings.period_s, time.monotonic())
            state = self.mover.state()
            try:
                frame = self._frame(state)
            except EOFError:
                return
            except (StaleDataError, TimeoutError, DeviceError) as problem:
                self._hold(str(problem), problem)
                continue
            self._decide(state, frame)

    def _decide(self, state: ArmState, frame: Frame) -> None:
        """Decide on one frame: move, wait for the arm, wait for a newer frame, or hold still."""
        taken_s = time.monotonic()
        age_s = taken_s - frame.time_s
        fresh = self._look(frame, state)
        if self._view.doubt:
            self._hold(self._view.doubt, None, age_s)
            return
        from_pose = state.pose if self._sent is None or not state.moving else self._sent
        if _apart_mm(from_pose, state.pose) > BEHIND_MOVES * self.servo.largest_move_mm:
            self.decided.append((Decided.AWAIT_ARM, age_s))
            self._await_arm(taken_s)
            return
        self._behind_since = None
        if not fresh and _apart_mm(from_pose, self._view.exposed_pose) + self.servo.feed_mm > self.servo.blind_mm:
            self.decided.append((Decided.AWAIT_FRAME, age_s))
            return
        wanted, memory = self._next(from_pose, fresh)
        pose, held_deg = self._axis.on_turn(wanted, from_pose[5])
        if held_deg > HOLD_DEG:
            self._turn_back(wanted)
            return
        try:
            self._sent = self.mover.send(pose)
        except (BlindError, RefusedMoveError) as error:
            if isinstance(error, RefusedMoveError) and error.decision.code not in HELD:
                raise
            self._hold(str(error), error, age_s)
            return
        if self._held_since is not None:
            LOG.warning("%s: continues after %.1f s", self.arm.name, time.monotonic() - self._held_since)
        self._memory, self._held_since = memory, None
        self.decided.append((Decided.MOVE, age_s))
        self._record(state, from_pose, self._sent, fresh=fresh, taken_s=taken_s)
        if self.settings.blocking:
            with self._watch.doing(f"waiting for the end of step {len(self.records)}"):
                try:
                    self.mover.settle(self._sent)
                except BlindError as blind:
                    self._hold(str(blind), blind, age_s)

    def _next(self, from_pose: np.ndarray, fresh: bool) -> tuple[np.ndarray, Memory]:
        """The next pose (6,) of the law, and the sums that it keeps."""
        view = self._view
        if self.hooks.law is not None:
            assert view.estimate is not None  # a trusted view has an estimate
            return self.hooks.law(from_pose, view.estimate), self._memory
        assert view.tangent is not None
        step = servo_step(self.servo, self.mounting, view.tangent, from_pose, self._memory, fresh=fresh)
        return step.pose, step.memory

    def _look(self, frame: Frame, state: ArmState) -> bool:
        """Estimate the pose in a frame if it was not used before. Returns whether the frame is fresh."""
        used = self._view.frame
        if used is not None and frame.sequence == used.sequence:
            return False
        view = self._view
        view.frame, view.estimate = frame, self.estimator(frame)
        if self.hooks.on_estimate is not None:
            self.hooks.on_estimate(frame, view.estimate)
        view.reading, view.doubt = self._reading(view.estimate)
        if not view.doubt:
            view.exposed_pose = self._watch.pose_at(frame.time_s) if self.source.is_live else state.pose
            if self.hooks.law is None:
                view.tangent = tangent_of(self.mounting, view.exposed_pose, view.reading)
            self.mover.sense(Sensed.of(view.reading.depth_mm, frame.time_s, view.estimate.names, view.estimate.value))
        return True

    def _await_arm(self, now_s: float) -> None:
        """Note that the arm lags behind its target; raise ``DeviceError`` if it has done so for too long."""
        self._behind_since = now_s if self._behind_since is None else self._behind_since
        if (behind_s := now_s - self._behind_since) > MOVE_TIMEOUT_S:
            fault = f"reports that it moves, but has not come near its target for {behind_s:.1f} s"
            raise DeviceError(f"{self.arm.name}: {fault}; look for an obstacle, call clear_error(), then begin again")

    def _record(self, state: ArmState, from_pose: np.ndarray, sent: np.ndarray, *, fresh: bool, taken_s: float) -> None:
        """Store the record of a move, and pass it to ``on_step``."""
        view, now_s = self._view, time.monotonic()
        assert view.frame is not None and view.estimate is not None  # decisions begin with the first frame
        record = StepRecord(
            index=len(self.records),
            time_s=now_s,
            sequence=view.frame.sequence,
            frame_s=view.frame.time_s,
            age_s=taken_s - view.frame.time_s,
            fresh=fresh,
            latency_s=now_s - view.frame.time_s,
            compute_s=now_s - taken_s,
            names=tuple(view.estimate.names),
            **{key: getattr(view.estimate, key) for key in ("value", "low", "high")},
            **vars(view.reading),
            pose=from_pose,
            exposed_pose=view.exposed_pose,
            joints_deg=state.joints_deg,
            sent=sent,
        )
        self.records.append(record)
        if self.hooks.on_step is not None:
            self.hooks.on_step(record, view.frame, view.estimate)

    def _frame(self, state: ArmState) -> Frame:
        """The frame to decide on: the next one of a recording, one exposed at the present stop, or the newest one."""
        if not self.source.is_live:
            return self.source.read()
        if self.settings.blocking:
            return self._exposed_after(state.time_s)
        if self._arrived_s is not None:  # the first decision must not use a frame of the approach
            frame = self._exposed_after(self._arrived_s)
            self._arrived_s = None
            return frame
        return self.source.read_latest(max_age_s=self.servo.max_frame_age_s)

    def _exposed_after(self, time_s: float) -> Frame:
        """The first frame exposed after a time; raises ``TimeoutError`` if none comes. The wait also ends if the arm is lost."""
        return self._watch.frame_after(self.source, time_s, timeout_s=self.settings.frame_timeout_s)

    def _reading(self, estimate: Estimate) -> tuple[Reading, str]:
        """Depth and angle of an estimate, and the reason why they can't be trusted ("" if they can)."""
        if not estimate.valid:
            return Reading(np.nan, np.nan), estimate.reason
        if self.hooks.law is not None:  # such a law does not use depth and angle
            return Reading(np.nan, np.nan), ""
        require_labels(self.mounting, estimate.names)
        value = dict(zip(estimate.names, np.asarray(estimate.value, float), strict=True))
        depth, angle = value[self.mounting.depth_label], value[self.mounting.angle_label]
        reading = Reading(self.mounting.depth_mm(depth), self.mounting.angle_deg(angle))
        for name, got, (low, high) in (
            ("mm deep", reading.depth_mm, self.servo.plausible_mm),
            ("deg from the normal", reading.angle_deg, self.servo.plausible_deg),
        ):
            if not low <= got <= high:
                possible = f"outside the possible [{low:g}, {high:g}]; give another model or sensor"
                return reading, f"the model estimates {got:.1f} {name}, {possible}"
        return reading, ""

    def _hold(self, reason: str, problem: Exception | None, age_s: float = float("nan")) -> None:
        """Stop the arm at its present pose. Raises ``DeviceError`` after ``give_up_s`` without a usable frame."""
        self.decided.append((Decided.HOLD, age_s))
        if self._held_since is None:
            self._held_since = time.monotonic()
            self._sent = None  # a stop empties the queue, even if feedback still reports a motion for some time
            self.arm.stop()
            self.notes.append(f"held still before step {len(self.records)}: {reason}")
            LOG.warning("%s: %s", self.arm.name, self.notes[-1])
        self.mover.eyes.stand()
        held_s = time.monotonic() - self._held_since
        if held_s > self.settings.give_up_s:
            raise DeviceError(f"no usable frame for {held_s:.1f} s, the arm holds still: {reason}") from problem
        time.sleep(min(0.05, self.settings.period_s))

    def _turn_back(self, target: np.ndarray) -> None:
        """Leave the object, turn the last axis back by a full turn, and touch the object again at a target (6,) of the other turn."""
        self.notes.append(f"step {len(self.records)}: the last axis reached its limit and turned back, clear of the object")
        LOG.warning("%s: the last axis has reached its limit; it turns back, clear of the object", self.arm.name)
        with self._watch.doing("turning its last axis back"):
            self.arm.stop()
            self.mover.forget()
            here = self.mover.state().pose
            self.mover.go(self.mover.turned_for(self.mover.away_from(here)))
            self.mover.go(self.mover.turned_for(self.mover.away_from(target)))
            self._touch(target)
        self._view, self._sent, self._arrived_s = _NewestFrame(), None, time.monotonic()


def require_labels(mounting: Mounting, names: tuple[str, ...]) -> None:
    """Raise ``DeviceError`` unless a model has the labels that following needs. Call it before anything moves."""
    if not {mounting.depth_label, mounting.angle_label} <= set(names):
        needed = f"{mounting.depth_label} and {mounting.angle_label}"
        raise DeviceError(f"the model estimates {', '.join(names)}; following a surface needs the experiment's {needed}")


def _apart_mm(one: np.ndarray, other: np.ndarray) -> float:
    """Distance between the tools of two poses (6,)."""
    return float(np.linalg.norm(one[:3] - other[:3]))
