"""The emulated MG400's feedback packet."""

import time

import numpy as np

from hardware.arms.mg400_wire import PACKET, PACKET_BYTES, ROBOT_TYPE_MG400, TEST_VALUE, Mode
from hardware.emulators.mg400_controller import Mg400Controller, PlanarFrame

DIFFERENCE_S = 0.008  # interval of the finite differences that give speeds


def feedback_packet(arm: Mg400Controller) -> np.ndarray:
    """The present state as a record of ``PACKET``. The arm follows its targets exactly. Currents and forces are not emulated."""
    mode, now_s = arm.mode(), arm.update()
    user, tool = arm.users[arm.user], arm.tools[arm.tool]
    joints, before = arm.track.joints_deg(now_s), arm.track.joints_deg(now_s - DIFFERENCE_S)
    seen = _seen(arm, joints, user, tool)
    speed = (seen - _seen(arm, before, user, tool)) / DIFFERENCE_S
    half_turn = np.radians(seen[3]) / 2
    packet = np.zeros((), PACKET)
    for names, value in (
        (("length",), PACKET_BYTES),
        (("test_value",), TEST_VALUE),
        (("digital_out",), arm.digital_out),
        (("mode",), int(mode)),
        (("unix_ms",), int(time.time() * 1000)),
        (("speed_scaling",), arm.percent["speedfactor"]),
        (("q_target", "q_actual"), [*joints, 0, 0]),
        (("qd_target", "qd_actual"), [*((joints - before) / DIFFERENCE_S), 0, 0]),
        (("tool_target", "tool_actual"), [*seen, 0, 0]),
        (("tcp_speed_target", "tcp_speed_actual"), [*speed, 0, 0]),
        (("user_index",), arm.user),
        (("tool_index",), arm.tool),
        (("queue_runs",), arm.queue_runs),
        (("paused",), arm.paused),
        (("enabled",), arm.enabled),
        (("running",), mode == Mode.RUNNING),
        (("error",), bool(arm.alarms)),
        (("jog",), mode == Mode.JOG),
        (("robot_type",), ROBOT_TYPE_MG400),
        (("load",), arm.load),
        (("user",), [user.x, user.y, user.z, user.r, 0, 0]),
        (("tool",), [tool.x, tool.y, tool.z, tool.r, 0, 0]),
        (("target_quaternion", "actual_quaternion"), [np.cos(half_turn), 0, 0, np.sin(half_turn)]),
    ):
        for name in names:
            packet[name] = value
    return packet


def _seen(arm: Mg400Controller, joints: np.ndarray, user: PlanarFrame, tool: PlanarFrame) -> np.ndarray:
    """X, Y, Z, R of the tool in the user frame."""
    flange = PlanarFrame.of_pose(arm.kinematics.forward(joints))
    return (user.inverse() @ flange @ tool).pose[[0, 1, 2, 5]]
