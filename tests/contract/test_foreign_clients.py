"""Clients that are not ours, against the emulators: their way of reading, and the published packages themselves."""

import os
import signal
import socket
import struct
import subprocess
import sys
import time

import pytest
from free_ports import free_offset

from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import Mg400Emulator

PACKAGES = ("pydobot", "pydobotplus", "common-robot-interface", "transforms3d")
INSTALL_TIMEOUT_S = 120


class PlainClient:
    """Reads as the vendor's and the group's MG400 clients do: one ``recv`` a reply, exactly 1440 bytes a packet."""

    def __init__(self, emulator, feedback_port):
        self.dashboard, self.motion, self.feed = (
            socket.create_connection(("127.0.0.1", emulator.ports[port]), timeout=5) for port in (29999, 30003, feedback_port)
        )

    def ask(self, connection, text):
        connection.send(text.encode())
        return connection.recv(1024).decode()

    def packet(self):
        data = b""
        while len(data) < 1440:
            data += self.feed.recv(1440 - len(data))
        assert struct.unpack_from("<q", data, 48) == (0x0123456789ABCDEF,)
        return data

    def pose(self):
        return struct.unpack_from("<4d", self.packet(), 624)

    def close(self):
        for connection in (self.dashboard, self.motion, self.feed):
            connection.close()


@pytest.mark.parametrize("feedback_port", [30004, 30005, 30006])
def test_a_client_that_waits_for_the_pose_and_one_that_waits_for_sync(feedback_port):
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        client = PlainClient(emulator, feedback_port)
        for text in ("ClearError()", "EnableRobot()", "User(0)", "Tool(0)", "SpeedL(20)"):
            assert client.ask(client.dashboard, text) == f"0,{{}},{text};"
        assert client.ask(client.motion, "Sync()") == "0,{},Sync();"
        for target in ((280.0, 40.0, -20.0, 30.0), (250.0, -20.0, 0.0, 0.0)):
            text = "MovL({:f},{:f},{:f},{:f})".format(*target)
            assert client.ask(client.motion, text) == f"0,{{}},{text};"
            deadline = time.monotonic() + 5
            while max(abs(a - b) for a, b in zip(client.pose(), target, strict=True)) > 0.1:
                assert time.monotonic() < deadline
        assert client.ask(client.motion, "JointMovJ(0.000000,10.000000,50.000000,0.000000)").startswith("0,{}")
        assert client.ask(client.motion, "Sync()") == "0,{},Sync();"
        assert client.ask(client.dashboard, "continue()") == "0,{},continue();"  # the vendor's spelling
        assert client.ask(client.dashboard, "ServoP(1,2,3,4)") == "-10000,{},ServoP(1,2,3,4);"  # there is none on the MG400
        assert client.ask(client.motion, "ServoJ(1,2,3,4)") == "-10000,{},ServoJ(1,2,3,4);"
        client.packet()
        # the queue runs and the arm is enabled: what the vendor's client looks at before it sends Continue()
        assert struct.unpack_from("<b", client.packet(), 1014) == (1,) and struct.unpack_from("<b", client.packet(), 1026) == (1,)
        assert client.ask(client.dashboard, "DisableRobot()") == "0,{},DisableRobot();"
        client.close()


