"""The emulated Magician's controller: commands, queue and alarms. It does not use a serial port."""

import logging
import math
import struct
import time
from dataclasses import replace
from threading import RLock
from typing import Any

import numpy as np

from hardware.arms.magician import Id, Message, Ptp
from hardware.arms.motion import MAGICIAN, NO_INVERSE, MotionTrack, OutOfReachError, Speeds, Violation, check_line, circle
from hardware.emulators.faults import Faults

LOG = logging.getLogger(__name__)
# Largest number of commands in the queue.
QUEUE_N = 32
# Numbers of alarms (see ``hardware.arms.motion``).
NOT_UNDERSTOOD, ARC_PLACES, LOST_STEPS = 1, 20, 80
START_JOINTS_DEG = (0.0, 45.0, 45.0, 0.0)
# Speed of the joints while homing, in deg/s. Chosen for the emulator.
HOME_SPEED_DEG_S = 30.0
# Length of a jog, mm and deg. It is longer than every range of motion.
JOG_MM, JOG_DEG = 400.0, 300.0
# Parameters that are stored as received: their form, and their initial values.
STORED: dict[int, tuple[str, tuple[float, ...]]] = {
    Id.HOME_PARAMS: ("<4f", (200.0, 0.0, 0.0, 0.0)),
    Id.END_EFFECTOR: ("<3f", (0.0,) * 3),
    **dict.fromkeys((Id.LASER, Id.SUCTION, Id.GRIPPER, Id.IO), ("<2B", (0, 0))),
    **dict.fromkeys((Id.JOG_JOINT_PARAMS, Id.JOG_COORDINATE_PARAMS), ("<8f", (20.0,) * 4 + (50.0,) * 4)),
    Id.JOG_COMMON_PARAMS: ("<2f", (50.0, 50.0)),
    Id.PTP_JOINT_PARAMS: ("<8f", (200.0,) * 8),
    Id.PTP_COORDINATE_PARAMS: ("<4f", (200.0,) * 4),
    Id.PTP_JUMP_PARAMS: ("<2f", (20.0, 100.0)),
    Id.PTP_COMMON_PARAMS: ("<2f", (50.0, 50.0)),
    Id.CP_PARAMS: ("<3fB", (100.0, 50.0, 10.0, 0)),
    Id.ARC_PARAMS: ("<4f", (100.0,) * 4),
    Id.HANDHELD_OUTPUT: ("<B", (0,)),
}
# Forms of the parameters of commands that can't be read. pydobot sends CP without its last number.
ACTS: dict[int, tuple[str, ...]] = {
    Id.RESET_POSE: ("<x2f",),
    Id.HOME: ("<4x", ""),
    Id.JOG: ("<2B",),
    Id.PTP: ("<B4f",),
    Id.CP: ("<B3f4x", "<B3fx"),
    Id.CP_LASER: ("<B4f",),
    Id.ARC: ("<8f",),
    Id.WAIT: ("<I",),
}
# Forms of the parameters of all commands whose number of bytes is known, also of those for parts that are not attached to the arm.
NOT_ATTACHED: dict[int, tuple[str, ...]] = {Id.MOTOR: ("<6x",), Id.MOTOR_STEPS: ("<10x",), Id.COLOR: ("<3x",), Id.INFRARED: ("<2x",)}
FORMS: dict[int, tuple[str, ...]] = {**ACTS, **NOT_ATTACHED, **{id: (form,) for id, (form, _) in STORED.items()}}
# Commands that report what the device is. Their replies are chosen for the emulator.
DEVICE_SERIAL, DEVICE_NAME, DEVICE_VERSION, POSE_L = 0, 1, 2, 13
# Replies to a read. Parts that are not attached show no signal.
REPLIES: dict[int, bytes] = {
    DEVICE_SERIAL: b"EMULATED",
    DEVICE_NAME: b"Dobot Magician",
    DEVICE_VERSION: bytes([3, 7, 0]),  # major, minor, revision
    POSE_L: struct.pack("<f", 0.0),  # place of the arm on a slide, mm; there is none
    Id.COLOR: bytes(3),
    Id.INFRARED: bytes(1),
    **{id: struct.pack(form, *values) for id, (form, values) in STORED.items()},
}
# Parameters that are speeds and accelerations, which must be above 0, because a move at 0 or less has no time.
SPEEDS = {Id.PTP_JOINT_PARAMS, Id.PTP_COORDINATE_PARAMS, Id.PTP_COMMON_PARAMS, Id.CP_PARAMS, Id.ARC_PARAMS}
# Speeds and accelerations of jogs may be 0. Clients send 0 for the axes that stand still.
JOG_SPEEDS = {Id.JOG_JOINT_PARAMS, Id.JOG_COORDINATE_PARAMS, Id.JOG_COMMON_PARAMS}


