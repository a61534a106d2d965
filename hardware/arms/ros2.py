"""Any arm behind ROS 2: its pose and joints are topics, and its commands are twists (MoveIt Servo) or poses (a cartesian controller).

The driver makes the path. A thread sends a command every ``PERIOD_S``: the twist that keeps the arm on the path, or the next pose of the
path, which is never farther ahead than the arm goes in that time. So an arm whose program dies has nowhere far to go.

The network is best effort, and no topic is an emergency stop. Therefore the thread also watches: poses that don't come, come late or jump,
an arm that leaves the path, and a controller that no longer listens are faults that end the motion.
"""

import contextlib
import logging
import re
import time
from threading import Event, Lock, Thread

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.arm import FEEDBACK_AGE_S, POLL_S, ArmState, BaseArm, happens
from hardware.arms.motion import MotionTrack, Speeds, StageKinematics, finite_numbers
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError
from hardware.ros2.dds import Participant, Reader, Writer, domain_id
from scenes.files import quote
from twin.errors import ErrorsAs
from twin.records import ros2 as ros
from twin.rig.arm_pose import matrix_of, pose_of

LOG = logging.getLogger(__name__)
POSE, JOINTS = "geometry_msgs/PoseStamped", "sensor_msgs/JointState"
COMMANDS = {"twist": ("geometry_msgs/TwistStamped", "servo_node/delta_twist_cmds"), "pose": (POSE, "target_pose")}
"""Forms of commands: their messages, and the topics on which controllers usually expect them."""
ARM_FORM = f"ros2:{'|'.join(COMMANDS)}[,pose=TOPIC][,joints=TOPIC][,command=TOPIC][,namespace=NAME][,axes=N]"
PERIOD_S = 0.02
"""Interval, s, of the commands. MoveIt Servo stops an arm after 0.1 s without one."""
CONNECT_S = 4.0
"""Longest wait, s, for the first pose, the joints, and a node that takes commands."""
SILENCE_S = 0.3
"""Age, s, of the newest pose or joints at which an enabled arm is stopped."""
JUMP, FASTEST = 5.0, 2000.0
"""A pose farther (mm or deg) from the one before than ``JUMP``, and than anything goes in the time between (mm/s, deg/s), is a jump."""
STRAY, STRAY_S = 3.0, 0.5
"""An arm farther (mm or deg) from its path than ``STRAY``, and than it goes in this time, does not follow."""
GAIN_PER_S, MOST = 5.0, 1.25
"""Share of the distance from the path that a twist removes in a second, and the largest twist in units of the speed that is set."""
NEAR, SETTLE_S = 0.01, 1.0
"""Distance, mm or deg, from the end of the path at which a move has ended, and the longest time, s, until then."""
REST, REST_S = 0.05, 0.06
"""An arm that changed its place by less than this, mm or deg, in this time stands."""
DRIFT = 1e-3
"""Largest share by which the clock of the stamps may be slower than this machine's."""
STOPS_S = 1.0
"""Longest time, s, that an arm may take to stand after a stop."""
ACCELERATION = 500.0
"""Acceleration of the path, mm/s2 and deg/s2."""
STAGE = StageKinematics()


