"""An arm behind ROS 2 whose node, network or program fails: it stands, and the user is told."""

import os
import signal
import subprocess
import sys
import time
from threading import Event, Thread
from types import SimpleNamespace

import numpy as np
import pytest
from arms import own_namespace
from tried_faults import tried_in

pytest.importorskip("cyclonedds", reason="cyclonedds (the extra ros2) is not installed")

from hardware.arms.open_arm import open_arm
from hardware.arms.ros2 import COMMANDS, PERIOD_S, POSE, SILENCE_S, Ros2Arm
from hardware.emulators.ros2 import FASTEST, FAULTS, STALE_S, Ros2Emulator
from hardware.errors import DeviceError, DeviceNotConnectedError
from hardware.ros2.dds import Participant
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from twin.records import ros2 as ros

HOME = np.array([300.0, 0, 0, 0, 0, 0])
AWAY = HOME + [0, 60, 0, 0, 0, 20]
SPEED_MM_S = 50.0
FORMS = tuple(COMMANDS)
HARMLESS = ("lost-messages=2",)


def under_way(arm):
    """Connect an arm and send it on a long way."""
    arm.connect()
    arm.enable()
    arm.set_speed(SPEED_MM_S, SPEED_MM_S)
    arm.move_linear(AWAY, wait=False)
    time.sleep(0.3)
    assert arm.state().moving


def stands(emulator, within_s=0.1):
    time.sleep(within_s)
    still = emulator.pose()
    time.sleep(0.1)
    return np.array_equal(emulator.pose(), still)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("fault", HARMLESS)
def test_these_disturb_nothing(form, fault):
    name = own_namespace()
    with Ros2Emulator(form, namespace=name, faults=(fault,)) as emulator, Ros2Arm(form, namespace=name) as arm:
        arm.enable()
        arm.set_speed(200.0, 200.0)
        arm.move_linear(AWAY)
        assert np.allclose(emulator.pose(), AWAY, atol=0.05)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("faults", "told"),
    [
        (("silent-feedback",), "Press its emergency stop"),
        (("late-feedback=2",), "Press its emergency stop"),
        (("frozen",), "Press its emergency stop"),
        (("jump=50",), "its pose jumped by 50 mm"),
        (("ignore-commands",), "off its path"),
        (("slow=0.02",), "off its path"),
        (("die=0",), "Press its emergency stop"),
    ],
)
def test_these_end_in_an_error_and_the_arm_stands(form, faults, told):
    name = own_namespace()
    with Ros2Emulator(form, namespace=name) as emulator:
        arm = Ros2Arm(form, namespace=name)
        under_way(arm)
        before = emulator.pose()
        emulator._ended.set() if "die=0" in faults else emulator.faults.add(faults[0])
        with pytest.raises(DeviceError, match=told):
            arm.wait_settled(AWAY, timeout_s=5.0)
        assert stands(emulator)
        assert np.linalg.norm(emulator.pose()[:3] - before[:3]) < 1.3 * SPEED_MM_S * (SILENCE_S + 0.2)
        with pytest.raises(DeviceError):
            arm.move_linear(HOME)
        assert stands(emulator)
        try:
            arm.disconnect()
        except DeviceError as error:
            assert "may move" in str(error)
        assert not arm.is_connected


def test_the_list_above_is_complete():
    assert tried_in(test_these_end_in_an_error_and_the_arm_stands, *HARMLESS) == set(FAULTS)


@pytest.mark.parametrize("form", FORMS)
def test_a_wrong_pose_moves_the_arm_nowhere(form):
    """Not even after a stop, which would otherwise send the arm to the place where it is not."""
    name = own_namespace()
    with Ros2Emulator(form, namespace=name) as emulator:
        arm = Ros2Arm(form, namespace=name)
        under_way(arm)
        before = emulator.pose()
        emulator.faults.add("jump=50")
        with pytest.raises(DeviceError, match="jumped"):
            arm.wait_settled(AWAY)
        arm.stop()
        time.sleep(0.2)
        assert np.linalg.norm(emulator.pose()[:3] - before[:3]) < 0.2 * SPEED_MM_S
        arm.disconnect()


@pytest.mark.parametrize("form", FORMS)
def test_no_command_leads_farther_than_the_arm_goes_meanwhile(form):
    """What any node hears: each pose is near the arm, each twist within the speed; and a zero twist, or the present pose, ends all."""
    name, heard, end = own_namespace(), [], Event()
    with Ros2Emulator(form, namespace=name) as emulator:
        reader = Participant().reader(emulator.topics[2], COMMANDS[form][0])

        def listen():
            while not end.is_set():
                heard.extend((emulator.pose(), ros.decode(COMMANDS[form][0], data)) for data in reader.take())

        thread = Thread(target=listen, daemon=True)
        thread.start()
        arm = Ros2Arm(form, namespace=name)
        under_way(arm)
        arm.stop()
        time.sleep(0.2)
        here = emulator.pose()
        arm.disconnect()
        end.set()
        thread.join()
    assert len(heard) > 10 and all(message["header"]["frame_id"] == "base_link" for _, message in heard)
    if form == "pose":
        far = [np.linalg.norm(ros.matrix_in(message["pose"])[:3, 3] - pose[:3]) for pose, message in heard]
        assert max(far) < SPEED_MM_S * 0.3 < FASTEST  # a busy machine reads late
        assert np.allclose(ros.matrix_in(heard[-1][1]["pose"])[:3, 3], here[:3], atol=0.01)
    else:
        speeds = [1000 * np.linalg.norm(list(message["twist"]["linear"].values())) for _, message in heard]
        assert 0.9 * SPEED_MM_S < max(speeds) < 1.3 * SPEED_MM_S and not any(heard[-1][1]["twist"]["linear"].values())


