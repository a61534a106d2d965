"""Scripts written for cri and LeRobot drive our arms."""

import signal
import time

import numpy as np
import pytest
from noisy_camera import NoisyCamera
from scipy.spatial.transform import Rotation

from hardware.arms.arm import SimulatedArm
from hardware.arms.cri import (
    AsyncBusy,
    AsyncNotBusy,
    AsyncRobot,
    Controller,
    DummyController,
    InvalidEulerAxes,
    InvalidEulerPose,
    InvalidJointAngles,
    RobotController,
    SyncRobot,
)
from hardware.arms.cri.transforms import (
    EULER_AXES,
    euler2mat,
    euler2quat,
    inv_transform,
    inv_transform_euler,
    mat2euler,
    quat2euler,
    transform,
    transform_euler,
)
from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.arms.motion import circle
from hardware.cameras.mjpeg import MjpegCamera
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceAlreadyConnectedError, DeviceError, DeviceNotConnectedError
from hardware.live.lerobot import LeRobotArm, LeRobotCamera
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from scenes import load_sensor
from twin.types import Form

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
    with SyncRobot(RobotController(arm)) as robot:
        drive(robot)
        flange = arm.track.pose(np.inf)
        assert np.allclose(flange[:3], [300, 0, 50], atol=0.01)  # the tip at the work frame, the flange 50 mm above
        assert "simulated" in robot.info and np.allclose(robot.tcp, (0, 0, -50, 0, 0, 0)) and robot.linear_speed == 90
        assert robot.speed == 100
    assert not arm.is_connected


def test_a_script_for_cri_drives_the_mg400_in_percent():
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        ports = emulator.ports
        arm = MG400("127.0.0.1", ports=Mg400Ports(ports[29999], ports[30003], (ports[30004], ports[30005])))
        with SyncRobot(RobotController(arm)) as robot:
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
    T = euler2mat(np.r_[1, 2, 3, angles], axes)
    assert np.allclose(T[:3, :3], product) and np.allclose(mat2euler(T, axes), np.r_[1, 2, 3, angles])


def test_axes_and_poses_are_checked():
    with SyncRobot(RobotController(SimulatedArm())) as robot:
        assert robot.axes == "sxyz"
        robot.axes = "rzyx"
        with pytest.raises(DeviceError, match="sxyz"):
            robot.axes = "abc"
        with pytest.raises(DeviceError, match="6 numbers"):
            robot.move_linear((1, 2, 3))


def test_frames_within_frames():
    pose, frame = np.array([10.0, 20, 30, 40, 50, 60]), np.array([1.0, -2, 3, 100, 10, -20])
    inside = transform_euler(pose, frame)
    np.testing.assert_allclose(inv_transform_euler(inside, frame), pose)
    np.testing.assert_allclose(quat2euler(transform(euler2quat(pose), euler2quat(frame))), inside)
    np.testing.assert_allclose(quat2euler(inv_transform(euler2quat(inside), euler2quat(frame))), pose)
    np.testing.assert_allclose(transform_euler(frame, frame), np.zeros(6), atol=1e-9)
    assert euler2quat((1, 2, 3, 0, 0, 0)).tolist() == [1, 2, 3, 1, 0, 0, 0]


def test_the_names_of_cri_and_their_errors():
    assert set(Controller) == {"mg400", "magician", "dummy"} and "sim" not in Controller and Controller.get("sim", "other") == "other"
    with pytest.raises(KeyError, match="mg400"):
        Controller["ur"]
    with AsyncRobot(SyncRobot(Controller["dummy"]())) as robot:
        assert isinstance(robot.controller, DummyController) and "simulated" in repr(robot)
        assert robot.elbow is None and robot.target_elbow is None and robot.blend_radius == 0 and robot.target_pose is None
        with pytest.warns(UserWarning, match="blend"):
            robot.blend_radius = 10
        for speed in (0, 200, np.nan, -1):
            with pytest.raises(DeviceError, match="1 to 100"):
                robot.speed = speed
        with pytest.raises(DeviceError, match="positive"):
            robot.linear_speed = 0
        with pytest.raises(AsyncNotBusy):
            robot.async_result()
        with pytest.raises(AsyncNotBusy):
            robot.async_done()
        with pytest.raises(InvalidJointAngles):
            robot.move_joints((1, 2, 3))
        with pytest.raises(InvalidEulerPose):
            robot.tcp = (1, 2, 3)
        with pytest.raises(InvalidEulerAxes):
            robot.axes = "xyz"


