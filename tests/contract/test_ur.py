"""A UR through ur_rtde itself: its kinematics, stops of every kind, a lost link, a second program, and the client's own scripts."""

import importlib.util
import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from hardware.arms.motion import OutOfReachError, turn_between_deg
from hardware.arms.open_arm import open_arm
from hardware.arms.ur.driver import MODELS, NORMAL, UrKinematics, pose_from_ur, pose_to_ur
from hardware.emulators.ur import UrEmulator
from hardware.errors import DeviceError, DeviceNotConnectedError
from hardware.rig.geometry import PlacedObject, poses_along
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.errors import ExtraError
from twin.rig.kinematics import Mounting

HOME = np.array([100.0, -500, 200, 0, 0, -160])
AWAY = HOME + [0, 200, 0, 0, 0, 0]
ROUNDING_DEG = 1e-6
# Own clients of ur_rtde, as in its examples, with all variables. Prints "done" if all went as its documents promise.
OWN_CLIENTS = """
import sys, time
from dashboard_client import DashboardClient
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
host, moves = sys.argv[1], int(sys.argv[2])
dashboard = DashboardClient(host)
dashboard.connect()
control, receive = RTDEControlInterface(host), RTDEReceiveInterface(host)
start = receive.getActualTCPPose()
near = lambda pose: max(abs(a - b) for a, b in zip(pose, receive.getActualTCPPose())) < 1e-3
rests = lambda: max(map(abs, receive.getActualQd())) < 1e-6

def soon(condition):
    end = time.monotonic() + 1.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)

for n in range(moves):
    target = list(start)
    target[n % 3] += 0.01 * (-1) ** n
    assert control.moveL(target, 0.5, 5.0)
    soon(lambda: near(target) and rests())
    if n % 10 == 9:
        assert control.moveL(start, 0.002, 1.0, True)
        control.stopL()
        soon(rests)
        assert not near(start)
assert control.moveJ([q + 0.05 for q in receive.getActualQ()])
control.triggerProtectiveStop()
soon(receive.isProtectiveStopped)
assert not control.moveL(start)
while receive.isProtectiveStopped():
    try:
        dashboard.unlockProtectiveStop()
    except Exception:
        time.sleep(0.1)
assert control.reuploadScript()
soon(control.isProgramRunning)
assert control.moveL(start, 0.5, 5.0)
control.stopScript()
soon(lambda: not control.isProgramRunning())
print("done")
"""


@pytest.fixture
def emulator():
    with UrEmulator(host=None, time_scale=10.0) as emulator:
        yield emulator


@pytest.fixture
def arm(emulator):
    with open_arm(f"ur:{emulator.host}") as arm:
        arm.enable()
        arm.set_speed(100.0, 100.0)
        arm.move_linear(HOME)
        yield arm


def await_that(condition, within_s=3.0):
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def still(emulator):
    before = emulator.pose()
    time.sleep(0.2)
    return np.array_equal(emulator.pose(), before)


def test_the_zero_of_a_ur5_is_where_its_maker_says():
    np.testing.assert_allclose(UrKinematics().forward(np.zeros(6)), [-817.25, -191.45, -5.491, 90, 0, 0], atol=1e-9)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_the_inverse_keeps_the_arms_side_and_turns(model):
    rng = np.random.default_rng(0)
    kinematics = UrKinematics(np.array(MODELS[model]))
    kinematics.T_flange_tool[:3, 3] = [10.0, -20.0, 100.0]
    for joints in rng.uniform(-360, 360, (60, 6)):
        kinematics.near_deg[:] = joints
        np.testing.assert_allclose(kinematics.inverse(kinematics.forward(joints)), joints, atol=1e-4)
    with pytest.raises(OutOfReachError):
        kinematics.inverse(np.array([3000.0, 0, 0, 0, 0, 0]))


def test_joint_6_keeps_its_angle_where_joint_4_lies_on_its_axis():
    kinematics = UrKinematics()
    joints = np.array([10.0, -80, 70, -30, 0, 55])
    kinematics.near_deg[:] = joints
    np.testing.assert_allclose(kinematics.inverse(kinematics.forward(joints)), joints, atol=1e-4)


def test_poses_go_to_the_arm_and_back():
    for pose in ([100.0, -200, 300, 180, 0, 30], [1, 2, 3, -20, 30, 170], [0, 0, 0, 0, 0, 0]):
        back = pose_from_ur(np.array(pose_to_ur(np.array(pose, float))))
        np.testing.assert_allclose(back[:3], pose[:3])
        assert turn_between_deg(back, np.array(pose, float)) < ROUNDING_DEG


def test_a_can_at_the_servos_place_is_within_reach_all_around(arm):
    servo, safe = load_servo("ur5"), SafeArm(arm, load_limits("ur"))
    placed = PlacedObject(load_object("can"), servo.placement, Mounting.of(load_sensor("mg400-331"), load_experiment(servo.experiment)))
    for _, pose in list(poses_along(placed, servo.indent_mm, np.inf))[::8]:
        joints = arm.kinematics.inverse(pose)
        assert arm.kinematics.violation(joints) is None and np.array_equal(safe.clip_pose(pose), pose)
        arm.kinematics.near_deg[:] = joints


def test_a_joint_does_not_go_past_its_end(arm):
    joints = arm.state().joints_deg
    arm.move_joints([*joints[:5], 355.0])
    with pytest.raises(DeviceError, match="pass its end"):
        arm.move_linear(arm.state().pose - [0, 0, 0, 0, 0, 30])
    arm.move_linear(arm.state().pose + [0, 0, 0, 0, 0, 30])


