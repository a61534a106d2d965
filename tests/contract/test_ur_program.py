"""The control program of a UR that ends, starts late, or starts again by itself: nothing moves on, and no process is left behind."""

import os
import signal
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from arms import mg400_of

from hardware.arms.open_arm import open_arm
from hardware.arms.ur.driver import IDLE, PLAYING, UR
from hardware.emulators.mg400 import Mg400Emulator
from hardware.emulators.ur import UrEmulator
from hardware.errors import DeviceError, StaleDataError

AWAY = np.array([100.0, -500, 200, 0, 0, -160])
SOON_S = 0.1


@pytest.fixture
def emulator():
    with UrEmulator(host=None) as emulator:
        yield emulator


def start_moving(arm):
    arm.enable()
    arm.set_speed(20.0, 20.0)
    arm.move_linear(arm.state().pose + [0, 0, 30, 0, 0, 0])


def failure(emulator, act=start_moving):
    """The error with which a program ends that opens the arm, and its client."""
    arm = open_arm(f"ur:{emulator.host}")
    with pytest.raises(DeviceError) as error, arm:
        client = arm._client
        act(arm)
    assert not client.is_alive
    return "; ".join((str(error.value), *getattr(error.value, "__notes__", ())))


def stands_free(emulator, within_s=SOON_S):
    """Whether the arm stands soon, with no program that could move it."""
    time.sleep(within_s)
    before, plays = emulator.pose(), emulator.arm.runtime_state == PLAYING
    time.sleep(0.1)
    return np.array_equal(emulator.pose(), before) and not plays and not emulator.arm.busy()


@pytest.mark.parametrize("fault", ["script-ends=0", "script-ends=0.02", "script-ends=0.1", "script-ends=0.3", "script-ends=0.6"])
def test_a_program_that_ends_after_its_start_leaves_nothing_behind(emulator, fault):
    emulator.faults.add(fault)
    told = failure(emulator)
    assert stands_free(emulator)
    assert "control program" in told or "call connect()" in told
    assert "Press its emergency stop" not in told  # its controller has said that the program is stopped, and it never moved


def test_a_program_may_start_late(emulator):
    emulator.faults.add("late-start=1.5")
    with open_arm(f"ur:{emulator.host}") as arm:
        start_moving(arm)
    assert stands_free(emulator)


def test_a_program_that_starts_too_late_is_ended(emulator):
    emulator.faults.add("late-start=3.3")
    assert "control program" in failure(emulator)
    assert stands_free(emulator, 1.0)


@pytest.mark.parametrize("fault", ["frozen-feedback", "no-replies", "silent", "unplug"])
def test_a_fault_as_soon_as_it_is_enabled_leaves_it_disabled(emulator, fault):
    def strike():
        while not emulator.arm.enabled:
            time.sleep(0.0005)
        emulator.unplug() if fault == "unplug" else emulator.faults.add(fault)

    thread = threading.Thread(target=strike, daemon=True)
    thread.start()
    told = failure(emulator)
    thread.join()
    assert stands_free(emulator)
    assert "ended at once" not in told


def test_ctrl_c_while_it_is_enabled_leaves_it_disabled(emulator):
    emulator.faults.add("late-start=0.5")
    main = threading.main_thread().ident
    threading.Timer(0.7, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
    arm = open_arm(f"ur:{emulator.host}")
    with pytest.raises(KeyboardInterrupt), arm:
        client = arm._client
        arm.enable()
        time.sleep(1.0)
    assert not client.is_alive and stands_free(emulator)


def test_ctrl_c_during_a_request_does_not_shift_the_answers(emulator):
    with open_arm(f"ur:{emulator.host}") as arm:
        arm.enable()
        ask = arm._client._answers.get
        arm._client._answers.get = lambda **_: (_ for _ in ()).throw(KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            arm._client.ask("getStepTime", timeout_s=1.0)
        arm._client._answers.get = ask
        assert arm._client.ask("isProgramRunning", timeout_s=1.0) is True


def test_ctrl_c_while_it_connects_leaves_no_process(emulator, monkeypatch):
    from hardware.arms.ur import client

    started = []
    popen = client.subprocess.Popen
    monkeypatch.setattr(client.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1])
    monkeypatch.setattr(client.ClientProcess, "_answer", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        open_arm(f"ur:{emulator.host}").connect()
    assert started and all(process.poll() is not None for process in started)


def test_a_program_that_the_client_starts_again_by_itself_moves_nothing(emulator):
    """``ur_rtde`` reconnects and uploads its program again, without the watchdog."""
    arm = open_arm(f"ur:{emulator.host}")
    with pytest.raises(DeviceError), arm:
        start_moving(arm)
        process = arm._client._process
        emulator._owner.shutdown(socket.SHUT_RDWR)
        time.sleep(1.5)
        assert not arm.is_connected or not arm.state().enabled
        try:
            arm.move_linear(arm.state().pose + [0, 0, 60, 0, 0, 0], wait=False)
        finally:
            process.kill()
            time.sleep(1.0)
            moves = emulator.arm.busy()
    assert not moves and not emulator.arm.busy()


def test_a_link_that_is_lost_during_a_request_ends_the_client(emulator):
    emulator.faults.add("late-start=1.5")
    arm = open_arm(f"ur:{emulator.host}")
    with pytest.raises(DeviceError), arm:
        client = arm._client
        threading.Timer(0.5, emulator.unplug).start()
        arm.enable()
    assert not client.is_alive
    emulator.arm.end_program()


def test_an_emergency_stop_needs_no_client(emulator):
    arm = open_arm(f"ur:{emulator.host}")
    arm.connect()
    arm.enable()
    os.kill(arm._client._process.pid, signal.SIGSTOP)
    with pytest.raises(DeviceError, match="Press its emergency stop"):  # which can't be seen
        arm.emergency_stop()
    assert emulator.arm.robot_mode < IDLE
    arm.disconnect()


def test_a_program_is_ended_over_the_dashboard_if_the_client_has_died(emulator):
    def lose_the_client(arm):
        arm.enable()
        arm.set_speed(20.0, 20.0)
        arm.move_linear(arm.state().pose + [0, 0, 30, 0, 0, 0], wait=False)
        arm._client.end()
        with pytest.raises(DeviceError, match="ended over the dashboard, so it stands"):
            arm.stop()
        assert stands_free(emulator, 0.0)
        raise DeviceError("it is lost")

    assert "Press its emergency stop" not in failure(emulator, lose_the_client)


def test_an_arm_of_which_nothing_has_come_so_far_is_stale():
    arm = UR("127.0.0.1")
    arm._client = SimpleNamespace(is_alive=True, feedback={})
    with pytest.raises(StaleDataError, match="no feedback has come so far"):
        arm.state()


def test_an_mg400_whose_enabling_fails_is_disabled(monkeypatch):
    with Mg400Emulator(port_offset=None) as emulator:
        arm = mg400_of(emulator)
        ask = arm._ask

        def lose_the_reply(request, **options):
            if request == "User(0)":
                raise DeviceError("no reply")
            return ask(request, **options)

        monkeypatch.setattr(arm, "_ask", lose_the_reply)
        with arm, pytest.raises(DeviceError, match="no reply"):
            arm.enable()
        assert not emulator.arm.enabled
