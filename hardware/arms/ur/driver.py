"""Driver of a Universal Robots arm (CB3 and e-Series) through ``ur_rtde``.

Its poses are in m and rotation vectors there, in mm and static xyz angles in deg here. The joints have the Denavit-Hartenberg parameters
``d1, a2, a3, d4, d5, d6`` of the maker's table, and twists of 90, 0, 0, 90, -90, 0 deg. The closed inverse is that of K. P. Hawkins,
"Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms", 2013.
"""

import contextlib
import importlib.util
import logging
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.arm import FEEDBACK_AGE_S, POLL_S, ArmState, KinematicArm, happens
from hardware.arms.motion import LIMIT_TOLERANCE_DEG, TARGET_LIMIT, OutOfReachError, StageKinematics, Violation, way_between
from hardware.arms.ur.client import CONNECT_S, WATCHDOG_HZ, ClientProcess
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError, on_error
from twin.errors import ErrorsAs, ExtraError
from twin.rig.arm_pose import matrix_of

# d1, a2, a3, d4, d5, d6 in mm, by the model and the major version of its software (from 5 on: e-Series).
MODELS = {
    ("UR3", 3): (151.9, -243.65, -213.25, 112.35, 85.35, 81.9),
    ("UR5", 3): (89.159, -425.0, -392.25, 109.15, 94.65, 82.3),
    ("UR10", 3): (127.3, -612.0, -572.3, 163.941, 115.7, 92.2),
    ("UR3", 5): (151.85, -243.55, -213.2, 131.05, 85.35, 92.1),
    ("UR5", 5): (162.5, -425.0, -392.2, 133.3, 99.7, 99.6),
    ("UR10", 5): (180.7, -612.7, -571.55, 174.15, 119.85, 116.55),
    ("UR16", 5): (180.7, -478.4, -360.0, 174.15, 119.85, 116.55),
}
TWISTS = np.radians([90.0, 0.0, 0.0, 90.0, -90.0, 0.0])
FULL_TURN_DEG = 360.0  # range of each joint, to both sides
# Sine of the angle of joint 5 below which joints 4 and 6 have the same axis.
STRAIGHT = 1e-6


def pose_from_ur(pose: np.ndarray) -> np.ndarray:
    """The pose (6,) of one of a UR: its rx is between -90 and 270 deg, so that it does not jump where the tool points down."""
    angles = Rotation.from_rotvec(pose[3:]).as_euler("xyz", degrees=True)
    return np.r_[1000.0 * np.asarray(pose[:3]), (angles[0] + 90.0) % 360.0 - 90.0, angles[1:]]


def pose_to_ur(pose: np.ndarray) -> list[float]:
    """The reverse of ``pose_from_ur``."""
    return [*(np.asarray(pose[:3]) / 1000.0).tolist(), *Rotation.from_euler("xyz", pose[3:], degrees=True).as_rotvec().tolist()]


