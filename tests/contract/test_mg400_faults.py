"""Whatever an MG400 does wrong, the driver recovers, or stops it and says what to do."""

import socket
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from arms import mg400_of
from tried_faults import tried_in

from hardware.arms import motion
from hardware.arms.mg400 import Mg400Ports
from hardware.arms.mg400_wire import PACKET, PACKET_BYTES, TEST_VALUE, CommandPort, Feedback, newest_packet, take_reply
from hardware.emulators.mg400 import FAULTS, Mg400Emulator, feedback_packet
from hardware.emulators.mg400_controller import RefusedError
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from twin.errors import TwinError

HOME = np.array([300.0, 0, 0, 0, 0, 10])
AWAY = HOME + [0, 60, -10, 0, 0, 20]
SLOW_SHARE_PERCENT = 5.0  # of 1000 mm/s: a move of 60 mm takes over a second

HARMLESS = (
    "split-refusals",
    "needs-motion-client",
    "one-client",
    "no-fast-feedback",
    "short-packets=3",
    "wrong-test-value=3",
    "six-value-pose",
    "error-groups=7",
)


def emulated(*faults, **options):
    return Mg400Emulator(port_offset=None, faults=faults, **options)


def go(arm, *, timeout_s=10.0):
    arm.connect()
    arm.enable()
    arm.move_linear(HOME, timeout_s=timeout_s)
    arm.move_linear(AWAY, timeout_s=timeout_s)


@pytest.mark.parametrize("fault", HARMLESS)
def test_these_disturb_nothing(fault):
    with emulated(fault, time_scale=4.0) as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.move_linear(AWAY)
        assert np.allclose(emulator.pose(), AWAY, atol=0.01)


@pytest.mark.parametrize(
    ("faults", "remedy"),
    [
        (("no-tcp-mode",), "TCP/IP Secondary Development"),
        (("no-tcp-mode", "split-refusals"), "TCP/IP Secondary Development"),
        (("motion-port-closed",), "no other program holds the port"),
        (("no-feedback",), "close other programs"),
        (("silent-feedback=0",), "restart the arm"),
        (("late-feedback=0.5",), "not executed"),
        (("emergency-stop",), "release the emergency stop"),
        (("collision",), "free the arm by hand"),
        (("stall",), "not executed"),
        (("ignore-moves",), "not executed"),
        (("slow=0.01",), "more time"),
        (("no-sync-reply",), "more time"),
        (("no-move-reply",), "no reply to MovL"),
        (("frozen=0.3", "slow=0.05"), "Press its emergency stop"),
        (("silent-feedback=0.2", "slow=0.05"), "no feedback"),
        (("die=0.15", "slow=0.05"), "power and cable|Press its emergency stop"),  # whichever of its connections is missed first
    ],
)
def test_these_end_in_an_error_with_a_remedy_and_the_arm_stands_still(faults, remedy):
    with emulated(*faults) as emulator:
        arm = mg400_of(emulator)
        with pytest.raises(DeviceError, match=remedy):
            go(arm, timeout_s=1.5)
        if not {"die=0.15", "frozen=0.3"} & set(faults):  # such an arm can't be told
            time.sleep(0.1)
            still = emulator.pose()
            time.sleep(0.1)
            assert np.array_equal(emulator.pose(), still)
        arm.disconnect()


def test_an_arm_that_freezes_in_a_move_is_told_within_a_second_without_a_watch():
    with emulated("slow=0.05") as emulator:
        arm = mg400_of(emulator)
        arm.connect()
        arm.enable()
        frozen_s = []

        def freeze():
            frozen_s.append(time.monotonic())
            emulator.faults.add("frozen=0")

        threading.Timer(0.2, freeze).start()
        with pytest.raises(DeviceError, match="Press its emergency stop"):
            arm.move_linear(AWAY)
        took_s = time.monotonic() - frozen_s[0]
        assert took_s < 1.25  # 0.96 and what a busy machine adds
        arm.disconnect()