def test_an_alarm_as_the_vendors_client_deals_with_it():
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        client = PlainClient(emulator, 30004)
        client.ask(client.dashboard, "EnableRobot()")
        client.ask(client.motion, "MovL(250,0,0,0,SpeedL=1)")
        client.ask(client.motion, "MovL(900,0,0,0)")  # accepted; the alarm comes when it is its turn
        client.ask(client.motion, "MovL(260,0,0,0)")
        assert struct.unpack_from("<b", client.packet(), 1029) == (0,)
        deadline = time.monotonic() + 10
        while struct.unpack_from("<b", client.packet(), 1029) == (0,):
            assert time.monotonic() < deadline
        assert client.ask(client.dashboard, "GetErrorID()") == "0,{[[17],[],[],[],[]]},GetErrorID();"
        assert client.ask(client.dashboard, "RobotMode()") == "0,{9},RobotMode();"
        assert client.pose()[0] == pytest.approx(250, abs=0.01)
        client.ask(client.dashboard, "ClearError()")
        client.ask(client.dashboard, "Continue()")  # the rest of the queue is done
        assert client.ask(client.motion, "Sync()") == "0,{},Sync();"
        for _ in range(3000):
            pose = client.pose()
            if abs(pose[0] - 260) < 0.01:
                break
        assert pose[0] == pytest.approx(260, abs=0.01)
        client.close()


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """The published clients of both arms, installed apart; skips where they can't be."""
    folder = tmp_path_factory.mktemp("clients")
    command = [sys.executable, "-m", "pip", "install", "-q", "--target", str(folder), *PACKAGES]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"can't install {PACKAGES}: {error}")
    if done.returncode:
        pytest.skip(f"can't install {PACKAGES}: {done.stderr.strip().splitlines()[-1:]}")
    return folder


