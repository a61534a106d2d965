"""An arm behind ROS 2 emulated on this machine: a node that publishes pose and joints, and executes twists or poses, over real DDS."""

import time
from collections import deque
from collections.abc import Sequence
from threading import Event, Thread

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.motion import between
from hardware.arms.ros2 import COMMANDS, JOINTS, POSE, STAGE, measure_way, topic_in
from hardware.emulators.faults import EVERY_NTH, SECONDS, SHARE, Emulator, Fault, Faults, Range
from hardware.errors import DeviceError
from hardware.ros2.dds import Participant, Reader, Writer, domain_id
from twin.records import ros2 as ros
from twin.rig.arm_pose import matrix_of, pose_of

PERIOD_S = 0.01
STALE_S = 0.1
"""Age, s, of a twist at which MoveIt Servo stops the arm (its ``incoming_command_timeout``)."""
FASTEST = 500.0
"""Speed, mm/s and deg/s, at which the emulated cartesian controller goes to a target, however far it is."""
START = (300.0, 0.0, 0.0, 0.0, 0.0, 0.0)
KEPT = 30_000
"""Number of poses that are kept: those of five minutes."""
FAULTS = {
    "silent-feedback": Fault("no pose and no joints come any more"),
    "late-feedback": Fault("poses and joints come this many seconds late", 2.0, SECONDS),
    "lost-messages": Fault("every n-th pose never comes", 3.0, EVERY_NTH),
    "frozen": Fault("the same pose with the same stamp comes again and again"),
    "jump": Fault("the pose is wrong by this many mm", 50.0, Range(0.1, 5000)),
    "ignore-commands": Fault("commands are not executed"),
    "slow": Fault("motions at this share of the speed", 0.1, SHARE),
    "die": Fault("the node ends, this many seconds after the start", 5.0, SECONDS),
}


class Ros2Emulator(Emulator):
    """A node that moves an ideal stage. A context manager, which works between ``start`` and ``stop``.

    Parameters
    ----------
    form : {"twist", "pose"}
        Twists are executed as by MoveIt Servo (``speed_units``), where an old one stops the arm. A pose is a target to which the arm goes
        at once, as fast as it can.
    namespace : str
        That of the topics.
    faults : iterable of str
        ``NAME`` or ``NAME=VALUE`` of ``FAULTS``; ``faults`` can be changed while it runs.
    pose : (6,) float
        Pose at the start, mm and deg.

    Attributes
    ----------
    topics : list of str
        Pose, joints and commands.
    commands : int
        Number of commands that came.
    """

    def __init__(self, form: str = "twist", *, namespace: str = "", faults: tuple[str, ...] = (), pose: Sequence[float] = START) -> None:
        if form not in COMMANDS:
            raise DeviceError(f"`form` {form}: expected {' or '.join(COMMANDS)}")
        self.faults = Faults(FAULTS, faults)
        self._kind, usual = COMMANDS[form]
        self.topics = [topic_in(namespace, topic) for topic in ("current_pose", "joint_states", usual)]
        self._past = deque([(-np.inf, np.array(pose, float))], maxlen=KEPT)
        self._twist, self._target, self._until_s = np.zeros((2, 3)), self._past[0][1], 0.0
        self._late: deque[tuple[float, Writer, bytes]] = deque()
        self.commands = self._stamp_ns = 0
        self._ended, self._thread = Event(), Thread()

    def pose(self, time_s: float | None = None) -> np.ndarray:
        """Pose (6,) of the tool at a ``time.monotonic()`` (now if not given)."""
        until_s = time.monotonic() if time_s is None else time_s
        return next(pose for at_s, pose in reversed(self._past.copy()) if at_s <= until_s)

    def start(self) -> None:
        participant, (pose, joints, command) = Participant(), self.topics
        given = participant.reader(command, self._kind), participant.writer(pose, POSE), participant.writer(joints, JOINTS)
        self._thread = Thread(target=self._run, args=given, daemon=True, name="ros2-emulator")
        self._thread.start()
        self.place = f"ros2 {' '.join(self.topics)} in domain {domain_id()}"
        self.faults.after("die", self._ended.set)

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self, commands: Reader, poses: Writer, joints: Writer) -> None:
        while not self._ended.is_set():
            for data in commands.take(PERIOD_S):
                self._obey(ros.decode(self._kind, data))
            now_s, (before_s, here) = time.monotonic(), self._past[-1]
            if "ignore-commands" not in self.faults and np.isfinite(before_s):
                here = self._move(here, (now_s - before_s) * self.faults.factor("slow"))
            self._past.append((now_s, here))
            self._publish(here, now_s, poses, joints)

    def _obey(self, message: dict) -> None:
        self.commands += 1
        stamp = message["header"]["stamp"]
        self._until_s = stamp["sec"] + stamp["nanosec"] / ros.NS_PER_S + STALE_S
        if self._kind == POSE:
            self._target = pose_of(ros.matrix_in(message["pose"]), self._target)
        else:
            self._twist = np.array([list(message["twist"][part].values()) for part in ("linear", "angular")])

    def _move(self, here: np.ndarray, dt_s: float) -> np.ndarray:
        if self._kind == POSE:
            if np.array_equal(here, self._target):
                return here
            return between(STAGE, here, self._target, FASTEST * dt_s / max(*measure_way(here, self._target), 1e-9), True)
        if not self._twist.any() or time.time() > self._until_s:
            return here
        T = matrix_of(here)
        T[:3, 3] += dt_s * ros.MM_PER_M * self._twist[0]
        T[:3, :3] = Rotation.from_rotvec(dt_s * self._twist[1]).as_matrix() @ T[:3, :3]
        return pose_of(T, here)

    def _publish(self, here: np.ndarray, now_s: float, poses: Writer, joints: Writer) -> None:
        self._stamp_ns = self._stamp_ns if "frozen" in self.faults else time.time_ns()
        header, due_s = ros.header_of(self._stamp_ns, "base_link"), now_s + (self.faults.value("late-feedback") or 0.0)
        place = ros.place(matrix_of(here + [self.faults.value("jump") or 0.0, 0, 0, 0, 0, 0]))
        self._late.append((due_s, joints, ros.encode(JOINTS, {"header": header, "position": np.radians(here)})))  # a stage's are its pose
        if not self.faults.every("lost-messages", len(self._past)):
            self._late.append((due_s, poses, ros.encode(POSE, {"header": header, "pose": place})))
        while self._late and self._late[0][0] <= now_s:
            _, writer, message = self._late.popleft()
            if "silent-feedback" not in self.faults:
                writer.write(message, time.time_ns())