def test_the_list_above_is_complete():
    assert tried_in(test_these_end_in_an_error_with_a_remedy_and_the_arm_stands_still, *HARMLESS) == set(FAULTS)


def test_a_short_move_with_a_turn_turns_as_fast_as_told():
    with emulated() as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.set_speed(20.0, 60.0)
        start = arm.state().pose
        begun_s = time.monotonic()
        arm.move_linear(start + [1.0, 0, 0, 0, 0, 12.0])
        piece = emulator.arm.track.target()
        assert piece.duration_s == pytest.approx(12.0 / 60.0, rel=0.1)  # at the 2 % of 20 mm/s it would take 2 s
        assert time.monotonic() - begun_s < 2.0
        arm.move_linear(start + [6.0, 0, 0, 0, 0, 12.0])  # no turn: as fast as lines are
        assert emulator.arm.track.target().duration_s == pytest.approx(5.0 / 20.0, rel=0.1)


def test_an_unknown_fault_names_the_near_one():
    with pytest.raises(TwinError, match="did you mean collision"):
        emulated("colision")
    with pytest.raises(TwinError, match="not a number"):
        emulated("slow=fast")


def test_recovery_from_an_emergency_stop():
    with emulated(time_scale=4.0) as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.set_speed_percent(linear=SLOW_SHARE_PERCENT)
        arm.move_linear(AWAY, wait=False)
        emulator.arm.press_emergency_stop()
        with pytest.raises(DeviceError, match="alarm 85"):
            arm.wait_settled(AWAY)
        assert "alarm 85" in arm.state().error
        with pytest.raises(DeviceError, match="clear_error"):
            arm.enable()
        stopped = emulator.pose()
        arm.clear_error()
        assert not arm.state().enabled  # ClearError alone does not bring it back
        arm.enable()
        time.sleep(0.1)
        assert np.array_equal(emulator.pose(), stopped)  # nothing of the old queue goes on
        arm.set_speed_percent(linear=100)
        arm.move_linear(AWAY)


def test_an_arm_that_will_not_stop_is_switched_off():
    def refuse(request):
        raise RefusedError(-1)

    with emulated() as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.set_speed_percent(linear=SLOW_SHARE_PERCENT)
        arm.move_linear(AWAY, wait=False)
        emulator._commands.dashboard["resetrobot"] = refuse
        with pytest.raises(DeviceError, match="did not stop, so its emergency stop was used"):
            arm.stop()
        stopped = emulator.pose()
        time.sleep(0.1)
        assert np.array_equal(emulator.pose(), stopped) and "alarm 85" in arm.state().error and not emulator.arm.enabled


@pytest.mark.parametrize("text", ["ServoJ(0,10,50,0)", "ServoP(300,0,0,0)", "NoSuchThing()"])
def test_there_is_no_such_command_and_no_streaming_of_places(text):
    with emulated() as emulator:
        for number in (29999, 30003):
            port = CommandPort("mg400", "127.0.0.1", emulator.ports[number])
            port.open()
            assert port.request(text).error_id == -10000
            port.close()


def test_recovery_from_a_collision():
    with emulated("collision", time_scale=4.0) as emulator, mg400_of(emulator) as arm:
        arm.enable()
        with pytest.raises(DeviceError, match="alarm 112.*alarm -2"):
            arm.move_linear(AWAY)
        emulator.faults.clear()
        arm.clear_error()
        arm.enable()
        assert np.allclose(arm.move_linear(AWAY), AWAY)


def test_feedback_that_falls_silent_is_stale_after_a_second_and_comes_back():
    with emulated("silent-feedback=0.3") as emulator, mg400_of(emulator) as arm:
        arm.enable()
        told = arm.state()
        time.sleep(1.3)
        emulator.faults.clear()
        with pytest.raises(StaleDataError, match="Don't trust the last pose"):
            arm.state()
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            try:
                assert arm.state().time_s > told.time_s
                break
            except StaleDataError:
                time.sleep(0.05)
        arm.move_linear(AWAY)