@pytest.mark.parametrize("form", FORMS)
def test_a_killed_program_leaves_an_arm_that_stands(form):
    """Servo stops at an old twist; the last pose is where the arm is soon."""
    name = own_namespace()
    moves = f"""
import time
from hardware.arms.open_arm import open_arm
arm = open_arm("ros2:{form},namespace={name}")
arm.connect(); arm.enable(); arm.set_speed({SPEED_MM_S}, 30.0)
arm.move_linear({AWAY.tolist()}, wait=False)
print("moves", flush=True)
time.sleep(60)
"""
    with (
        Ros2Emulator(form, namespace=name) as emulator,
        subprocess.Popen([sys.executable, "-c", moves], stdout=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout.readline().strip() == "moves"
        time.sleep(0.4)
        assert not stands(emulator, 0.0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        killed = emulator.pose()
        assert stands(emulator, STALE_S + 0.1)
        assert np.linalg.norm(emulator.pose()[:3] - killed[:3]) < 1.3 * SPEED_MM_S * (STALE_S + 2 * PERIOD_S)


@pytest.mark.parametrize("form", FORMS)
def test_a_node_in_a_process_of_its_own_and_its_death(form):
    name = own_namespace()
    command = [sys.executable, "-m", "twin", "emulate", "ros2", "--form", form, "--namespace", name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as node:
        assert node.stdout.readline().startswith(f"ready ros2 /{name}/current_pose")
        arm = open_arm(f"ros2:{form},namespace={name}")
        under_way(arm)
        arm.move_linear(HOME)
        arm.move_linear(AWAY, wait=False)
        os.kill(node.pid, signal.SIGKILL)
        begun_s = time.monotonic()
        with pytest.raises(DeviceError, match="no pose or no joints"):
            arm.wait_settled(AWAY)
        assert time.monotonic() - begun_s < 2.0
        with pytest.raises(DeviceError, match="may move"):
            arm.stop()
        arm.disconnect()
        assert not arm.is_connected


def test_what_is_missing_is_named_and_other_topics_can_be_given():
    name = own_namespace()
    with Ros2Emulator("twist", namespace=name) as emulator:
        wrong = open_arm(f"ros2:pose,namespace={name}")
        with pytest.raises(DeviceNotConnectedError, match=f"takes {POSE} on /{name}/target_pose.*There are: .*{emulator.topics[0]}"):
            wrong.connect()
        pose, joints, command = emulator.topics
        with open_arm(f"ros2:twist,pose={pose},joints={joints},command={command},axes=3") as arm:
            assert arm.state().joints_deg.shape == (3,)


def test_it_says_that_no_emergency_stop_is_behind_it(caplog):
    name = own_namespace()
    with Ros2Emulator("twist", namespace=name), Ros2Arm("twist", namespace=name):
        assert "no emergency stop" in caplog.text


def test_its_moves_are_limited_as_those_of_any_arm():
    name = own_namespace()
    with Ros2Emulator("twist", namespace=name) as emulator, SafeArm(Ros2Arm("twist", namespace=name), load_limits("ros2")) as arm:
        arm.enable()
        with pytest.raises(DeviceError, match="outside-box"):
            arm.move_linear(HOME + [0, 400, 0, 0, 0, 0])
        assert np.array_equal(emulator.pose(), HOME)


@pytest.mark.parametrize("text", ["ros2:twist,namespace=1a", "ros2:pose,pose=/a b", "ros2:twist,axes=0", "ros2:twist,pose="])
def test_names_that_ros_refuses(text):
    with pytest.raises(DeviceError, match="expected"):
        open_arm(text)


@pytest.mark.parametrize("shift_s", [-1000, 1000, None], ids=str)
def test_clocks_may_differ_and_a_stamp_may_be_missing(shift_s, monkeypatch):
    name, header_of = own_namespace(), ros.header_of
    monkeypatch.setattr(ros, "header_of", lambda ns, frame: header_of(0 if shift_s is None else ns + shift_s * ros.NS_PER_S, frame))
    with Ros2Emulator("pose", namespace=name), Ros2Arm("pose", namespace=name) as arm:
        assert abs(arm.state().time_s - time.monotonic()) < SILENCE_S
        arm.enable()
        arm.move_linear(HOME + [0, 5, 0, 0, 0, 0])


@pytest.mark.parametrize("ppm", [-200, 200])
def test_a_clock_that_drifts_for_hours_makes_no_pose_late(ppm, monkeypatch):
    arm, clock = Ros2Arm("twist"), SimpleNamespace(monotonic=lambda: now_s)
    monkeypatch.setattr("hardware.arms.ros2.time", clock)
    for now_s in np.arange(1000.0, 15_400.0, 10.0):
        stamp = ros.header_of(round((1 + 1e-6 * ppm) * now_s * ros.NS_PER_S), "base_link")
        arm._take_pose({"header": stamp, "pose": ros.place(np.eye(4))})
        assert abs(arm._pose_s - now_s) < 0.1 * SILENCE_S
