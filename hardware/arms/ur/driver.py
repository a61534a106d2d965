"""Driver of a Universal Robots arm (CB3 and e-Series) through ``ur_rtde``."""

import contextlib
import importlib.util
import logging
import re
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hardware.arms.arm import FEEDBACK_AGE_S, POLL_S, ArmState, KinematicArm
from hardware.arms.motion import way_between
from hardware.arms.ur.client import CONNECT_S, WATCHDOG_HZ, ClientProcess
from hardware.arms.ur.kinematics import MODELS, UrKinematics, pose_from_ur, pose_to_ur
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError
from twin.errors import ErrorsAs, ExtraError
from twin.rig.arm_pose import matrix_of

LOG = logging.getLogger(__name__)
# RTDE's robot_mode, safety_mode and runtime_state.
POWER_OFF, IDLE, RUNNING = 3, 5, 7
NORMAL, PROTECTIVE, EMERGENCY = 1, 3, 7
STOPPED, PLAYING, PAUSED = 1, 2, 4
# The safety modes in which it does not move, in words.
SAFETY = {
    PROTECTIVE: "protective stop; free the arm and look for the cause, then call clear_error() and enable()",
    4: "recovery mode; leave it at the teach pendant",
    5: "safeguard stop; close the safeguard",
    **dict.fromkeys((6, EMERGENCY), "emergency stop; release it at the robot"),
    **dict.fromkeys((8, 9), "safety violation or fault; restart the robot"),
}
DASHBOARD_PORT = 29999
ENDED = "its control program was ended by its watchdog, by a limit, at the teach pendant or by another program; call enable()"
# Longest waits, s: for power and brakes; for the release of a protective stop, which is possible after 5 s; for a reply; for the reply to
# a stop, and until feedback shows that it stands; and for packets that have arrived while this program was stalled.
POWER_S, UNLOCK_S, REPLY_S, STOP_S, READ_S = 30.0, 8.0, 1.0, 0.4, 0.05
# Speeds of joints, rad/s, above which the arm moves: the target's, which has no noise, and the measured one.
TARGET_RAD_S, ACTUAL_RAD_S = 1e-5, 0.02
HALF_TURN_DEG = 181.0  # the most that a joint turns in a linear move, and a margin
# Speeds until ``set_speed``, mm/s and deg/s; the largest speed, m/s or rad/s; accelerations of lines, m/s^2, and of joints, rad/s^2.
SPEEDS, MOST_SPEED, LINEAR_M_S2, JOINT_RAD_S2 = (50.0, 30.0), 3.0, 1.2, 1.4


