"""The one way in which a program moves an arm to an object and away from it.

Towards the object the arm moves only while the camera gives fresh frames (``FreshFrames``). A thread stops it if it no longer answers
(``ArmWatch``). At the end it leaves the object straight, or the way it came if the limits forbid that.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from hardware.arms.arm import ArmState
from hardware.arms.motion import turn_between_deg
from hardware.errors import DeviceError
from hardware.rig.geometry import HOLD_DEG, LastAxis, path_around, shift_in_tool
from hardware.safety.decide import Sensed
from hardware.safety.eyes import ArmWatch, FreshFrames
from hardware.safety.safe_arm import NoWayBackError, SafeArm, try_each
from hardware.workcell.build import Rig
from twin.rig.arm_pose import matrix_of
from twin.types import Frame

LOG = logging.getLogger(__name__)
# Largest number of pieces into which the limits may divide a move.
MOST_PIECES = 200
# Largest distance, mm, and turn, deg, between the end of a move and its target at which no further piece is needed.
NEAR_MM, NEAR_DEG = 0.5, 0.5
# Time in s that a move may take in addition to the duration that its path and speed give.
MOVE_TIMEOUT_S = 10.0
# Factor on the duration that a move's path and speed give, because arms round their speed to whole percents.
SPARE = 2.0


class Mover:
    """Moves the arm of a connected rig to its object and away from it.

    Parameters
    ----------
    rig : Rig
    speed : (float, float)
        Speed of the arm in mm/s and deg/s.
    clear_mm : float
        Distance by which an arm without limits is withdrawn.
    patience_s : float
        Longest wait for a fresh frame before a move.

    Attributes
    ----------
    notes : list of str
        Problems at the release.
    """

    def __init__(self, rig: Rig, speed: tuple[float, float], *, clear_mm: float, patience_s: float) -> None:
        self.arm, self.source = rig.arm, rig.source
        self.notes: list[str] = []
        self.watch = rig.watch = ArmWatch(rig.arm)
        self.eyes = FreshFrames(rig.arm, rig.source, self.watch.pose_at, lambda pose: float(rig.placed.touch(pose).indent_mm))
        self.axis = LastAxis(getattr(rig.arm, "kinematics", None), rig.mounting.centre_mm)
        self._placed, self._speed, self._clear_mm, self._patience_s = rig.placed, speed, clear_mm, patience_s
        self._safe = rig.arm if isinstance(rig.arm, SafeArm) else None
        self._came: list[np.ndarray] = []  # the poses (6,) at which the arm was since it stood clear of the object

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Context in which the threads look at arm and camera."""
        with self.watch.watching(), self.eyes.watching():
            yield

    def enable(self) -> None:
        """Wait for a fresh frame, then enable the arm and set its speed."""
        self.forget()  # the contact of an earlier run
        with self.watch.doing("waiting for a fresh frame"):
            self.eyes.await_frame(timeout_s=max(self._patience_s, self.source.first_frame_s))
        with self.watch.doing("enabling"):
            self.arm.enable()
            self.arm.set_speed(*self._speed)

    def state(self) -> ArmState:
        """The arm's newest state, which the watch also keeps; ``DeviceError`` if the arm was lost or reports an error."""
        self.watch.require()
        state = self.arm.state()
        if state.error:
            raise DeviceError(f"{self.arm.name}: {state.error}")
        self.watch.add(state)
        return state

    def sense(self, sensed: Sensed) -> None:
        """Report the estimated contact to the limits of a ``SafeArm``."""
        if self._safe is not None:
            self._safe.sense(sensed)

    def forget(self) -> None:
        """Drop this contact, because the sensor leaves the object."""
        if self._safe is not None:
            self._safe.forget_contact()

    def frame_after(self, time_s: float, *, timeout_s: float) -> Frame:
        """The first frame exposed after a time; ``TimeoutError`` if none comes. The wait also ends if the arm is lost."""
        return self.watch.frame_after(self.source, time_s, timeout_s=timeout_s)

    def go_around(self, clear: np.ndarray) -> ArmState:
        """Move around the object to a pose (6,) clear of it. Returns the state there."""
        for pose in path_around(self._placed, self.state().pose, clear):
            state = self.go(self.turned_for(pose))
        self._came.clear()
        return state

    def go(self, target: np.ndarray) -> ArmState:
        """Move straight to a pose (6,), in several pieces if the limits shorten the move. Returns the state that confirms it."""
        for _ in range(MOST_PIECES):
            self.eyes.await_frame(timeout_s=self._patience_s)
            sent = self.send(target)
            state = self.settle(sent)
            if np.linalg.norm(sent[:3] - target[:3]) < NEAR_MM and turn_between_deg(sent, target) < NEAR_DEG:
                return state
        short_mm = float(np.linalg.norm(sent[:3] - target[:3]))
        raise DeviceError(f"{self.arm.name}: {MOST_PIECES} moves end {short_mm:.1f} mm from the target; allow longer steps in `safety`")

    def send(self, target: np.ndarray) -> np.ndarray:
        """Send a move to a pose (6,), while frames are fresh. Returns the pose that was commanded."""
        here = self.state().pose
        self._came.append(here)
        return self.eyes.move(partial(self.arm.move_linear, target, wait=False, timeout_s=self._lasts_s(here, target)), ends=False)

    def settle(self, sent: np.ndarray) -> ArmState:
        """Wait for the end of a move to a pose (6,), while frames are fresh. Returns the state there."""
        return self.eyes.move(partial(self.arm.wait_settled, sent, timeout_s=self._lasts_s(self.arm.state().pose, sent)))

    def turned_for(self, target: np.ndarray) -> np.ndarray:
        """The target (6,) on the present turn of the last axis, after a turn back if one is needed."""
        here = self.state().pose
        pose, held_deg = self.axis.on_turn(target, here[5])
        if held_deg <= HOLD_DEG:
            return pose
        turned = self.axis.turned_back(here, target)
        if turned is None:
            raise DeviceError(
                f"{self.arm.name}: its last axis can't turn the sensor that far, {held_deg:.0f} deg are missing; turn the object "
                "('placement.turn_deg' in a file for `servo`), or give no more `steps` than were made"
            )
        for share in (1 / 3, 2 / 3, 1.0):  # each part is less than half a turn, so that its direction is unambiguous
            self.go(here + share * (turned - here))
        return self.axis.on_turn(target, turned[5])[0]

    def away_from(self, pose: np.ndarray) -> np.ndarray:
        """The pose (6,) withdrawn by ``clear_mm`` along the sensor's axis."""
        return shift_in_tool(pose, -self._clear_mm * self._placed.mounting.axis)

    def release(self, *, touching: bool) -> list[str]:
        """Stop the arm, withdraw it if it may touch the object, and disable it. Every step is tried, even if one before it failed.

        Returns the failures, which are also added to ``notes``.
        """
        back: dict[str, Callable[[], object]] = {"retreat": self._withdraw} if touching else {}
        with self.watch.doing("withdrawing"):
            failed = try_each(stop=self.arm.stop, **back, disable=self.arm.disable)
        self.notes += failed
        return failed

    def _withdraw(self) -> None:
        """Leave the object straight, or through the poses at which the arm was. This needs no frames."""
        try:
            self._retreat(self.arm.state().pose)
        except NoWayBackError as error:
            if not self._came:
                raise
            self.notes.append(f"{error}; returned on its own path instead")
            LOG.warning("%s: %s", self.arm.name, self.notes[-1])
            self.forget()
            for there in reversed(self._came):
                self.arm.move_linear(there, timeout_s=MOVE_TIMEOUT_S)

    def _retreat(self, pose: np.ndarray) -> None:
        """Withdraw the arm straight; ``NoWayBackError`` if its limits do not allow it."""
        if self._safe is None:
            self.arm.move_linear(self.axis.on_turn(self.away_from(pose), pose[5])[0], timeout_s=MOVE_TIMEOUT_S)
            return
        self._safe.normal = -matrix_of(pose)[:3, :3] @ self._placed.mounting.axis
        if self._safe.retreat() is None:
            raise NoWayBackError(f"the limits allow no path back: {self._safe.decisions[-1].decision.reason}; free the sensor by hand")

    def _lasts_s(self, here: np.ndarray, target: np.ndarray) -> float:
        """Longest time that a move between poses (6,) may take."""
        way_s = max(float(np.linalg.norm(target[:3] - here[:3])) / self._speed[0], abs(target[5] - here[5]) / self._speed[1])
        return MOVE_TIMEOUT_S + SPARE * way_s
