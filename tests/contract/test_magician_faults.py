"""Whatever a Magician's line does wrong, the driver recovers, or stops it and says what to do."""

import itertools
import os
import pty
import select
import struct
import threading
import time
import tty

import numpy as np
import pytest
import serial
from tried_faults import tried_in

from hardware.arms.magician import BAUD, QUEUED, WRITE, Id, Magician, Message, Ptp, take_message
from hardware.emulators.magician import FAULTS, MagicianEmulator
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError
from twin.errors import TwinError

AWAY = np.array([200.0, 20, 30, 0, 0, 20])
HARMLESS = ("noise=7", "split-frames=0.01", "wrong-checksum=5", "lost-reply=5", "wide-queue-space")


def go(arm, *, timeout_s=10.0):
    arm.connect()
    arm.enable()
    arm.move_linear(AWAY, timeout_s=timeout_s)


@pytest.mark.parametrize("fault", HARMLESS)
def test_these_disturb_nothing(fault):
    with MagicianEmulator(faults=(fault,), time_scale=4.0) as emulator, Magician(emulator.device) as arm:
        arm.enable()
        arm.move_linear(AWAY)
        assert np.allclose(emulator.pose(), AWAY, atol=0.01)


@pytest.mark.parametrize(
    ("faults", "remedy"),
    [
        (("mute",), "switch the arm on"),
        (("lost-steps",), "home it"),
        (("stall",), "more time"),
        (("ignore-moves",), "not executed"),
        (("slow=0.01",), "more time"),
        (("unplugged=0.2", "slow=0.01"), "Plug the cable in"),
    ],
)
def test_these_end_in_an_error_with_a_remedy_and_the_arm_stands_still(faults, remedy):
    with MagicianEmulator(faults=faults) as emulator:
        arm = Magician(emulator.device)
        with pytest.raises(DeviceError, match=remedy):
            go(arm, timeout_s=0.8)
        if "unplugged=0.2" in faults:
            assert not arm.is_connected
        else:  # an arm that is out of reach goes on: that is what the error says
            still = emulator.pose()
            time.sleep(0.1)
            assert np.array_equal(emulator.pose(), still)
        arm.disconnect()


def test_the_list_above_is_complete():
    assert tried_in(test_these_end_in_an_error_with_a_remedy_and_the_arm_stands_still, *HARMLESS) == set(FAULTS)


def test_an_alarm_is_told_cleared_and_the_arm_goes_on():
    with MagicianEmulator(faults=("lost-steps",), time_scale=4.0) as emulator, Magician(emulator.device) as arm:
        arm.enable()
        with pytest.raises(DeviceError, match="alarm 80"):
            arm.move_linear(AWAY)
        with pytest.raises(DeviceError, match="alarm 80"):
            arm.enable()
        emulator.faults.clear()
        arm.clear_error()
        arm.move_linear(AWAY)


def test_an_arm_that_falls_silent_is_stale():
    with MagicianEmulator() as emulator, Magician(emulator.device) as arm:
        arm.enable()
        emulator.faults.add("mute")
        with pytest.raises(StaleDataError, match="Don't trust the last pose"):
            arm.state()
        emulator.faults.clear()


def test_an_arm_whose_replies_are_mostly_lost_is_stale_within_a_second(monkeypatch):
    count = itertools.count()
    with MagicianEmulator() as emulator, Magician(emulator.device) as arm:
        arm.enable()
        monkeypatch.setattr(emulator.faults, "every", lambda fault, _: fault == "lost-reply" and next(count) % 4 != 3)
        begun_s = time.monotonic()
        with pytest.raises(StaleDataError):
            arm.state()
        assert time.monotonic() - begun_s < 1.0
        monkeypatch.undo()


def test_plugged_in_again_it_connects_again(tmp_path):
    link = tmp_path / "arm"
    arm = Magician(str(link))
    with MagicianEmulator(link=link):
        arm.connect()
    with pytest.raises(DeviceNotConnectedError):
        arm.enable()
    with MagicianEmulator(link=link, time_scale=4.0):
        arm.connect()
        arm.enable()
        arm.move_linear(AWAY)
        arm.disconnect()
    assert not link.exists()


def test_homing_ends_at_home_with_its_tool():
    with MagicianEmulator(time_scale=20.0) as emulator:
        arm = Magician(emulator.device, tool_x_mm=50.0)
        arm.connect()
        arm.enable()
        arm.move_linear([260.0, 10, 20, 0, 0, 0])
        arm.home()
        assert np.allclose(arm.state().pose, [200, 0, 0, 0, 0, 0], atol=0.01)
        arm.disconnect()


def test_a_link_that_can_not_be_made_is_one_clear_error(tmp_path):
    (tmp_path / "arm").write_text("mine")
    with pytest.raises(TwinError, match="`link`"):
        MagicianEmulator(link=tmp_path / "arm").start()
    assert (tmp_path / "arm").read_text() == "mine"


# Joints (J1 to J4, deg) beyond each limit, and the alarm of each.
BEYOND = [
    ((130, 45, 45, 0), 64),
    ((-130, 45, 45, 0), 65),
    ((0, 91, 45, 0), 66),
    ((0, -6, 45, 0), 67),
    ((0, 45, 71, 0), 68),
    ((0, 45, -16, 0), 69),
    ((0, 45, 45, 151), 70),
    ((0, 45, 45, -151), 71),
]


def ask(emulator, id, params=b"", ctrl=0):
    """One command as any client sends it; None where no reply comes."""
    with serial.Serial(emulator.device, BAUD, timeout=0.5) as port:
        port.write(Message(id, ctrl, params).to_bytes())
        data = b""
        while (message := take_message(data)[0]) is None:
            new = port.read(1)
            if not new:
                return None
            data += new
        return message