def numbers_in(message: Message) -> tuple[Any, ...] | None:
    """The numbers in a command's parameters. None: there is no such command, or it has other parameters, or they are not allowed.

    Floating-point numbers must be finite, and speeds and accelerations above 0.
    """
    if message.id not in FORMS:
        return () if message.id in set(Id) else None
    form = next((form for form in FORMS[message.id] if struct.calcsize(form) == len(message.params)), None)
    if form is None:
        return None
    numbers = struct.unpack(form, message.params)
    floats = [number for number in numbers if isinstance(number, float)]
    slow = (message.id in SPEEDS and min(floats) <= 0) or (message.id in JOG_SPEEDS and min(floats) < 0)
    return None if slow or not all(map(math.isfinite, floats)) else numbers


class EmulatedController:
    """Executes the commands of the arm. Every method may be called from any thread."""

    def __init__(self, faults: Faults, *, time_scale: float = 1.0) -> None:
        self.faults, self._time_scale = faults, time_scale
        self.kinematics = MAGICIAN
        self.track = MotionTrack(MAGICIAN, np.array(START_JOINTS_DEG))
        self.lock = RLock()
        self.alarms: set[int] = set()
        self._replies = dict(REPLIES)
        self._queue: list[tuple[int, Message, float]] = []  # numbers of the commands, and the times of their arrival
        self._running = False
        self._since_s = self._ends_s = -np.inf  # when the first command may begin, and when it ends (inf: not begun)
        self._begun, self._lost_at_s = False, np.inf
        self._issued = self._current = 0

    def answer(self, message: Message) -> Message:
        """Execute a command or queue it. The reply has the same id and ctrl."""
        with self.lock:
            now_s, reply = self.update(), b""
            writes = message.is_write or message.is_queued  # with the write bit or, from some clients, without
            if numbers_in(message) is None if writes else message.id in ACTS:  # clients read anything, to find out what there is
                return self.refuse(message)
            if not writes:
                reply = self._answer_read(message, now_s)
            elif not message.is_queued:
                self._write(message, now_s)
            elif len(self._queue) < QUEUE_N:  # otherwise the reply has no index, because the command was not accepted
                self._issued += 1
                self._queue.append((self._issued, message, now_s))
                self.update()
                reply = struct.pack("<Q", self._issued)
            return replace(message, params=reply)

    def refuse(self, message: Message) -> Message:
        """Raise the alarm of a command that is not understood. The reply is empty."""
        with self.lock:
            self.alarms.add(NOT_UNDERSTOOD)
        return Message(message.id, message.ctrl)

    def busy(self) -> bool:
        """Whether commands are in progress or queued."""
        with self.lock:
            return bool(self._queue) or self.track.moving(self.update())

    def update(self) -> float:
        """Execute the queue up to the present time, which is returned. A command that fails ends with an alarm and is not tried again."""
        now_s = time.monotonic()
        with self.lock:
            if self._lost_at_s <= now_s:
                self.alarms.add(LOST_STEPS)
                self._lost_at_s = np.inf
            while self._running and self._queue and not self.alarms:
                index, message, came_s = self._queue[0]
                if not self._begun:
                    begins_s = max(self._since_s, came_s)
                    try:
                        self._ends_s = self._do(message, begins_s)
                    except Exception:
                        LOG.exception("emulated Magician: queued command %d failed and was dropped", message.id)
                        self._ends_s = self._alarm(NOT_UNDERSTOOD, begins_s)
                    self._begun = True
                if self._ends_s > now_s:
                    break
                self._since_s, self._current, self._begun = self._ends_s, index, False
                self._queue.pop(0)
            return now_s

    def _answer_read(self, message: Message, now_s: float) -> bytes:
        if message.id == Id.GET_POSE:
            pose = self.track.pose(now_s)
            return struct.pack("<8f", *pose[[0, 1, 2, 5]], *self.track.joints_deg(now_s))
        if message.id == Id.ALARMS:
            return sum(1 << alarm for alarm in self.alarms).to_bytes(16, "little")
        if message.id == Id.QUEUE_INDEX:
            return struct.pack("<Q", self._current)
        if message.id == Id.QUEUE_SPACE:
            return struct.pack("<Q" if "wide-queue-space" in self.faults else "<I", max(0, QUEUE_N - len(self._queue)))
        return self._replies.get(message.id, b"")

    def _write(self, message: Message, now_s: float) -> None:
        if message.id == Id.ALARMS:
            self.alarms.clear()
        elif message.id == Id.QUEUE_START:
            self._since_s, self._running = now_s, True
        elif message.id == Id.QUEUE_STOP:  # the command in execution is finished
            self._running = False
        elif message.id == Id.QUEUE_FORCE_STOP:
            self.track.stop(now_s)
            self._running, self._begun = False, False
        elif message.id == Id.QUEUE_CLEAR:
            self._queue.clear()
            self._begun = False
        else:
            self._do(message, now_s)

    def _do(self, message: Message, begins_s: float) -> float:
        """Begin a command; returns the time at which it ends."""
        numbers = numbers_in(message) or ()
        if message.id in STORED:
            self._replies[message.id] = message.params
            if message.id == Id.END_EFFECTOR:
                self._set_tool(numbers[0], begins_s)
        elif message.id == Id.PTP:
            return self._ptp(numbers[0], np.array(numbers[1:]), begins_s)
        elif message.id == Id.ARC:
            return self._arc(np.array(numbers), begins_s)
        elif message.id in (Id.CP, Id.CP_LASER):
            here = self.track.pose(np.inf)
            end = np.array([*numbers[1:4], 0, 0, 0]) + (0.0 if numbers[0] else here)
            end[5] = here[5]
            acceleration, speed, *_ = self._parameters_of(Id.CP_PARAMS)
            return self._go(end, Speeds(speed, speed, acceleration, acceleration), begins_s, linear=True)
        elif message.id == Id.HOME:
            x, y, z, r = self._parameters_of(Id.HOME_PARAMS)
            return self._go_to(np.array([x, y, z, 0, 0, r]), Speeds(HOME_SPEED_DEG_S, HOME_SPEED_DEG_S), begins_s)
        elif message.id == Id.WAIT:
            return begins_s + numbers[0] / 1000.0
        elif message.id == Id.JOG:
            self._jog(numbers[0], numbers[1], begins_s)
        return begins_s  # ResetPose needs no action: the emulated arm always knows its pose

    def _ptp(self, mode: int, numbers: np.ndarray, begins_s: float) -> float:
        here, joints = self.track.pose(np.inf), self.track.joints_deg(np.inf)
        target = np.array([*numbers[:3], 0.0, 0.0, numbers[3]])
        line, turn = self._ptp_speeds()
        if mode in (Ptp.MOVJ_ANGLE, Ptp.MOVJ_INC):
            return self._go(numbers + (joints if mode == Ptp.MOVJ_INC else 0.0), turn, begins_s, linear=False)
        if mode in (Ptp.JUMP_ANGLE, Ptp.MOVL_ANGLE):
            target = self.kinematics.forward(numbers)
        elif mode in (Ptp.MOVL_INC, Ptp.MOVJ_XYZ_INC):
            target = here + target
        elif mode not in set(Ptp):
            return self._alarm(NOT_UNDERSTOOD, begins_s)
        if mode in (Ptp.MOVJ_XYZ, Ptp.MOVJ_XYZ_INC):
            return self._go_to(target, turn, begins_s)
        if mode in (Ptp.JUMP_XYZ, Ptp.JUMP_ANGLE, Ptp.JUMP_MOVL_XYZ):
            height, limit = self._parameters_of(Id.PTP_JUMP_PARAMS)
            top = min(max(here[2], target[2]) + height, limit)
            over, above = here.copy(), target.copy()
            over[2] = above[2] = top
            begins_s = self._go(over, line, begins_s, linear=True)
            across = mode == Ptp.JUMP_MOVL_XYZ
            begins_s = self._go(above, line, begins_s, linear=True) if across else self._go_to(above, turn, begins_s)
        return self._go(target, line, begins_s, linear=True)

    def _arc(self, numbers: np.ndarray, begins_s: float) -> float:
        """Move along the circle through the present place and two others."""
        via, end = (np.array([*part[:3], 0.0, 0.0, part[3]]) for part in (numbers[:4], numbers[4:]))
        lines = circle(self.track.pose(np.inf), via, end)
        if len(lines) == 2:  # on one straight line
            return self._alarm(ARC_PLACES, begins_s)
        speed, turn, _, _ = self._parameters_of(Id.ARC_PARAMS)
        for pose in lines:
            begins_s = self._go(pose, Speeds(speed, turn), begins_s, linear=True)
        return begins_s

    def _jog(self, joints: int, command: int, begins_s: float) -> None:
        self.track.stop(begins_s)
        if not 1 <= command <= 8:
            return
        axis, sign = (command - 1) // 2, 1 if command % 2 else -1
        speed = self._parameters_of(Id.JOG_JOINT_PARAMS if joints else Id.JOG_COORDINATE_PARAMS)[axis]
        speed *= self._parameters_of(Id.JOG_COMMON_PARAMS)[0] / 100.0 * self._time_scale
        start = self.track.joints_deg(begins_s) if joints else self.track.pose(begins_s)
        at, length = (axis if joints or axis < 3 else 5), JOG_DEG if joints or axis == 3 else JOG_MM
        while length > 0.5 and speed > 0:  # the target is the last place within the limits
            end = start.copy()
            end[at] += sign * length
            moved = self.track.move(end, Speeds(speed, speed), linear=not joints, now_s=begins_s)
            if not isinstance(moved, Violation):
                return
            length *= 0.9

    def _go_to(self, pose: np.ndarray, speeds: Speeds, begins_s: float) -> float:
        try:
            return self._go(self.kinematics.inverse(pose), speeds, begins_s, linear=False)
        except OutOfReachError:
            return self._alarm(NO_INVERSE, begins_s)

    def _go(self, end: np.ndarray, speeds: Speeds, begins_s: float, *, linear: bool) -> float:
        if self.alarms or "ignore-moves" in self.faults:
            return begins_s
        speeds = speeds.scale_time(self._time_scale * self.faults.factor("slow"))
        # The end comes first: the places along a line to a far one are too many to count.
        broken = check_line(self.kinematics, end, end) if linear else None
        piece = broken or self.track.move(end, speeds, linear=linear, now_s=begins_s)
        if isinstance(piece, Violation):
            return self._alarm(piece.code, begins_s)
        for fault in ("stall", "lost-steps"):
            if fault in self.faults and piece.duration_s > 0:
                self.track.stop(piece.start_s + self.faults.factor(fault) * piece.duration_s)
                if fault == "stall":
                    return np.inf
                self._lost_at_s = self.track.end_s
        return piece.end_s

    def _alarm(self, alarm: int, begins_s: float) -> float:
        self.alarms.add(alarm)
        return begins_s

    def _ptp_speeds(self) -> tuple[Speeds, Speeds]:
        speed, acceleration = np.clip(self._parameters_of(Id.PTP_COMMON_PARAMS), 0.01, 100.0) / 100.0
        xyz, r, xyz2, r2 = self._parameters_of(Id.PTP_COORDINATE_PARAMS)
        joints = self._parameters_of(Id.PTP_JOINT_PARAMS)
        line = Speeds(speed * xyz, speed * r, acceleration * xyz2, acceleration * r2)
        return line, Speeds(speed * joints[0], speed * min(joints[:4]), acceleration * joints[4], acceleration * min(joints[4:]))

    def _parameters_of(self, id: Id) -> tuple:
        return struct.unpack(STORED[id][0], self._replies[id])

    def _set_tool(self, x_mm: float, time_s: float) -> None:
        if x_mm == self.kinematics.r0_mm:  # so that the past poses stay known
            return
        joints = self.track.joints_deg(time_s)
        self.kinematics = replace(MAGICIAN, r0_mm=x_mm)
        self.track = MotionTrack(self.kinematics, joints)