COUNTED = """
import functools
def counted(client):
    left = {name for name, value in vars(client).items() if callable(value) and not name.startswith("__")}
    for name in sorted(left):
        def wrapped(*given, _name=name, _call=getattr(client, name), **named):
            left.discard(_name)
            return _call(*given, **named)
        static = isinstance(vars(client)[name], staticmethod)
        setattr(client, name, staticmethod(wrapped) if static else functools.wraps(getattr(client, name))(wrapped))
    return left
def refuses(error, call, *given, **named):
    try:
        call(*given, **named)
    except error:
        return
    raise AssertionError(f"{call} {given} {named} is not refused")
"""
# Every method of the client is called, the errors that it raises included.
PYDOBOT = f"""{COUNTED}
import struct, sys, warnings
import numpy as np
from pydobot import Dobot
from pydobot.enums import PTPMode
import serial
left = counted(Dobot)
refuses(serial.SerialException, Dobot, port="/nowhere")
arm = Dobot(port=sys.argv[1])
def at(*place):
    assert np.allclose(arm.pose()[:4], place, atol=0.01), (arm.pose(), place)
arm.speed(200, 200)
arm.move_to(220.0, 30.0, 20.0, 10.0, wait=True)
at(220, 30, 20, 10)
warnings.simplefilter("ignore")
arm.go(230.0, 30.0, 20.0, 10.0)
arm._set_wait_cmd(1)
for mode in PTPMode:
    target = (0, 45, 45, 0) if "ANGLE" in mode.name else (1, 1, 1, 1) if "INC" in mode.name else (220.0, 30.0, 20.0, 10.0)
    arm._set_ptp_cmd(*target, mode, True)
arm.move_to(220.0, 30.0, 20.0, 10.0, wait=True)
at(220, 30, 20, 10)
arm._set_cp_cmd(225.0, 30.0, 20.0)
arm.wait(1); arm.suck(True); arm.suck(False); arm.grip(True); arm.grip(False)
arm.set_eio(3, 1); assert arm.get_eio(3) is not None
arm._set_queued_cmd_stop_exec(); arm._set_queued_cmd_clear(); arm._set_queued_cmd_start_exec()
arm.move_to(220.0, 30.0, 20.0, 10.0, wait=True)
at(220, 30, 20, 10)
arm.move_to(100.0, 0.0, 50.0, 0.0)  # beyond a joint's range: an alarm, and the device goes on answering
at(220, 30, 20, 10)
arm.close()
assert not left, left
print("done")
"""
PYDOBOTPLUS = f"""{COUNTED}
import sys
import numpy as np
from pydobotplus import Dobot
from pydobotplus.dobotplus import MODE_PTP, CustomPosition, DobotException
left = counted(Dobot)
refuses(DobotException, Dobot, port="/nowhere")
refuses(DobotException, Dobot)
arm = Dobot(port=sys.argv[1])
def at(*place):
    assert np.allclose(arm.get_pose().position, place, atol=0.01), (arm.get_pose(), place)
arm.speed(200, 200)
arm.set_home(200.0, 0.0, 0.0)
arm.wait_for_cmd(arm.home())
at(200, 0, 0, 0)
for mode in MODE_PTP:
    target = (0, 45, 45, 0) if "ANGLE" in mode.name else (1, 1, 1, 1) if "INC" in mode.name else (220.0, 30.0, 20.0, 10.0)
    arm._set_ptp_cmd(*target, mode, True)
    assert not arm.get_alarms(), mode
arm.move_to(220.0, 30.0, 20.0, 10.0)
arm.move_to(position=CustomPosition(220.0, 30.0, 20.0, 10.0))
arm.move_to(y=30.0, r=10.0, mode=MODE_PTP.MOVL_XYZ)
at(220, 30, 20, 10)
refuses(ValueError, arm.move_to)
arm.move_rel(x=5, y=-5, z=1, r=2)
at(225, 25, 21, 12)
assert len(arm.get_pose().joints.in_radians()) == 4
arm.wait_for_cmd(arm.go_arc(245.0, 25.0, 21.0, 12.0, 235.0, 35.0, 21.0, 12.0))
at(245, 25, 21, 12)
assert not arm.get_alarms()
for jog in (arm.jog_x, arm.jog_y, arm.jog_z, arm.jog_r):
    jog(50.0); jog(-50.0); jog(0)
for call in (arm.suck, arm.grip):
    arm.wait_for_cmd(call(True)); arm.wait_for_cmd(call(False))
arm.wait_for_cmd(arm.laze(100, True)); arm.wait_for_cmd(arm.laze(0, False))
arm.set_io(5, True)
refuses(DobotException, arm.set_io, 0, True)
arm.wait_for_cmd(arm._extract_cmd_index(arm._set_cp_cmd(240.0, 25.0, 21.0)))
arm.set_hht_trig_output(True); assert arm.get_hht_trig_output() in (True, False)
arm.conveyor_belt(0.5); arm.conveyor_belt(0.5, direction=-1); arm.conveyor_belt(0.0)
refuses(DobotException, arm.conveyor_belt, 0.5, direction=7)
refuses(Exception, arm.conveyor_belt_distance, 150, 10)
arm.wait_for_cmd(arm.conveyor_belt_distance(50, 10))
arm.wait_for_cmd(arm.set_color()); assert arm.get_color() == [False, False, False]
arm.wait_for_cmd(arm.set_ir()); assert arm.get_ir() is False
arm.engrave(np.arange(48).reshape(6, 8) * 5, 0.5)  # fewer pixels never start its queue
assert not arm.get_alarms()
arm._set_queued_cmd_stop_exec()
taken = 0
try:
    while taken < 99:
        arm._extract_cmd_index(arm._set_ptp_cmd(220.0, 30.0, 20.0, 10.0, MODE_PTP.MOVL_XYZ, False)); taken += 1
except Exception as full:
    assert taken == 32, (taken, full)
arm._set_queued_cmd_clear(); arm._set_queued_cmd_start_exec()
arm._set_ptp_cmd(900.0, 30.0, 20.0, 10.0, MODE_PTP.MOVL_XYZ, False)
assert {{int(alarm) for alarm in arm.get_alarms()}} == {{17}}
arm.clear_alarms()
assert not arm.get_alarms()
arm._set_queued_cmd_clear()
arm._set_ptp_cmd(100.0, 0.0, 50.0, 0.0, MODE_PTP.MOVJ_XYZ, False)
assert 64 <= min(int(alarm) for alarm in arm.get_alarms()) <= 73
arm.clear_alarms()
arm.close()
assert not left, left
print("done")
"""


