"""Scripts written for cri and LeRobot drive our arms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hardware.arms.cri import EULER_AXES, Controller, SyncRobot, matrix_pose, pose_matrix
from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.arms.simulated import SimulatedArm
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceAlreadyConnectedError, DeviceError, DeviceNotConnectedError
from hardware.lerobot import LeRobotArm
from hardware.safe_arm import SafeArm
from hardware.safety import load_limits

WORK = (300, 0, 0, -180, 0, 0)


def drive(robot):
    """What the group's own test script does."""
    robot.coord_frame = WORK
    robot.tcp = (0, 0, -50, 0, 0, 0)
    robot.linear_speed, robot.angular_speed = 90, 90
    for pose in ((0, 0, 0, 0, 0, 0), (30, 0, 0, 0, 0, 0), (0, 30, 20, 0, 0, 0), (0, 0, 0, 0, 0, 30)):
        robot.move_linear(pose)
        assert np.allclose(robot.pose, pose, atol=0.05) and np.allclose(robot.target_pose, pose, atol=1e-6)
    joints = robot.joint_angles + 1.0
    robot.move_joints(joints)
    assert np.allclose(robot.joint_angles, joints, atol=0.01) and np.allclose(robot.target_joint_angles, joints)
    robot.move_linear((0, 0, 0, 0, 0, 0))
    return robot


@pytest.mark.parametrize("axes", [4, 6])
def test_a_script_for_cri_drives_a_simulated_arm(axes):
    arm = SimulatedArm(axes=axes, time_scale=20.0)
    with SyncRobot(Controller(arm)) as robot:
        drive(robot)
        flange = arm.track.pose(np.inf)
        assert np.allclose(flange[:3], [300, 0, 50], atol=0.01)  # the tip at the work frame, the flange 50 mm above
        assert "simulated" in robot.info and np.allclose(robot.tcp, (0, 0, -50, 0, 0, 0)) and robot.linear_speed == 90
        with pytest.raises(DeviceError, match="overall"):
            robot.speed = 20
    assert not arm.is_connected


def test_a_script_for_cri_drives_the_mg400_in_percent():
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        ports = emulator.ports
        arm = MG400("127.0.0.1", ports=Mg400Ports(ports[29999], ports[30003], (ports[30004], ports[30005])))
        with SyncRobot(Controller(arm)) as robot:
            robot.speed = 50
            drive(robot)
            assert emulator.arm.percent["speedl"] == 90 and emulator.arm.percent["speedfactor"] == 50
            assert np.allclose(emulator.pose()[:3], [300, 0, 50], atol=0.01)


@pytest.mark.parametrize("axes", EULER_AXES)
def test_every_euler_convention_is_that_of_its_name(axes):
    angles = np.array([10.0, 40.0, 30.0])
    turns = [Rotation.from_euler(letter, angle, degrees=True).as_matrix() for letter, angle in zip(axes[1:], angles, strict=True)]
    # about fixed axes each turn comes from the left, about its own from the right
    product = turns[2] @ turns[1] @ turns[0] if axes[0] == "s" else turns[0] @ turns[1] @ turns[2]
    T = pose_matrix(np.r_[1, 2, 3, angles], axes)
    assert np.allclose(T[:3, :3], product) and np.allclose(matrix_pose(T, axes), np.r_[1, 2, 3, angles])


def test_axes_and_poses_are_checked():
    with SyncRobot(Controller(SimulatedArm())) as robot:
        assert robot.axes == "sxyz"
        robot.axes = "rzyx"
        with pytest.raises(DeviceError, match="sxyz"):
            robot.axes = "abc"
        with pytest.raises(DeviceError, match="6 numbers"):
            robot.move_linear((1, 2, 3))


@pytest.mark.parametrize("axes", [4, 6])
def test_lerobots_shape(axes):
    robot = LeRobotArm(SafeArm(SimulatedArm(axes=axes, time_scale=20.0), load_limits("simulated").model_copy(update={"step_mm": 5.0})))
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()
    robot.connect(calibrate=True)
    with pytest.raises(DeviceAlreadyConnectedError):
        robot.connect()
    assert isinstance(DeviceNotConnectedError(), ConnectionError) and robot.is_connected and robot.is_calibrated
    seen = robot.get_observation()
    assert set(seen) == set(robot.observation_features) and all(type(value) is float for value in seen.values())
    action = {key: seen[key] for key in robot.action_features} | {"x": 350.0}
    sent = robot.send_action(action)
    assert set(sent) == set(robot.action_features) and sent["x"] == pytest.approx(305.0)  # what was really sent: clipped
    robot.arm.wait_settled(np.array([305.0, 0, 0, 0, 0, 0]))
    assert robot.send_action({"y": 1.0})["y"] == pytest.approx(1.0)  # what is left out stays
    with pytest.raises(KeyError, match="z"):
        robot.send_action({"gripper": 1.0})
    robot.disconnect()
    assert not robot.is_connected
