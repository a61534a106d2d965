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

PACKAGES = ("pydobot", "pydobotplus")
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
    """The published clients of the Magician, installed apart; skips where they can't be."""
    folder = tmp_path_factory.mktemp("clients")
    command = [sys.executable, "-m", "pip", "install", "-q", "--target", str(folder), *PACKAGES]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"can't install {PACKAGES}: {error}")
    if done.returncode:
        pytest.skip(f"can't install {PACKAGES}: {done.stderr.strip().splitlines()[-1:]}")
    return folder


PYDOBOT = """
import sys
from pydobot import Dobot
arm = Dobot(port=sys.argv[1])
arm.speed(200, 200)
arm.move_to(220.0, 30.0, 20.0, 10.0, wait=True)
x, y, z, r, *joints = arm.pose()
assert max(abs(x - 220), abs(y - 30), abs(z - 20), abs(r - 10)) < 0.01, (x, y, z, r)
arm.wait(1); arm.suck(True); arm.grip(False)
arm.close()
print("done")
"""
PYDOBOTPLUS = """
import sys
from pydobotplus import Dobot
from pydobotplus.dobotplus import MODE_PTP
arm = Dobot(port=sys.argv[1])
arm.speed(200, 200)
arm.wait_for_cmd(arm.home())
arm._set_ptp_cmd(220.0, 30.0, 20.0, 10.0, MODE_PTP.MOVJ_XYZ, True)
pose = arm.get_pose()
assert max(abs(a - b) for a, b in zip(pose.position, (220, 30, 20, 10))) < 0.01, pose
assert not arm.get_alarms()
arm.jog_x(50.0); arm.jog_x(0)
arm._set_ptp_cmd(900.0, 30.0, 20.0, 10.0, MODE_PTP.MOVL_XYZ, False)
assert {int(alarm) for alarm in arm.get_alarms()} == {17}
arm.clear_alarms()
assert not arm.get_alarms()
arm.close()
print("done")
"""


@pytest.mark.slow
@pytest.mark.parametrize("script", [PYDOBOT, PYDOBOTPLUS], ids=PACKAGES)
def test_published_clients_drive_the_emulated_magician(packages, script):
    with MagicianEmulator(time_scale=4.0) as emulator:
        environment = {**os.environ, "PYTHONPATH": str(packages)}
        done = subprocess.run([sys.executable, "-c", script, emulator.device], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip().endswith("done"), done.stderr


def test_an_emulator_ends_on_a_signal_that_another_thread_gets():
    """Threads of numerical libraries don't block what the main thread waits for."""
    source = (
        "import threading, time, signal, contextlib; idle = threading.Thread(target=time.sleep, args=(3,), daemon=True); idle.start();"
        "from hardware.emulators.running import run_until_told;"
        "threading.Timer(0.2, lambda: signal.pthread_kill(idle.ident, signal.SIGTERM)).start();"
        "run_until_told(contextlib.nullcontext(), lambda: 'now')"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=30)
    assert done.returncode == 0 and done.stdout == "ready now\n", done.stderr


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


@pytest.mark.parametrize("device", ["mg400", "magician"])
def test_twin_emulate_lists_its_faults(device):
    command = [sys.executable, "-c", "from twin.cli import main; main()", "emulate", device, "--fault", "help"]
    listed = subprocess.check_output(command, text=True)
    assert "slow=0.1" in listed and "ignore-moves" in listed


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