def test_a_slow_reader_gets_the_newest_pose():
    with emulated(time_scale=4.0) as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.move_linear(AWAY, wait=False)
        time.sleep(1.0)  # 125 packets later
        state = arm.state()
        assert time.monotonic() - state.time_s < 0.4 and np.allclose(state.pose, AWAY, atol=0.01)


def test_a_backlog_is_read_through_to_its_end():
    """Bytes that wait in the socket are all read before any is believed."""
    packets = np.zeros(50, PACKET)
    packets["length"], packets["test_value"], packets["unix_ms"] = PACKET_BYTES, TEST_VALUE, np.arange(50)
    packet, rest = newest_packet(packets.tobytes() + packets[:1].tobytes()[:700])
    assert packet["unix_ms"] == 49 and len(rest) == 700


def test_unknown_targets_alarm_in_the_arm_if_the_driver_lets_them_through():
    blind = replace(motion.MG400, limits_deg=((-360, 360),) * 4, linkage_deg=None)
    with emulated(time_scale=4.0) as emulator, mg400_of(emulator, kinematics=blind) as arm:
        arm.enable()
        with pytest.raises(DeviceError, match="alarm 18"):
            arm.move_linear([160.0, 0, -100, 0, 0, 0])


def test_an_arm_that_another_client_paused_is_no_arm_at_rest():
    with emulated(time_scale=4.0) as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.move_linear(AWAY, wait=False)
        emulator.arm.pause()
        time.sleep(0.3)  # until the feedback tells
        assert "paused" in arm.state().error
        arm.stop()
        time.sleep(0.3)
        assert not arm.state().error


def test_several_clients_in_turn_and_at_once():
    with emulated(time_scale=4.0) as emulator:
        for _ in range(3):
            with mg400_of(emulator) as arm:
                arm.enable()
                arm.move_linear(AWAY)
        with mg400_of(emulator) as first, mg400_of(emulator) as second:
            first.enable()
            assert second.state().enabled or first.state().enabled


def test_a_taken_port_is_an_error_with_a_remedy():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        offset = taken.getsockname()[1] - 29999
        with pytest.raises(TwinError, match="`port_offset`"):
            Mg400Emulator(port_offset=offset).start()


def test_a_lost_arm_can_not_be_stopped_and_that_is_said_loudly():
    with emulated() as emulator:
        arm = mg400_of(emulator)
        arm.connect()
        emulator.kill()
        with pytest.raises(DeviceNotConnectedError):
            arm.enable()
        with pytest.raises(DeviceNotConnectedError, match="Press its emergency stop"):
            arm.stop()
        arm.disconnect()


def test_after_a_lost_connection_it_connects_again_and_reads_once():
    others = set(threading.enumerate())
    with emulated(time_scale=4.0) as emulator:
        arm = mg400_of(emulator)
        arm.connect()
        arm.enable()
        arm._motion.close()
        assert not arm.is_connected
        arm.stop()  # the dashboard is still there
        arm.connect()
        arm.enable()
        arm.move_linear(AWAY)
        assert sum(thread.name == "mg400-feedback" for thread in set(threading.enumerate()) - others) == 1
        arm.disconnect()


def test_a_reader_that_ends_late_does_not_live_on():
    """A reader that was connecting again when it was told to end must end, though another one has begun."""
    others = set(threading.enumerate())
    with emulated() as emulator:
        feedback = Feedback("arm", "127.0.0.1", (emulator.ports[30004],))
        connect, slow = feedback._connect, threading.Event()

        def slowly():
            slow.wait(5.0)
            return connect()

        feedback.open()
        feedback._connect = slowly
        emulator.faults.add("silent-feedback=0")
        time.sleep(2.0)  # silence is noticed, the reader connects again
        first = feedback._thread
        feedback._thread = None  # as after a join that took too long
        feedback.close()
        emulator.faults.clear()
        feedback._connect = connect
        feedback.open()
        slow.set()
        first.join(timeout=5.0)
        assert not first.is_alive()
        feedback.close()
    assert not [thread for thread in set(threading.enumerate()) - others if thread.name == "mg400-feedback"]