@pytest.mark.parametrize(("joints", "alarm"), BEYOND)
def test_each_joint_limit_is_an_alarm_and_the_emulator_goes_on(joints, alarm):
    with MagicianEmulator() as emulator:
        ask(emulator, Id.QUEUE_START, ctrl=WRITE)
        assert ask(emulator, Id.PTP, struct.pack("<B4f", Ptp.MOVJ_ANGLE, *joints), WRITE | QUEUED).params == struct.pack("<Q", 1)
        told = int.from_bytes(ask(emulator, Id.ALARMS).params, "little")
        assert told == 1 << alarm
        assert len(ask(emulator, Id.GET_POSE).params) == 32


def test_a_command_that_fails_in_the_emulator_is_an_alarm_and_reported(monkeypatch, caplog):
    with MagicianEmulator() as emulator:
        monkeypatch.setattr(emulator.arm, "_ptp", lambda *_: 1 / 0)
        ask(emulator, Id.QUEUE_START, ctrl=WRITE)
        assert ask(emulator, Id.PTP, struct.pack("<B4f", Ptp.MOVJ_ANGLE, 0, 45, 45, 0), WRITE | QUEUED) is not None
        assert int.from_bytes(ask(emulator, Id.ALARMS).params, "little") == 1 << 1
    assert "division" in caplog.text


def pose_of(emulator):
    return struct.unpack("<8f", ask(emulator, Id.GET_POSE).params)


def test_the_queue_refuses_when_it_is_full():
    with MagicianEmulator(time_scale=20.0) as emulator, Magician(emulator.device) as arm:
        arm.enable()
        arm._request(Id.QUEUE_STOP, ctrl=WRITE)
        for n in range(32):
            arm.move_linear(AWAY + [0, n % 2, 0, 0, 0, 0], wait=False)
        with pytest.raises(DeviceError, match="queue is full"):
            arm.move_linear(AWAY, wait=False)
        arm.move_linear(AWAY)  # the refusal stopped the arm and emptied the queue


def test_an_arc_goes_through_its_places_and_a_line_is_none():
    with MagicianEmulator(time_scale=4.0) as emulator:
        ask(emulator, Id.QUEUE_START, ctrl=WRITE)
        here = pose_of(emulator)[:4]
        via, end = (here[0] + 20, here[1] + 20, here[2], here[3]), (here[0] + 40, here[1], here[2], here[3] + 10)
        ask(emulator, Id.ARC, struct.pack("<8f", *via, *end), WRITE | QUEUED)
        deadline, most = time.monotonic() + 5.0, 0.0
        while np.abs(np.array(pose_of(emulator)[:4]) - end).max() > 0.01:
            most = max(most, pose_of(emulator)[1])
            assert time.monotonic() < deadline
        assert most > here[1] + 10
        ask(emulator, Id.ARC, struct.pack("<8f", end[0] + 5, *end[1:], end[0] + 10, *end[1:]), WRITE | QUEUED)
        assert int.from_bytes(ask(emulator, Id.ALARMS).params, "little") == 1 << 20


@pytest.mark.parametrize(
    ("id", "write", "read", "told"),
    [
        (Id.COLOR, bytes([1, 1, 1]), bytes([1, 1, 1]), bytes(3)),
        (Id.INFRARED, bytes([1, 2]), bytes([2]), bytes(1)),
        (Id.MOTOR, struct.pack("<BBi", 0, 1, 1000), b"", b""),
        (Id.MOTOR_STEPS, struct.pack("<BBiI", 0, 1, 1000, 10), b"", b""),
    ],
)
def test_what_is_not_attached_tells_no_signal(id, write, read, told):
    with MagicianEmulator() as emulator:
        ask(emulator, Id.QUEUE_START, ctrl=WRITE)
        assert ask(emulator, id, write, WRITE | QUEUED).params == struct.pack("<Q", 1)
        assert ask(emulator, id, write, QUEUED).params == struct.pack("<Q", 2)  # as some clients send it
        assert ask(emulator, id, read).params == told
        assert not any(ask(emulator, Id.ALARMS).params)


def test_what_echoes_is_no_magician():
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    ended = threading.Event()

    def echo():
        while not ended.is_set():
            if select.select([ours], [], [], 0.05)[0]:
                os.write(ours, os.read(ours, 4096))

    thread = threading.Thread(target=echo, daemon=True)
    thread.start()
    arm = Magician(os.ttyname(theirs))
    with pytest.raises(DeviceError, match="0 bytes to command 10 instead of 32.*echoes"):
        arm.connect()
    assert not arm.is_connected
    ended.set()
    thread.join()
    os.close(ours)
    os.close(theirs)


def test_a_link_that_leads_nowhere_is_replaced_and_one_in_use_is_not(tmp_path):
    link = tmp_path / "arm"
    link.symlink_to("/dev/pts/no-such-terminal")  # as a killed emulator leaves it
    with MagicianEmulator(link=link), Magician(str(link)) as arm:
        assert arm.state().joints_deg.shape == (4,)
        with pytest.raises(TwinError, match="`link`"):
            MagicianEmulator(link=link).start()
        assert arm.state().joints_deg.shape == (4,)


def test_a_pose_that_can_not_be_is_no_pose(monkeypatch):
    with MagicianEmulator() as emulator, Magician(emulator.device) as arm:
        arm.enable()
        monkeypatch.setattr(emulator.arm.track, "pose", lambda time_s: np.full(6, np.nan))
        with pytest.raises(StaleDataError, match="which no arm reaches"):
            arm.state()
