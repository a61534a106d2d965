"""What answers on an MG400's ports and is none, or is only alike: the driver says what came, and uses what can be used."""

import re
import socket
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from arms import mg400_of

from hardware.arms.mg400 import MG400, MOTION_REPLY_S, Mg400Ports
from hardware.arms.mg400_wire import TEST_VALUE, newest_packet
from hardware.arms.open_arm import open_arm
from hardware.emulators.mg400 import Mg400Emulator, feedback_packet
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError


@contextmanager
def served(answer):
    """Ports of a server that calls ``answer(connection)`` for each connection."""
    ended, listeners = threading.Event(), [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]

    def run(listener):
        while not ended.is_set():
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=one, args=(connection,), daemon=True).start()

    def one(connection):
        with connection:
            try:
                answer(connection)
            except OSError:
                return

    for listener in listeners:
        threading.Thread(target=run, args=(listener,), daemon=True).start()
    dashboard, motion, feedback = (listener.getsockname()[1] for listener in listeners)
    try:
        yield Mg400Ports(dashboard, motion, (feedback,))
    finally:
        ended.set()
        for listener in listeners:
            listener.shutdown(socket.SHUT_RDWR)
            listener.close()


def http(connection):
    if connection.recv(1024):
        connection.sendall(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n")


def talks_first(connection):
    connection.sendall(b"SSH-2.0-OpenSSH_9.2p1\r\n")
    time.sleep(3.0)


def hangs_up(connection):
    pass


def other_packets(connection):
    while True:
        connection.sendall(bytes(range(256)) * 4)
        time.sleep(0.01)


def silent(connection):
    time.sleep(3.0)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (http, "nothing came|HTTP/1.1 400"),
        (talks_first, "SSH-2.0-OpenSSH_9.2p1.*no MG400"),
        (hangs_up, "closed the connection at once: another program"),
        (other_packets, "bytes that begin with .*Check the address"),
        (silent, "nothing came.*close other programs"),
    ],
)
def test_what_is_no_arm_is_said(answer, said):
    with served(answer) as ports:
        arm = MG400("127.0.0.1", ports=ports)
        with pytest.raises(DeviceNotConnectedError) as raised:
            arm.connect()
        assert re.search(said, str(raised.value)), raised.value
        assert not arm.is_connected


def test_what_a_wrong_server_replies_is_quoted():
    with Mg400Emulator(port_offset=None) as emulator, served(http) as ports:
        arm = MG400("127.0.0.1", ports=Mg400Ports(ports.dashboard, ports.motion, (emulator.ports[30004],)))
        with pytest.raises(DeviceError, match="HTTP/1.1 400"):
            arm.connect()


def test_a_second_client_is_told_that_there_is_another():
    with Mg400Emulator(port_offset=None, faults=("one-client",)) as emulator, mg400_of(emulator), pytest.raises(DeviceError) as raised:
        mg400_of(emulator).connect()
    assert "nother program" in str(raised.value)


class Alike(Mg400Emulator):
    """A foreign emulator: no test value, no answer to GetPose and Sync, and only the mode tells that it is enabled or moves."""

    def _packet(self, count):
        packet = feedback_packet(self.arm)
        packet["test_value"] = packet["enabled"] = packet["running"] = 0
        if self.arm.mode() == 7:
            packet["mode"] = 5
        return packet.tobytes()

    def _answer(self, client, port, request):
        if request.name not in ("getpose", "sync", "syncall"):
            super()._answer(client, port, request)