@pytest.fixture
def mg400_robot():
    """As the group's own test makes it, of the class by its name."""
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        # the emulator's ports are free ones, not in one row
        arm = MG400("127.0.0.1", ports=Mg400Ports(emulator.ports[29999], emulator.ports[30003], (emulator.ports[30004],)))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("hardware.arms.cri.controller.open_arm", lambda spec: arm)
            with AsyncRobot(SyncRobot(Controller["mg400"]())) as robot:
                robot.coord_frame, robot.tcp = WORK, (0, 0, -50, 0, 0, 0)
                yield robot, emulator


def test_moves_in_the_background_end_and_their_errors_are_told(mg400_robot):
    robot, _ = mg400_robot
    assert robot.speed == 100  # what the arm tells
    robot.speed = 50
    robot.async_move_linear((50, 0, 0, 0, 0, 30))
    with pytest.raises(AsyncBusy):
        robot.async_move_linear((0, 0, 0, 0, 0, 0))
    robot.async_result()
    assert np.allclose(robot.pose, (50, 0, 0, 0, 0, 30), atol=0.05)
    robot.async_move_joints(robot.joint_angles - 5.0)
    robot.async_result()
    robot.async_move_linear((900, 0, 0, 0, 0, 0))
    with pytest.raises(DeviceError, match="reach"):
        robot.async_result()
    robot.move_linear((0, 0, 0, 0, 0, 0))


def test_closing_stops_a_move_in_the_background(mg400_robot):
    robot, emulator = mg400_robot
    robot.move_linear((0, 0, 0, 0, 0, 0))
    robot.speed = 1
    robot.async_move_linear((0, 60, 0, 0, 0, 0))
    time.sleep(0.2)
    robot.close()
    assert not emulator.arm.busy() and not emulator.arm.enabled


def test_a_slow_move_has_time_to_end():
    with pytest.MonkeyPatch.context() as patch, SyncRobot(DummyController()) as robot:
        patch.setattr("hardware.arms.cri.controller.PATIENCE_S", 0.1)
        robot.linear_speed = 10.0
        robot.move_linear(robot.pose + [8, 0, 0, 0, 0, 0])  # takes 0.8 s


def test_a_circle_goes_through_its_places_at_an_even_turn(mg400_robot):
    robot, emulator = mg400_robot
    robot.move_linear((0, 0, 0, 0, 0, 0))
    begun_s = time.monotonic()
    robot.move_circular((20, 20, 0, 0, 0, 10), (40, 0, 0, 0, 0, 20))
    assert np.allclose(robot.pose, (40, 0, 0, 0, 0, 20), atol=0.05)
    places = np.array([emulator.arm.track.pose(time_s)[:3] for time_s in np.linspace(begun_s, time.monotonic(), 200)])
    middle = np.array([320.0, 0, 50])
    assert np.abs(np.linalg.norm(places - middle, axis=1) - 20.0).max() < 0.1 and np.ptp(places[:, 1]) == pytest.approx(20.0, abs=0.1)


def test_three_places_on_a_line_are_gone_through_straight():
    start, via, end = (np.array([x, 0.0, 0, 0, 0, 0]) for x in (0.0, 10, 30))
    assert [pose.tolist() for pose in circle(start, via, end)] == [via.tolist(), end.tolist()]


def test_a_servo_delay_follows_the_newest_pose(mg400_robot):
    robot, emulator = mg400_robot
    robot.move_linear((0, 0, 0, 0, 0, 0))
    robot.linear_speed = 5
    robot.controller.servo_delay = 0.02
    for y in np.linspace(0, 60, 20):
        robot.move_linear((0, y, 0, 0, 0, 0))
    robot.move_linear((0, 10, 0, 0, 0, 0))
    deadline = time.monotonic() + 3.0
    while abs(robot.pose[1] - 10) > 0.1:
        assert time.monotonic() < deadline
    robot.controller.servo_delay = None
    robot.controller.tolerance = 1.0
    robot.move_linear((0, 0, 0, 0, 0, 0))
    assert abs(robot.pose[1]) < 1.1