def assert_stands(emulator, *, within_s=0.3):
    """The arm itself, not what the driver believes of it."""
    time.sleep(within_s)
    still = emulator.pose()
    time.sleep(0.1)
    assert np.array_equal(emulator.pose(), still) and not emulator.arm.busy()


@pytest.mark.parametrize("wait", [True, False])
def test_a_move_whose_reply_is_lost_is_stopped(wait):
    with emulated() as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.move_linear(HOME)
        arm.set_speed(20.0, 60.0)
        emulator.faults.add("no-move-reply")
        begun_s = time.monotonic()
        with pytest.raises(DeviceError, match="no reply to MovL"):
            arm.move_linear(HOME + [0, 100, 0, 0, 0, 0], wait=wait)
        assert time.monotonic() - begun_s < 2.0
        assert_stands(emulator)
        assert emulator.pose()[1] < 40.0
        emulator.faults.clear()
        arm.set_speed(1000.0, 300.0)
        arm.move_linear(AWAY)  # no late reply is taken for that of a new move
        assert np.allclose(emulator.pose(), AWAY, atol=0.01)


@pytest.mark.parametrize("target", [[900.0, 0, 0, 0, 0, 0], HOME * np.nan, HOME[:3]], ids=["reach", "nan", "shape"])
def test_a_move_that_is_refused_ends_the_one_before_it(target):
    with emulated() as emulator, mg400_of(emulator) as arm:
        arm.enable()
        arm.set_speed(20.0, 60.0)
        arm.move_linear(AWAY, wait=False)
        with pytest.raises((DeviceError, ValueError)):
            arm.move_linear(np.array(target), wait=False)
        assert_stands(emulator)


@pytest.mark.parametrize("broken", ["move", "wait", "joints", "outside"])
def test_whatever_a_safe_arm_raises_it_stands(broken):
    with emulated() as emulator:
        arm = SafeArm(mg400_of(emulator), load_limits("mg400"))
        with arm:
            arm.enable()
            arm.set_speed(20.0, 60.0)
            arm.move_linear(HOME + [0, 80, 0, 0, 0, 0], wait=False)
            if broken == "move":
                emulator.faults.add("no-move-reply")
            with pytest.raises(DeviceError):
                if broken == "wait":
                    arm.wait_settled(AWAY, timeout_s=0.2)
                elif broken == "joints":
                    arm.move_joints(np.array([0.0, 89, 0, 0]))
                else:
                    arm.move_linear(HOME + [0, 60.0 if broken == "move" else 500.0, 0, 0, 0, 0], wait=False)
            assert_stands(emulator)


def test_leaving_a_safe_arm_stops_what_goes_on():
    with emulated() as emulator:
        with SafeArm(mg400_of(emulator), load_limits("mg400")) as arm:
            arm.enable()
            arm.set_speed(20.0, 60.0)
            arm.move_linear(AWAY, wait=False)
        assert_stands(emulator)


def test_a_stop_that_fails_on_leaving_is_said():
    with emulated() as emulator:
        begun_s = None
        with (
            pytest.raises(DeviceError, match="may move. Press its emergency stop"),
            SafeArm(mg400_of(emulator), load_limits("mg400")) as arm,
        ):
            arm.enable()
            arm.set_speed(20.0, 60.0)
            arm.move_linear(AWAY, wait=False)
            emulator.faults.add("frozen=0")
            begun_s = time.monotonic()
        assert time.monotonic() - begun_s < 2.0