class UR(KinematicArm):
    """A Universal Robots arm with PolyScope 3 or 5.

    Its pose is that of the arm's active TCP in the base frame. ``enable`` uploads the control program of ``ur_rtde``, which ends any other
    program. ``disable`` ends it, as does an ``enable`` that fails; then nothing moves the arm, and the motors hold it. ``emergency_stop``
    switches them off. If this program dies or the link is lost, a watchdog in the arm ends the control program. A link that was lost is
    opened by ``connect`` only. The speed slider slows all moves; it is never changed, and logged.

    Parameters
    ----------
    host : str
    """

    axes = 6
    kinematics: UrKinematics

    def __init__(self, host: str) -> None:
        self.name, self._host = f"UR at {host}", host
        self.kinematics = UrKinematics()
        self._client: Any = None  # a ``ClientProcess`` from connect to disconnect, even if the connection is lost in between
        self._speeds, self._slider = SPEEDS, 1.0
        self._enabled = self._under_way = False  # whether this driver has enabled it, and has sent a move since it stood

    @property
    def is_connected(self) -> bool:
        return self._client is not None and self._client.is_alive

    def connect(self) -> None:
        self._require_disconnected()
        if importlib.util.find_spec("rtde_control") is None:
            raise ExtraError("this needs ur_rtde, which is not installed: pip install 'tactip-twin[ur]', or ur_rtde alone")
        self._close()  # remains of a lost connection
        remedy = "check the address, the cable, and that RTDE and dashboard are switched on, or start 'twin emulate ur'"
        with ErrorsAs(ConnectionError, lambda error: DeviceNotConnectedError(f"{self.name}: can't connect ({error}); {remedy}")):
            self._client = ClientProcess(self._host)
        try:
            self._require_shown(lambda packet: True, REPLY_S, "sends no feedback")
            version = re.search(r"\d+", self._tell("PolyscopeVersion", REPLY_S))
            model = self._tell("get robot model", REPLY_S).rstrip("e"), int(version[0] if version else 0)
            if model not in MODELS:
                raise DeviceError(f"{self.name}: {model} is no known model and version of PolyScope: {sorted(MODELS)}")
            state, kinematics = self.state(), self.kinematics
            kinematics.lengths_mm[:] = MODELS[model]
            kinematics.T_flange_tool[:] = np.linalg.inv(kinematics.flange(state.joints_deg)) @ matrix_of(state.pose)
        except BaseException:
            self._close()
            raise

    def disconnect(self) -> None:
        if self._enabled:
            self._disconnect(self.disable, close=self._close)
        else:  # another program may use it
            self._close()

    def enable(self) -> None:
        self._require_connected()
        packet = self._newest()
        if why := SAFETY.get(packet["SafetyMode"]):
            raise DeviceError(f"{self.name}: {why}")
        for request, mode in (("power on", IDLE), ("brake release", RUNNING)):
            if self._newest()["RobotMode"] < mode:
                reply = self._tell(request, REPLY_S)
                otherwise = f"does not switch on ({request}: {reply})"
                self._require_shown(lambda packet, mode=mode: packet["RobotMode"] >= mode, POWER_S, otherwise)  # type: ignore[misc]
        self._ask("connect", timeout_s=CONNECT_S)
        if not self._enabled or packet["RuntimeState"] != PLAYING:
            with self._watch_enabling():
                self._enabled = True  # from now on the program may run, even if nothing is heard of it
                self._ask("enable", timeout_s=CONNECT_S)
                self._require_shown(lambda packet: packet["RuntimeState"] == PLAYING, REPLY_S, ENDED)

    def disable(self) -> None:
        self._require_in_use()
        if self._enabled:
            self._halt(lambda: self._tell("stop"), lambda packet: packet["RuntimeState"] == STOPPED and not _moves(packet))
        self._enabled = False

    def clear_error(self) -> None:
        """Release a protective stop, which is possible 5 s after it began. An emergency stop is released at the robot."""
        self._require_connected()
        self.disable()  # otherwise the paused program could go on
        deadline = time.monotonic() + UNLOCK_S
        while (mode := self._newest()["SafetyMode"]) == PROTECTIVE and time.monotonic() < deadline:
            with contextlib.suppress(DeviceError):
                self._tell("close safety popup")
                self._tell("unlock protective stop")
            self._shows(lambda packet: packet["SafetyMode"] != PROTECTIVE, STOP_S)
        if mode in SAFETY:
            raise DeviceError(f"{self.name}: {SAFETY[mode]}")

    def stop(self) -> None:
        self._require_in_use()
        if self._enabled:
            self._halt(lambda: self._ask("stopL", timeout_s=STOP_S), lambda packet: not _moves(packet))

    def emergency_stop(self) -> None:
        self._require_in_use()
        self._halt(lambda: self._tell("power off"), lambda packet: packet["RobotMode"] < IDLE)
        self._enabled = False

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        self._require_connected()
        packet = self._newest(max_age_s)
        pose, joints = pose_from_ur(np.array(packet["ActualTCPPose"])), np.degrees(packet["ActualQ"])
        self._require_possible(pose)
        self.kinematics.near_deg[:] = joints
        ended = ENDED if self._enabled and packet["RuntimeState"] != PLAYING else ""
        error = SAFETY.get(packet["SafetyMode"], ended)
        return ArmState(pose, joints, packet["time_s"], self._enabled and not error, _moves(packet), error)

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        self._require_speeds(linear_mm_s, angular_deg_s)
        self._speeds = linear_mm_s, angular_deg_s

    def _joints_at(self, pose: np.ndarray) -> np.ndarray:
        self.state()  # which tells the kinematics the present joints
        return super()._joints_at(pose)

    def _move(self, joints: np.ndarray, pose: np.ndarray | None, *, wait: bool, timeout_s: float) -> None:
        state = self.state()
        if state.error or not state.enabled:
            raise DeviceError(f"{self.name}: {state.error or 'not enabled; call enable() first'}")
        self._require_within(joints)
        if pose is None:
            method, target, speed, acceleration = "moveJ", np.radians(joints).tolist(), np.radians(self._speeds[1]), JOINT_RAD_S2
        else:
            if np.abs(joints - state.joints_deg).max() > HALF_TURN_DEG:  # ``inverse`` has turned it back by a full turn
                raise DeviceError(f"{self.name}: a joint would pass its end, so nothing was sent; turn it back with move_joints")
            # the arm takes the speed as m/s or as rad/s: whichever takes longer, line or turn
            way_mm, turn_deg = way_between(state.pose, pose, self.axes)
            lasts_s = max(way_mm / self._speeds[0], turn_deg / self._speeds[1], POLL_S)
            method, target, speed, acceleration = "moveL", pose_to_ur(pose), max(way_mm / 1000, np.radians(turn_deg)) / lasts_s, LINEAR_M_S2
        if (slider := self._newest()["TargetSpeedFraction"]) != self._slider:
            LOG.warning("%s: its speed slider is at %.0f %%, which slows all moves", self.name, 100 * slider)
        self._under_way, self._slider = True, slider
        if not self._ask(method, target, float(min(speed, MOST_SPEED)), acceleration, True):
            raise DeviceError(f"{self.name}: {self.state().error or 'refused the move; look at its teach pendant'}")
        if wait and pose is not None:
            self._wait_until_settled(pose, timeout_s=timeout_s)
        elif wait:  # the maker's lengths are not exactly this arm's
            self._wait_until_settled(self.kinematics.forward(joints), tolerance_mm=5.0, tolerance_deg=1.0, timeout_s=timeout_s)

    def _halt(self, act: Callable[[], object], obeyed: Callable[[dict[str, Any]], bool]) -> None:
        """Stop, and see that the arm obeys. If it does not, its control program is ended, whether or not that can be seen."""
        self._unstopped = True
        try:
            act()
            if self._under_way or self.is_connected:  # otherwise it stood, and its controller has answered
                self._require_shown(obeyed, STOP_S, "does not obey a stop")
        except DeviceError as error:
            ended = self._end_program()
            if ended and not self.is_connected:  # the controller's word, where feedback has ended
                self._enabled = self._unstopped = self._under_way = False
                raise type(error)(f"{error}. Its control program was ended over the dashboard, so it stands") from error
            watchdog = f"Without the link its watchdog stops it after {1 / WATCHDOG_HZ:g} s"
            raise type(error)(f"{self.name}: can't be stopped and may move. Press its emergency stop! {watchdog}. {error}") from error
        self._unstopped = self._under_way = False

    def _end_program(self) -> bool:
        """End the control program over the dashboard; returns whether the controller says that none runs."""
        until_s = time.monotonic() + STOP_S
        with contextlib.suppress(DeviceError):
            self._tell("stop")
            while self._tell("running").lower() != "program running: false":
                if time.monotonic() > until_s:
                    return False
                time.sleep(POLL_S)
            return True
        return False

    def _ask(self, method: str, *arguments: Any, timeout_s: float = REPLY_S) -> Any:
        lost = lambda error: DeviceNotConnectedError(f"{self.name}: {method}: {error}; call connect()")  # noqa: E731
        refused = lambda error: DeviceError(f"{self.name}: {method}: {error}; look at its teach pendant, and at the cable")  # noqa: E731
        with ErrorsAs(ConnectionError, lost), ErrorsAs(RuntimeError, refused):
            return self._client.ask(method, *arguments, timeout_s=timeout_s)

    def _tell(self, request: str, timeout_s: float = STOP_S) -> str:
        """The dashboard's reply to a request. It has a connection of its own, so that it reaches an arm whose client hangs or has ended."""
        lost = lambda error: DeviceNotConnectedError(f"{self.name}: {request}: no reply ({error}); check the cable, then call connect()")  # noqa: E731
        at = self._host, DASHBOARD_PORT
        with ErrorsAs(OSError, lost), socket.create_connection(at, timeout_s) as link, link.makefile("rw") as lines:
            lines.readline()  # its greeting
            lines.write(f"{request}\n")
            lines.flush()
            reply = lines.readline().strip()
        if not reply or reply.lower().startswith(("failed", "could not")):
            raise DeviceError(f"{self.name}: {request}: {reply or 'no reply'}; look at its teach pendant")
        return reply

    def _newest(self, max_age_s: float = FEEDBACK_AGE_S) -> dict[str, Any]:
        asked_s = time.monotonic()
        while True:
            self._require_connected()
            packet, now_s = self._client.feedback, time.monotonic()
            if packet and (age_s := now_s - packet["time_s"]) <= max_age_s:
                return dict(packet)
            if now_s - asked_s > READ_S:
                heard = f"newest feedback is {age_s:.2f} s old (allowed {max_age_s:g} s)" if packet else "no feedback has come so far"
                raise StaleDataError(f"{self.name}: {heard}; connect() again")
            time.sleep(POLL_S)

    def _shows(self, obeyed: Callable[[dict[str, Any]], bool], within_s: float) -> bool:
        """Whether feedback newer than this call shows something in time."""
        asked_s = time.monotonic()
        while self.is_connected and time.monotonic() - asked_s < within_s:
            packet = self._client.feedback
            if packet.get("time_s", 0.0) > asked_s and obeyed(packet):
                return True
            time.sleep(POLL_S)
        return False

    def _require_shown(self, obeyed: Callable[[dict[str, Any]], bool], within_s: float, otherwise: str) -> None:
        if not self._shows(obeyed, within_s):
            self._newest()  # perhaps nothing was heard of it
            raise DeviceError(f"{self.name}: {otherwise}")

    def _require_in_use(self) -> None:
        """Raise ``DeviceNotConnectedError`` before ``connect`` and after ``disconnect``, but not while a connection is lost."""
        if self._client is None:
            self._require_connected()

    def _may_move(self) -> bool:
        return self._under_way

    def _close(self) -> None:
        if self._client is not None:
            self._client.end()
        if self._enabled:  # its program could not be ended, which its watchdog does, now that nothing is sent any more
            time.sleep(1 / WATCHDOG_HZ)
        self._client = None
        self._enabled = self._under_way = self._unstopped = False


def _moves(packet: dict[str, Any]) -> bool:
    target, actual = (np.abs(packet[name]).max() for name in ("TargetQd", "ActualQd"))
    return bool(target > TARGET_RAD_S or actual > ACTUAL_RAD_S)