def test_a_protective_stop_is_told_and_released_and_nothing_goes_on(arm, emulator):
    emulator.faults.add("protective-stop=0.5")
    with pytest.raises(DeviceError, match="protective stop; free the arm"):
        arm.move_linear(AWAY)
    emulator.faults.clear()
    assert not arm.state().enabled and "protective" in arm.state().error
    with pytest.raises(DeviceError, match="protective"):
        arm.enable()
    stands = emulator.pose()
    arm.clear_error()
    assert not arm.state().error and emulator.arm.safety_mode == NORMAL
    arm.enable()
    assert still(emulator) and np.array_equal(emulator.pose(), stands)
    arm.move_linear(AWAY)


def test_an_emergency_stop_is_released_at_the_arm_only(arm, emulator):
    arm.move_linear(AWAY, wait=False)
    emulator.arm.press_emergency_stop()
    with pytest.raises(DeviceError, match="emergency stop; release it"):
        arm.wait_settled(AWAY)
    with pytest.raises(DeviceError, match="release it at the robot"):
        arm.clear_error()
    emulator.arm.safety_mode = NORMAL  # released
    await_that(lambda: not arm.state().error)
    arm.clear_error()
    arm.enable()
    arm.move_linear(AWAY)


def test_a_program_that_was_ended_is_told_and_enabled_again(arm, emulator):
    emulator.arm.end_program()
    await_that(lambda: arm.state().error)
    with pytest.raises(DeviceError, match=r"control program was ended.*enable\(\)"):
        arm.move_linear(AWAY)
    arm.enable()
    arm.move_linear(AWAY)


def test_the_speed_slider_is_told_and_slows(arm, emulator, caplog):
    arm.move_linear(AWAY)
    emulator.faults.add("slider=0.2")
    await_that(lambda: arm._newest()["TargetSpeedFraction"] == 0.2)
    begun = time.monotonic()
    arm.move_linear(HOME)
    assert time.monotonic() - begun > 0.2 / 0.1 / 10.0 / 0.2 * 0.9  # way, speed, time scale, slider
    assert "speed slider is at 20 %" in caplog.text


def test_a_lost_link_ends_the_program_and_comes_back_by_connect_only(arm, emulator):
    arm.set_speed(5.0, 5.0)
    arm.move_linear(AWAY, wait=False)
    emulator.unplug()
    with pytest.raises(DeviceError, match="Press its emergency stop"):
        arm.wait_settled(AWAY)
    await_that(lambda: not emulator.arm.busy())
    stands = emulator.pose()
    assert np.linalg.norm(stands[:3] - AWAY[:3]) > 50.0
    emulator.plug()
    with pytest.raises(DeviceNotConnectedError, match="connect"):
        arm.state()
    arm.disconnect()
    arm.connect()
    assert not arm.state().enabled
    arm.enable()
    assert still(emulator) and np.array_equal(emulator.pose(), stands)
    arm.move_linear(stands + [0, 1, 0, 0, 0, 0])


def test_the_arms_own_watchdog_stops_it_if_nobody_is_left(arm, emulator):
    arm.set_speed(5.0, 5.0)
    arm.move_linear(AWAY, wait=False)
    client = arm._client._process
    os.kill(client.pid, signal.SIGSTOP)
    await_that(lambda: not emulator.arm.busy())
    assert not emulator.arm.enabled and np.linalg.norm(emulator.pose()[:3] - AWAY[:3]) > 50.0
    client.kill()
    with pytest.raises(DeviceError, match="ended over the dashboard, so it stands"):
        arm.disconnect()


def test_a_second_program_gets_no_control(arm, emulator):
    with open_arm(f"ur:{emulator.host}") as second:
        assert np.allclose(second.state().pose, HOME, atol=0.01)
        with pytest.raises(DeviceError, match="already in use"):
            second.enable()
    arm.move_linear(AWAY)


def test_what_is_not_there_is_told_with_the_remedy(monkeypatch):
    with pytest.raises(DeviceNotConnectedError, match="twin emulate ur"):
        open_arm("ur:127.0.0.99").connect()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ExtraError, match=r"tactip-twin\[ur\]"):
        open_arm("ur:127.0.0.99").connect()


def own_clients(emulator, moves):
    found = subprocess.run([sys.executable, "-c", OWN_CLIENTS, emulator.host, str(moves)], capture_output=True, text=True, timeout=120)
    assert found.stdout.strip().endswith("done"), found.stderr[-2000:]


def test_the_clients_of_ur_rtde_find_what_they_know(emulator):
    own_clients(emulator, 10)


@pytest.mark.slow
def test_the_clients_of_ur_rtde_make_200_moves(emulator):
    own_clients(emulator, 200)


@pytest.mark.slow
def test_200_moves_and_stops_end_where_they_should(arm, emulator):
    rng = random.Random(0)
    arm.set_speed(200.0, 200.0)
    for n in range(200):
        target = HOME + [rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-40, 40), 0, 0, rng.uniform(-15, 15)]
        if n % 4 == 3:
            arm.move_linear(target, wait=False)
            arm.stop()
            assert not arm.state().moving
        else:
            arm.move_linear(target)
            np.testing.assert_allclose(emulator.pose(), target, atol=1e-6)
