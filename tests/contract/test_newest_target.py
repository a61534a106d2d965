"""Actions that come faster than the arm moves: the newest wins, and what is returned was really sent."""

import threading
import time

import numpy as np
import pytest
from arms import bench, mg400_of

from hardware.arms.arm import PIECE_S, SimulatedArm
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.live.lerobot import LeRobotArm
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm

RATE_HZ, ACTIONS = 30.0, 45
SPEED_MM_S = 60.0
RAMPS = 2.5  # a Magician's pieces are mostly acceleration and braking
SLACK_S = 0.6  # of a busy machine


def stream(robot, values):
    """Actions on y at a fixed rate; what was returned for each."""
    due_s, sent = time.monotonic(), []
    for value in values:
        sent.append(robot.send_action({"y": float(value)})["y"])
        due_s += 1 / RATE_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
    return sent


@pytest.mark.parametrize("kind", ["mg400", "magician", "simulated-6"])
def test_a_fast_stream_is_not_replayed_afterwards(kind):
    with bench(kind, time_scale=1.0) as at:
        robot = LeRobotArm(at.arm, linear_mm_s=SPEED_MM_S)
        robot.connect()
        values = 40.0 * np.sin(2 * np.pi * 2.0 * np.arange(ACTIONS) / RATE_HZ)  # up to 500 mm/s
        stream(robot, values)
        begun_s = time.monotonic()
        there = robot.get_observation()
        way_mm = abs(there["y"] - values[-1])
        while abs(robot.get_observation()["y"] - values[-1]) > 0.05:
            assert time.monotonic() - begun_s < PIECE_S + RAMPS * way_mm / SPEED_MM_S + SLACK_S
        robot.disconnect()


def test_what_is_returned_was_really_sent():
    with Mg400Emulator(port_offset=None) as emulator:
        ordered = []
        order = emulator.arm.order
        emulator.arm.order = lambda one: ordered.append(one.end[1]) or order(one)
        robot = LeRobotArm(SafeArm(mg400_of(emulator), load_limits("mg400")), linear_mm_s=SPEED_MM_S)
        robot.connect()
        start = robot.get_observation()["y"]
        sent = stream(robot, np.linspace(0, 50, 20))
        assert all(np.isclose(one, [start, *ordered], atol=1e-3).any() for one in sent)
        assert len(ordered) < 20 and max(np.abs(np.diff([start, *ordered]))) <= PIECE_S * SPEED_MM_S + 0.01
        robot.disconnect()


def test_an_action_beyond_the_limits_is_clipped_and_never_refused():
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        limits = load_limits("mg400")
        robot = LeRobotArm(SafeArm(mg400_of(emulator), limits))
        robot.connect()
        for key, value in (("y", 500.0), ("z", -300.0), ("x", 0.0), ("x", 900.0)):
            begun_s, last = time.monotonic(), None
            robot.send_action({key: value})
            while last is None or abs(robot.get_observation()[key] - last) > 1e-3:
                last = robot.get_observation()[key]
                time.sleep(0.1)
                assert time.monotonic() - begun_s < 10.0
            low, high = limits.box_mm["xyz".index(key)]
            assert low - 0.01 <= last <= high + 0.01
        robot.disconnect()


def test_an_arm_that_fails_on_its_way_is_told_with_the_next_action():
    with Mg400Emulator(port_offset=None) as emulator:
        robot = LeRobotArm(mg400_of(emulator), linear_mm_s=SPEED_MM_S)
        robot.connect()
        robot.send_action({"y": 80.0})
        time.sleep(0.3)
        emulator.arm.raise_alarm(112)
        time.sleep(0.4)
        with pytest.raises(DeviceError, match="alarm 112"):
            robot.send_action({"y": 0.0})
        robot.disconnect()


def test_an_error_of_any_kind_in_the_thread_is_told_with_the_next_action():
    """As of an arm of another package."""
    robot = LeRobotArm(SimulatedArm(), linear_mm_s=SPEED_MM_S)
    robot.connect()
    state = robot.arm.state

    def fail_in_the_thread(**options):
        if threading.current_thread().name == "newest target":
            raise OSError("the cable is out")
        return state(**options)

    robot.send_action({"y": 80.0})
    robot.arm.state = fail_in_the_thread
    time.sleep(0.4)
    with pytest.raises(OSError, match="the cable is out"):
        robot.send_action({"y": 0.0})
    robot.disconnect()