# The sensor group's own client of the MG400. Its log window is not used.
CRI = """
import sys, time, types
sys.modules.setdefault("tkinter", types.SimpleNamespace(Text=None, END=None))
import numpy as np
from cri.robot import AsyncRobot, SyncRobot
from cri.controller import MG400Controller
with AsyncRobot(SyncRobot(MG400Controller(ip=sys.argv[1]))) as robot:
    def at(*place):
        time.sleep(0.5)  # until its own reader has the newest feedback
        assert np.allclose(np.take(robot.pose, [0, 1, 2, 5]), place, atol=0.01), (robot.pose, place)
    robot.coord_frame = (300, 0, 0, 0, 0, 0)
    robot.linear_speed, robot.angular_speed, robot.speed = 100, 100, 50
    robot.move_linear((0, 0, 0, 0, 0, 0))
    at(0, 0, 0, 0)
    assert robot.speed == 50
    robot.move_joints((10, 20, 40, 0))
    time.sleep(0.5)
    assert np.allclose(robot.joint_angles, (10, 20, 40, 0))
    robot.async_move_linear((10, 20, -10, 0, 0, 30))
    robot.async_result()
    at(10, 20, -10, 30)
print("done")
"""


@pytest.mark.slow
def test_the_groups_own_client_drives_the_emulated_mg400(packages):
    with Mg400Emulator(host="127.0.0.29", time_scale=4.0):
        environment = {**os.environ, "PYTHONPATH": str(packages)}
        done = subprocess.run([sys.executable, "-c", CRI, "127.0.0.29"], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip().endswith("done"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("script", [PYDOBOT, PYDOBOTPLUS], ids=PACKAGES[:2])
def test_published_clients_drive_the_emulated_magician(packages, script):
    with MagicianEmulator(time_scale=4.0) as emulator:
        environment = {**os.environ, "PYTHONPATH": str(packages)}
        done = subprocess.run([sys.executable, "-c", script, emulator.device], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip().endswith("done"), done.stderr


def test_an_emulator_ends_on_a_signal_that_another_thread_gets():
    """Threads of numerical libraries don't block what the main thread waits for."""
    source = (
        "import threading, time, signal, contextlib; idle = threading.Thread(target=time.sleep, args=(3,), daemon=True); idle.start();"
        "from hardware.emulators.faults import Emulator;"
        "threading.Timer(0.2, lambda: signal.pthread_kill(idle.ident, signal.SIGTERM)).start();"
        "device = contextlib.nullcontext(); device.place, device.error = 'now', None; Emulator.run(device)"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=30)
    assert done.returncode == 0 and done.stdout == "ready now\n", done.stderr


def test_an_emulator_that_was_stopped_goes_on():
    """As by Ctrl-Z and ``bg``."""
    source = (
        "import contextlib; from hardware.emulators.faults import Emulator;"
        "device = contextlib.nullcontext(); device.place, device.error = '', None; Emulator.run(device)"
    )
    with subprocess.Popen([sys.executable, "-c", source], stdout=subprocess.PIPE) as process:
        try:
            process.stdout.readline()
            for _ in range(2):
                process.send_signal(signal.SIGSTOP)
                time.sleep(1.0)
                process.send_signal(signal.SIGCONT)
                time.sleep(0.2)
            assert process.poll() is None
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=10) == 0
        finally:
            process.kill()


@pytest.mark.parametrize("device", ["mg400", "magician"])
def test_twin_emulate_says_when_it_is_ready_and_ends_on_sigterm(device, tmp_path):
    link = tmp_path / "arm"
    offset = free_offset()
    options = ["--port-offset", str(offset)] if device == "mg400" else ["--link", str(link)]
    command = [sys.executable, "-c", "from twin.cli import main; main()", "emulate", device, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline().split()
            expected = (
                ["127.0.0.1", *(str(port + offset) for port in (29999, 30003, 30004, 30005, 30006))] if device == "mg400" else [str(link)]
            )
            assert line == ["ready", device, *expected]
            if device == "mg400":
                socket.create_connection(("127.0.0.1", 29999 + offset), timeout=5).close()
            else:
                assert link.is_symlink()
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=10) == 0 and process.stderr.read() == ""
        finally:
            process.kill()
    assert not link.exists()


@pytest.mark.parametrize("device", ["mg400", pytest.param("magician", marks=pytest.mark.slow)])
def test_twin_emulate_lists_its_faults(device):
    command = [sys.executable, "-c", "from twin.cli import main; main()", "emulate", device, "--fault", "help"]
    listed = subprocess.check_output(command, text=True)
    assert "slow=0.1" in listed and "ignore-moves" in listed


def test_a_client_that_waits_for_replies_does_not_hang_on_the_lenient_emulator():
    """As the vendor's client: a reply to each move, and one to ``Sync`` when the moves are done."""
    with Mg400Emulator(port_offset=None, lenient=True, time_scale=4.0) as emulator:
        client = PlainClient(emulator, 30004)
        assert client.ask(client.dashboard, "EnableRobot()") == "EnableRobot();"
        for text in ("MovL(280,40,-20,30)", "Sync()"):
            assert client.ask(client.motion, text) == f"{text};"
        assert emulator.pose()[1] == pytest.approx(40.0, abs=0.1)
        client.close()


def test_numbers_that_are_none_are_out_of_range():
    with Mg400Emulator(port_offset=None) as emulator:
        client = PlainClient(emulator, 30004)
        for text, answer in (("MovL(inf,0,0,0)", -40001), ("JointMovJ(0,-inf,0,0)", -40002), ("MovL(0,0,nan,0)", -40003)):
            assert client.ask(client.motion, text) == f"{answer},{{}},{text};"
        assert client.ask(client.dashboard, "SetUser(1,{1,2,inf,0})") == "-40002,{},SetUser(1,{1,2,inf,0});"
        client.close()


def test_an_alarm_that_came_before_a_reset_is_told_without_anyone_listening_to_the_feedback():
    with Mg400Emulator(port_offset=None) as emulator:
        dashboard, motion = (socket.create_connection(("127.0.0.1", emulator.ports[port]), timeout=5) for port in (29999, 30003))
        for connection, text in ((dashboard, "EnableRobot()"), (motion, "MovL(900,0,0,0)"), (dashboard, "ResetRobot()")):
            connection.sendall(text.encode())
            assert connection.recv(1024).startswith(b"0,")
        dashboard.sendall(b"GetErrorID()")
        assert dashboard.recv(1024).startswith(b"0,{[[17]")
        dashboard.close()
        motion.close()


def test_a_client_that_is_lost_while_it_waits_is_no_failed_command(caplog):
    """A reset connection, as of a program that was killed."""
    with Mg400Emulator(port_offset=None) as emulator:
        client = PlainClient(emulator, 30004)
        client.ask(client.dashboard, "EnableRobot()")
        client.ask(client.motion, "JointMovJ(30,20,40,0,SpeedJ=1)")
        client.motion.sendall(b"Sync()")
        time.sleep(0.1)  # until it waits
        client.motion.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.motion.close()
        deadline = time.monotonic() + 5
        while emulator._servers[30003].clients:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert client.ask(client.dashboard, "RobotMode()") == "0,{7},RobotMode();"
        client.close()
    assert not caplog.records


def test_a_lost_bracket_costs_one_command():
    with Mg400Emulator(port_offset=None) as emulator:
        client = PlainClient(emulator, 30004)
        assert client.ask(client.dashboard, "SpeedFactor(50\n") == "-10000,{},SpeedFactor(50;"
        assert client.ask(client.dashboard, "RobotMode\r\n") == "-10000,{},RobotMode;"
        assert client.ask(client.dashboard, "RobotMode()\n") == "0,{4},RobotMode();"
        assert emulator.arm.percent["speedfactor"] == 100.0
        client.close()