# Joints (J1 to J4, deg) beyond each limit, and the alarm of each.
BEYOND = [
    ((170, 20, 40, 0), 64),
    ((-170, 20, 40, 0), 65),
    ((0, 86, 100, 0), 66),
    ((0, -26, 20, 0), 67),
    ((0, 60, 106, 0), 68),
    ((0, 0, -26, 0), 69),
    ((0, 20, 40, 185), 70),
    ((0, 20, 40, -185), 71),
    ((0, 0, 61, 0), 72),
]


@pytest.mark.parametrize(("joints", "alarm"), BEYOND)
def test_each_joint_limit_is_one_alarm_in_digits(joints, alarm):
    """What a client reads in the reply is that alarm and no other number."""
    with emulated(time_scale=20.0) as emulator:
        replies = {}
        for number, text in ((29999, "EnableRobot()"), (30003, f"JointMovJ({','.join(map(str, joints))})"), (29999, "GetErrorID()")):
            with socket.create_connection(("127.0.0.1", emulator.ports[number]), timeout=5) as connection:
                connection.sendall(text.encode())
                replies[text] = connection.recv(1024).decode()
        assert replies["GetErrorID()"] == f"0,{{[[{alarm}],[],[],[],[]]}},GetErrorID();"
        with mg400_of(emulator) as arm:
            error = arm.state().error
            assert f"alarm {alarm}" in error and error.count("alarm") == 1


def test_the_driver_takes_only_whole_numbers_for_alarms():
    reply, _ = take_reply("0,{[[np.int64(70), 18],[],[-2]]},GetErrorID();")
    assert reply.alarms() == [18, -2]


def test_a_command_that_fails_in_the_emulator_is_refused_and_reported(caplog):
    def fail(request):
        raise ZeroDivisionError("a defect")

    with emulated() as emulator, mg400_of(emulator) as arm:
        emulator._commands.dashboard["speedl"] = fail
        with pytest.raises(DeviceError, match="refused SpeedL"):
            arm.set_speed(10, 10)
        arm.enable()  # it goes on answering
    assert "a defect" in caplog.text and "SpeedL" in caplog.text


def test_two_clients_that_disable_each_other_are_told(caplog):
    with emulated(time_scale=4.0) as emulator, mg400_of(emulator) as first:
        first.enable()
        assert "another program" not in caplog.text
        with mg400_of(emulator) as watcher:
            watcher.state()
        assert first.state().enabled  # who only watches does not switch it off
        with mg400_of(emulator) as second:
            second.enable()
            assert "enabled already, so another program may use it" in caplog.text
        deadline = time.monotonic() + 1.0
        while first.state().enabled:
            assert time.monotonic() < deadline
        assert "disabled by another program" in first.state().error
        with pytest.raises(DeviceError, match="disabled by another program"):
            first.move_linear(AWAY)
        first.enable()
        first.move_linear(AWAY)
        first.disable()
        assert not first.state().error


def test_the_default_ports_are_the_arms():
    assert Mg400Ports() == Mg400Ports(29999, 30003, (30004, 30005))


@pytest.mark.parametrize("told", [np.nan, np.inf, 1e300])
def test_a_pose_that_can_not_be_is_no_pose(monkeypatch, told):
    """It is told as feedback that does not come, and the arm is stopped."""

    def packet(arm):
        made = feedback_packet(arm)
        if broken.is_set():
            made["tool_actual"] = told
        return made

    broken = threading.Event()
    monkeypatch.setattr("hardware.emulators.mg400.feedback_packet", packet)
    with emulated() as emulator, SafeArm(mg400_of(emulator), load_limits("mg400")) as arm:
        arm.enable()
        arm.set_speed(20.0, 20.0)
        arm.move_linear(AWAY, wait=False)
        broken.set()
        time.sleep(0.1)
        begun_s = time.monotonic()
        with pytest.raises(DeviceError, match="which no arm reaches"):
            arm.move_linear(HOME)
        assert time.monotonic() - begun_s < 1.0
        stands = emulator.pose()
        time.sleep(0.1)
        assert np.allclose(emulator.pose(), stands)