def test_an_arm_that_is_only_alike_is_used_with_the_lenient_mode():
    with Alike(port_offset=None, time_scale=4.0) as emulator:
        with pytest.raises(DeviceNotConnectedError, match="test value is 0x0 instead of 0x123456789abcdef.*mg400-lenient"):
            mg400_of(emulator).connect()
        with mg400_of(emulator, lenient=True) as arm:
            arm.enable()
            assert arm.state().enabled
            for y in (60.0, -60.0, 0.0):
                target = np.array([300.0, y, -10, 0, 0, 30])
                arm.move_linear(target)
                assert np.allclose(emulator.pose(), target, atol=0.05)
            arm.set_speed(20.0, 60.0)
            arm.move_linear(target + [0, 80, 0, 0, 0, 0], wait=False)
            time.sleep(0.2)
            assert arm.state().moving
            arm.stop()
            arm.move_joints(np.array([5.0, 20, 40, 0]))
            arm.disable()
            assert not arm.state().enabled


class Mock(Alike):
    """As HarvestX/MG400_Mock: a few commands, no reply to moves, and a dashboard that hangs up on other commands."""

    KNOWN = ("enablerobot", "disablerobot", "clearerror", "resetrobot", "geterrorid", "speedfactor", "user", "tool", "speedj", "speedl")

    def _answer(self, client, port, request):
        if port == 30003:
            self._execute(port, request)
        elif request.name in self.KNOWN:
            super()._answer(client, port, request)
        else:
            client.shutdown(socket.SHUT_RDWR)


def test_the_public_mock_works_in_the_lenient_mode_and_the_error_says_so():
    with Mock(port_offset=None, time_scale=4.0) as emulator:
        with pytest.raises(DeviceNotConnectedError, match="mg400-lenient"):
            mg400_of(emulator).connect()
        with mg400_of(emulator, lenient=True) as arm:
            arm.clear_error()
            arm.enable()
            arm.set_speed(100.0, 90.0)
            for y in (30.0, -30.0, 0.0):
                target = np.array([300.0, y, -10, 0, 0, 30])
                arm.move_linear(target)
                assert np.allclose(emulator.pose(), target, atol=0.05)
            begun_s = time.monotonic()
            for y in range(10):  # only the first move waits for a reply
                arm.move_linear(np.array([300.0, y, -10, 0, 0, 30]), wait=False)
            assert time.monotonic() - begun_s < MOTION_REPLY_S
            arm.stop()
            arm.disable()
            assert not arm.state().enabled


def test_a_silent_arm_stops_the_lenient_mode_too():
    with Mg400Emulator(port_offset=None, faults=("no-move-reply",)) as emulator, mg400_of(emulator, lenient=True) as arm:
        arm.enable()
        emulator.faults.add("frozen=0")
        with pytest.raises(StaleDataError, match="no feedback"):
            arm.move_linear(np.array([300.0, 0, 0, 0, 0, 10]))


def test_echoes_of_moves_that_nobody_reads_do_not_stop_the_lenient_emulator():
    """The connection has room for a few thousand of them; here it has less."""
    with Mg400Emulator(port_offset=None, lenient=True, time_scale=50.0) as emulator, mg400_of(emulator) as arm:
        arm._motion._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        for client in emulator._servers[30003].clients:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2048)
        arm.enable()
        for n in range(1000):
            arm.move_linear(np.array([300.0, n % 2, 0, 0, 0, 10]), wait=False)
        arm.move_linear(np.array([300.0, 5.0, 0, 0, 0, 10]), timeout_s=30.0)
        assert np.allclose(emulator.pose()[:2], [300.0, 5.0], atol=0.05)


def test_the_lenient_mode_by_its_name():
    assert open_arm("mg400-lenient:127.0.0.1")._lenient and not open_arm("mg400:127.0.0.1")._lenient


def test_packets_without_a_test_value_are_framed_by_their_length():
    with Mg400Emulator(port_offset=None) as emulator:
        packet = feedback_packet(emulator.arm)
    packet["test_value"] = 7
    data = packet.tobytes()
    found, rest = newest_packet(b"\x00\x05" + data[:700] + data * 3 + data[:9], lenient=True)
    assert found["test_value"] == 7 and rest == data[:9]
    assert newest_packet(data * 2)[0] is None and TEST_VALUE != 7