@dataclass(frozen=True, eq=False)
class UrKinematics(StageKinematics):
    """A UR with a tool. The driver writes into all arrays at ``connect``, because only then the model and the tool are known.

    Attributes
    ----------
    lengths_mm : (6,) float
        A row of ``MODELS``.
    T_flange_tool : (4, 4) float
    near_deg : (6,) float
        Joints whose side of shoulder, elbow and wrist ``inverse`` keeps. It gives the nearest turns within the joints' range.
    """

    lengths_mm: np.ndarray = field(default_factory=lambda: np.array(MODELS["UR5", 3]))
    T_flange_tool: np.ndarray = field(default_factory=lambda: np.eye(4))
    near_deg: np.ndarray = field(default_factory=lambda: np.array([0.0, -90.0, 90.0, -90.0, -90.0, 0.0]))

    def flange(self, joints_deg: np.ndarray) -> np.ndarray:
        """``T_base_flange`` (4, 4) at the joints (6,)."""
        d1, a2, a3, d4, d5, d6 = self.lengths_mm
        T = np.eye(4)
        for q, d, a, twist in zip(np.radians(joints_deg), (d1, 0, 0, d4, d5, d6), (0, a2, a3, 0, 0, 0), TWISTS, strict=True):
            T = T @ _link(q, d, a, twist)
        return T

    def forward(self, joints_deg: np.ndarray) -> np.ndarray:
        T = self.flange(joints_deg) @ self.T_flange_tool
        return pose_from_ur(np.r_[T[:3, 3] / 1000.0, Rotation.from_matrix(T[:3, :3]).as_rotvec()])

    def inverse(self, pose: np.ndarray) -> np.ndarray:
        """Joints (6,) at the pose (6,); ``OutOfReachError`` where there are none."""
        d1, a2, a3, d4, d5, d6 = self.lengths_mm
        near = np.radians(self.near_deg)
        T = matrix_of(pose) @ np.linalg.inv(self.T_flange_tool)
        wrist = T[:3, 3] - d6 * T[:3, 2]  # of joint 5
        reach = np.hypot(*wrist[:2])
        beside = self._arccos(d4 / reach if reach else np.inf, pose)
        q1 = min((np.arctan2(wrist[1], wrist[0]) + sign * beside + np.pi / 2 for sign in (1, -1)), key=lambda q: abs(_turn(q - near[0])))
        side = np.array([np.sin(q1), -np.cos(q1), 0.0])
        q5 = np.copysign(self._arccos((side @ T[:3, 3] - d4) / d6, pose), np.sin(near[4]))
        q6 = near[5]
        if abs(np.sin(q5)) > STRAIGHT:
            q6 = np.arctan2(-side @ T[:3, 1] / np.sin(q5), side @ T[:3, 0] / np.sin(q5))
        T_14 = np.linalg.inv(_link(q1, d1, 0, TWISTS[0])) @ T @ np.linalg.inv(_link(q5, d5, 0, TWISTS[4]) @ _link(q6, d6, 0, 0.0))
        x, y = (T_14 @ [0.0, -d4, 0.0, 1.0])[:2]
        q3 = np.copysign(self._arccos((x**2 + y**2 - a2**2 - a3**2) / (2 * a2 * a3), pose), np.sin(near[2]))
        q2 = np.arctan2(y, x) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
        q4 = np.arctan2(T_14[1, 0], T_14[0, 0]) - q2 - q3
        joints = np.degrees(near + _turn(np.array([q1, q2, q3, q4, q5, q6]) - near))
        return joints - FULL_TURN_DEG * np.trunc(joints / (FULL_TURN_DEG + LIMIT_TOLERANCE_DEG))

    def violation(self, joints_deg: np.ndarray) -> Violation | None:
        for n, angle in enumerate(joints_deg, start=1):
            if abs(angle) > FULL_TURN_DEG + LIMIT_TOLERANCE_DEG:
                return Violation(TARGET_LIMIT, f"J{n} at {angle:.2f} deg is beyond a full turn")
        return None

    def _arccos(self, cosine: float, pose: np.ndarray) -> float:
        if not abs(cosine) <= 1.0 + STRAIGHT:
            raise OutOfReachError(f"x {pose[0]:.1f}, y {pose[1]:.1f}, z {pose[2]:.1f} mm is out of reach in this orientation")
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _link(q: float, d: float, a: float, twist: float) -> np.ndarray:
    c, s, ct, st = np.cos(q), np.sin(q), np.cos(twist), np.sin(twist)
    return np.array([[c, -s * ct, s * st, a * c], [s, c * ct, -c * st, a * s], [0, st, ct, d], [0, 0, 0, 1]])


def _turn(angle: np.ndarray) -> np.ndarray:
    """Angles in rad, changed by full turns to the shortest."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


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
# The largest speed, m/s or rad/s; accelerations of lines, m/s^2, and of joints, rad/s^2.
MOST_SPEED, LINEAR_M_S2, JOINT_RAD_S2 = 3.0, 1.2, 1.4


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
        self._slider = 1.0
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
        with on_error(self._close):
            self._require_shown(lambda packet: True, REPLY_S, "sends no feedback")
            version = re.search(r"\d+", self._tell("PolyscopeVersion", REPLY_S))
            model = self._tell("get robot model", REPLY_S).rstrip("e"), int(version[0] if version else 0)
            if model not in MODELS:
                raise DeviceError(f"{self.name}: {model} is no known model and version of PolyScope: {sorted(MODELS)}")
            state, kinematics = self.state(), self.kinematics
            kinematics.lengths_mm[:] = MODELS[model]
            kinematics.T_flange_tool[:] = np.linalg.inv(kinematics.flange(state.joints_deg)) @ matrix_of(state.pose)

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
            with on_error(self.disable):  # it may have obeyed
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

    def _joints_at(self, pose: np.ndarray) -> np.ndarray:
        self.state()  # which tells the kinematics the present joints
        return super()._joints_at(pose)

    def _move(self, joints: np.ndarray, pose: np.ndarray | None, *, wait: bool, timeout_s: float) -> None:
        state = self.state()
        if state.error or not state.enabled:
            raise DeviceError(f"{self.name}: {state.error or 'not enabled; call enable() first'}")
        self._require_within(joints)
        if pose is None:
            method, target, speed, acceleration = "moveJ", np.radians(joints).tolist(), np.radians(self._speeds.angular_deg_s), JOINT_RAD_S2
        else:
            if np.abs(joints - state.joints_deg).max() > HALF_TURN_DEG:  # ``inverse`` has turned it back by a full turn
                raise DeviceError(f"{self.name}: a joint would pass its end, so nothing was sent; turn it back with move_joints")
            # the arm takes the speed as m/s or as rad/s: whichever takes longer, line or turn
            way_mm, turn_deg = way_between(state.pose, pose, self.axes)
            lasts_s = max(way_mm / self._speeds.linear_mm_s, turn_deg / self._speeds.angular_deg_s, POLL_S)
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
        with contextlib.suppress(DeviceError):
            self._tell("stop")
            return happens(lambda: self._tell("running").lower() == "program running: false", STOP_S)
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