class Ros2Arm(BaseArm):
    """An arm whose controller is a node of ROS 2.

    Parameters
    ----------
    form : {"twist", "pose"}
        Message of the commands.
    axes : int
        Number of joints that are reported: the first ones of the messages.
    namespace : str
        That of the topics. A topic that begins with a slash is in none.
    pose, joints, command : str
        Topics; an empty one is the usual one of the form.
    """

    _speeds = Speeds(50.0, 30.0, ACCELERATION, ACCELERATION)

    def __init__(
        self, form: str, *, axes: int = 6, namespace: str = "", pose: str = "current_pose", joints: str = "joint_states", command: str = ""
    ) -> None:
        self._kind, usual = COMMANDS[form]
        self._topics = [topic_in(namespace, topic) for topic in (pose, joints, command or usual)]
        self.name, self.axes = f"ROS 2 arm at {self._topics[2]}", axes
        self._end, self._lock, self._thread = Event(), Lock(), Thread()
        self._writer: Writer | None = None
        self._enabled = self._going = False
        self._fault, self._frame = "", ""
        self._forget()

    def _forget(self) -> None:
        """Drop what was heard."""
        self._pose, self._joints, self._rest = (np.zeros(size) for size in (6, self.axes, 6))
        self._pose_s, self._joints_s = -np.inf, -np.inf  # when they were measured
        self._rest_s, self._stamp_s, self._behind_s = 0.0, 0.0, np.inf
        self._track = MotionTrack(STAGE, self._pose)

    @property
    def is_connected(self) -> bool:
        return self._writer is not None

    def connect(self) -> None:
        self._require_disconnected()
        self._forget()
        participant, self._end = Participant(), Event()
        pose, joints, command = self._topics
        writer = participant.writer(command, self._kind)
        given = (participant.reader(pose, POSE), participant.reader(joints, JOINTS), writer, self._end)
        self._thread = Thread(target=self._run, args=given, daemon=True, name="ROS 2 arm")
        self._thread.start()
        if not happens(lambda: self._pose_s > 0 < self._joints_s and writer.heard, CONNECT_S):
            self._close()
            needs = f"poses on {pose}, {self.axes} joints on {joints}, and a node that takes {self._kind} on {command}"
            remedy = f"start them, or name other topics ({ARM_FORM}); without an arm: 'twin emulate ros2'"
            there = ", ".join(participant.topics()) or "no topics"
            raise DeviceNotConnectedError(f"{self.name}: not found in domain {domain_id()}: it needs {needs}; {remedy}. There are: {there}")
        self._writer = writer
        LOG.warning("%s: the network guarantees nothing and no emergency stop is behind it; keep a hand at the arm's own", self.name)

    def disconnect(self) -> None:
        if self.is_connected:
            self._disconnect(self.disable, close=self._close)

    def _close(self) -> None:
        self._end.set()
        self._thread.join()
        self._writer, self._fault = None, ""

    def enable(self) -> None:
        """Begin to send commands: that the arm shall stand. Its motors are switched on at its own controller."""
        if error := self.state().error:
            raise DeviceError(f"{self.name}: {error}; call clear_error() first")
        with self._lock:
            self._hold()
            self._enabled = True

    def disable(self) -> None:
        """Stop, and send no more commands."""
        try:
            self.stop()
        finally:
            self._enabled = False

    def emergency_stop(self) -> None:
        """As ``disable``, because no topic cuts the motors' power."""
        self.disable()

    def clear_error(self) -> None:
        self._require_connected()
        self._fault = ""

    def stop(self) -> None:
        """Command the arm to stand, and wait until its poses show that. ``DeviceError``: they don't, so it may move."""
        self._require_connected()
        if not self._enabled:  # nothing was sent
            return
        self._unstopped = True
        with self._lock:
            if not self._fault:  # which held it
                self._hold()
        asked_s = time.monotonic()
        why = "can't be stopped and may move. Press its emergency stop"
        with ErrorsAs(DeviceError, lambda error: type(error)(f"{self.name}: {why}. {error}")):
            if not happens(lambda: self.state(max_age_s=SILENCE_S).time_s - max(self._rest_s, asked_s) >= REST_S, STOPS_S):
                raise DeviceError(f"It moves {STOPS_S:g} s after a stop")
        self._unstopped = False

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        """See ``Arm``. It moves if its poses show that, or until it has reached the end of the path."""
        self._require_connected()
        # after a stall of this process it waits for what arrived meanwhile
        if not happens(lambda: time.monotonic() - self._pose_s <= max_age_s, 5 * PERIOD_S):
            old = f"newest pose is {time.monotonic() - self._pose_s:.1f} s old (allowed {max_age_s:g} s)"
            remedy = "stop the arm, check its node and the network, then disconnect() and connect() again"
            raise StaleDataError(f"{self.name}: {old}. Don't trust it: {remedy}")
        with self._lock:
            self._require_possible(self._pose)
            moving = self._going or self._pose_s - self._rest_s < REST_S
            return ArmState(self._pose, self._joints, self._pose_s, self._enabled, moving, self._fault)

    @property
    def _speed(self) -> np.ndarray:
        return np.array([self._speeds.linear_mm_s, self._speeds.angular_deg_s])

    def move_linear(self, pose: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        with self._watch_move():
            self.state()  # which is new enough
            sent = finite_numbers(f"{self.name}: the pose", pose, 6)
            with self._lock:
                if self._fault or not self._enabled:
                    raise DeviceError(f"{self.name}: {self._fault or 'not enabled'}; call clear_error() and enable()")
                if not self._going:
                    self._hold()
                self._track.move(sent, self._speeds, linear=True, now_s=time.monotonic())
                self._going = True
            if wait:
                self._wait_until_settled(sent, timeout_s=timeout_s)
        return sent

    def move_joints(self, joints_deg: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        """Always an error: the topics command the tool, and not the joints."""
        self._require_connected()
        finite_numbers(f"{self.name}: the joint angles", joints_deg, self.axes)
        raise DeviceError(f"{self.name}: its joints can't be moved by these topics; use move_linear")

    def _hold(self, why: str = "", *, known: bool = True) -> None:
        """End the path, because of a fault if ``why``: where the arm is if that is known, else where it should be."""
        if known:
            self._track = MotionTrack(STAGE, self._pose)
        self._track.stop(time.monotonic())
        self._going, self._fault = False, self._fault or why

    def _run(self, poses: Reader, joints: Reader, writer: Writer, end: Event) -> None:
        due_s = 0.0
        while not end.wait(POLL_S):
            heard = (poses.take(PERIOD_S), POSE, self._take_pose), (joints.take(0.0), JOINTS, self._take_joints)
            with self._lock:
                for messages, kind, take in heard:
                    with contextlib.suppress(ValueError):  # a damaged message is one that did not come
                        for data in messages[-1:]:
                            take(ros.decode(kind, data))
                if self._enabled and time.monotonic() > due_s:
                    due_s = time.monotonic() + PERIOD_S - POLL_S
                    self._watch(writer)
                    with contextlib.suppress(DeviceError):  # what can't be sent is lost
                        self._command(writer)

    def _watch(self, writer: Writer) -> None:
        """Hold the arm if anything is wrong."""
        quiet_s = time.monotonic() - min(self._pose_s, self._joints_s)
        off = measure_way(self._track.pose(self._pose_s), self._pose)
        if self._fault:
            return
        if quiet_s > SILENCE_S:
            self._hold(f"no pose or no joints for {quiet_s:.1f} s; check its node and the network", known=False)
        elif not writer.heard:
            self._hold(f"nobody takes commands on {writer.name} any more; start its controller")
        elif self._going and not (off <= STRAY + STRAY_S * self._speed).all():
            self._hold(f"is {off[0]:.0f} mm and {off[1]:.0f} deg off its path; check for a stop, an obstacle, or another sender")

    def _command(self, writer: Writer) -> None:
        now_s, at_ns, ends_s = time.monotonic(), time.time_ns(), self._track.end_s
        if self._pose_s > ends_s and (now_s > ends_s + SETTLE_S or (measure_way(self._track.pose(now_s), self._pose) < NEAR).all()):
            self._going = False
        message = {"header": ros.header_of(at_ns, self._frame)}
        there = matrix_of(self._track.pose(now_s))
        if self._kind == POSE:
            message["pose"] = ros.place(there)
        else:
            along = _way(there, matrix_of(self._track.pose(now_s + PERIOD_S))) / PERIOD_S
            back = _way(matrix_of(self._pose), matrix_of(self._track.pose(self._pose_s)))
            velocity = (along + GAIN_PER_S * back) * self._going
            most = MOST * self._speed / np.maximum(np.linalg.norm(velocity, axis=1), 1e-9)
            velocity *= np.minimum(1.0, most)[:, None]
            message["twist"] = ros.twist(np.r_[velocity[0] / ros.MM_PER_M, np.radians(velocity[1])])
        writer.write(ros.encode(self._kind, message), at_ns)

    def _take_joints(self, message: dict) -> None:
        if len(message["position"]) >= self.axes:
            self._joints, self._joints_s = np.degrees(message["position"][: self.axes]), time.monotonic()

    def _take_pose(self, message: dict) -> None:
        stamp, now_s = message["header"]["stamp"], time.monotonic()
        stamp_s = stamp["sec"] + stamp["nanosec"] / ros.NS_PER_S
        if 0.0 < stamp_s <= self._stamp_s:  # repeated, or overtaken
            return
        risen_s = self._behind_s + DRIFT * (stamp_s - self._stamp_s)
        self._stamp_s, self._behind_s = stamp_s, min(risen_s, now_s - stamp_s)  # clocks may differ, but no message gains time
        time_s, pose = stamp_s + self._behind_s if stamp_s else now_s, pose_of(ros.matrix_in(message["pose"]), self._pose)
        way = measure_way(pose, self._pose)
        if self._enabled and not self._fault and not (way <= JUMP + FASTEST * (time_s - self._pose_s)).all():
            self._hold(f"its pose jumped by {way[0]:.0f} mm and {way[1]:.0f} deg; check what publishes {self._topics[0]}", known=False)
        if not (measure_way(pose, self._rest) < REST).all():
            self._rest, self._rest_s = pose, time_s
        self._pose, self._pose_s, self._frame = pose, time_s, message["header"]["frame_id"]


def measure_way(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance, mm, and turn, deg, between two poses (6,)."""
    return np.linalg.norm(_way(matrix_of(a), matrix_of(b)), axis=1)


def _way(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The way (2, 3) between two poses (4, 4) in the base frame: mm, and the rotation vector in deg."""
    return np.array([end[:3, 3] - start[:3, 3], Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec(degrees=True)])


def topic_in(namespace: str, topic: str) -> str:
    """The whole name of a topic; one with a slash at its beginning is whole. ``DeviceError``: ROS 2 does not allow it."""
    name = topic if topic.startswith("/") else f"/{namespace.strip('/')}/{topic}".replace("//", "/")
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", name, re.ASCII):
        raise DeviceError(f"no topic can be called {quote(name)}; expected letters, digits and _ between slashes")
    return name


def ros2_arm(text: str) -> Ros2Arm:
    """The arm from what follows ``ros2:``; ``DeviceError`` names the right form."""
    form, *options = text.split(",")
    given = dict(option.partition("=")[::2] for option in options)
    axes, known = given.pop("axes", "6"), {"pose", "joints", "command", "namespace"}
    if form not in COMMANDS or not given.keys() <= known or not all(given.values()) or axes not in "123456789":
        raise DeviceError(f"no arm 'ros2:{quote(text)}'; expected {ARM_FORM}")
    return Ros2Arm(form, axes=int(axes), **given)