def test_the_controllers_own_tool(mg400_robot):
    robot, emulator = mg400_robot
    robot.tcp = (0, 0, 0, 0, 0, 0)
    robot.tcp_controller = (0, 0, -50, 0, 0, 0)
    robot.move_linear((0, 0, 0, 0, 0, 0))
    assert np.allclose(robot.pose, 0, atol=0.05) and np.allclose(robot.tcp_controller, (0, 0, -50, 0, 0, 0))
    assert abs(emulator.pose()[2]) == pytest.approx(50.0, abs=0.1)


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


def test_the_whole_of_lerobots_robot():
    camera = LeRobotCamera(NoisyCamera(fps=50), fps=50, width=64, height=48)
    robot = LeRobotArm(SafeArm(SimulatedArm(axes=4, time_scale=20.0), load_limits("mg400")), id="left", cameras={"tactip": camera})
    assert robot.name == robot.robot_type == "simulatedarm" and robot.id == "left" and str(robot) == "left LeRobotArm"
    assert robot.observation_features["tactip"] == (48, 64, 3) and robot.calibration == {}
    with robot:
        assert robot.is_connected and camera.is_connected
        robot.calibrate()
        robot.configure()
        seen = robot.get_observation()
        assert seen["tactip"].shape == (48, 64, 3) and seen["tactip"].dtype == np.uint8
        sent = robot.send_action(seen)  # an observation is an action
        assert all(sent[key] == pytest.approx(seen[key], abs=0.05) for key in robot.action_features)
        assert robot.send_action({"y": 1e9})["y"] < 301  # clipped, not refused
    assert not robot.is_connected and not camera.is_connected


def test_a_robot_from_its_configuration():
    config = LeRobotArm.config_class(arm="simulated:4", limits="mg400", id="one")
    robot = LeRobotArm(config)
    assert config.type == "simulated" and robot.id == "one" and isinstance(robot.arm, SafeArm)
    assert "192" not in LeRobotArm(LeRobotArm.config_class(arm="mg400:192.168.1.6")).name


def test_a_gray_camera_gives_pictures_of_three_channels():
    camera = LeRobotCamera(NoisyCamera(fps=50))
    assert camera.width is None and camera.fps == 50
    with camera:
        assert (camera.width, camera.height) == (64, 48)
        for picture in (camera.read(), camera.async_read(), camera.read_latest()):
            assert picture.shape == (48, 64, 3) and np.array_equal(picture[..., 0], picture[..., 2])
    known = LeRobotCamera(MjpegCamera("http://127.0.0.1:1/", load_sensor("mg400-331"), Form.PROCESSED))
    assert (known.width, known.height) == (360, 360)
    robot = LeRobotArm(SimulatedArm(), cameras={"front": LeRobotCamera(NoisyCamera())})
    with pytest.raises(DeviceError, match="width and height"):
        dict(robot.observation_features)


@pytest.mark.parametrize("way", ["tolerance", "servo"])
def test_a_move_that_is_interrupted_leaves_no_arm_moving(mg400_robot, way):
    """As with Ctrl-C: a signal's handler raises in the main thread."""
    robot, emulator = mg400_robot
    robot.controller.linear_speed = robot.controller.angular_speed = 5
    robot.controller.tolerance, robot.controller.servo_delay = (1.0, None) if way == "tolerance" else (None, 1.0)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.15)
    try:
        with pytest.raises(KeyboardInterrupt):
            robot.move_linear((0, 60, 0, 0, 0, 0))
    finally:
        signal.signal(signal.SIGALRM, before)
    stands = emulator.pose()
    time.sleep(0.3)
    assert np.allclose(emulator.pose(), stands) and not emulator.arm.busy()


@pytest.mark.parametrize(("fault", "said"), [("collision", "collision"), ("stall", "at rest")])
def test_a_move_that_ends_within_a_tolerance_tells_a_fault_at_once(mg400_robot, fault, said):
    robot, emulator = mg400_robot
    robot.controller.tolerance = 1.0
    emulator.faults.add(fault)
    begun_s = time.monotonic()
    with pytest.raises(DeviceError, match=said):
        robot.move_linear((0, 60, 0, 0, 0, 0))
    assert time.monotonic() - begun_s < 5.0
