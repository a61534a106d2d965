"""A program that dies without a word (SIGKILL): a supervisor that has its connection stops and disables the arm."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from hardware.arms.supervisor import Supervisor
from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import Mg400Emulator
from hardware.emulators.ur import UrEmulator

WITHIN_S = 1.0
SLOW_MM_S = 20.0
MOVES = """
import sys, time
import numpy as np
from hardware.arms.magician import Magician
from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.arms.ur.driver import UR
kind, *at = sys.argv[1:]
if kind == "mg400":
    ports = [int(port) for port in at]
    arm, away = MG400("127.0.0.1", ports=Mg400Ports(ports[0], ports[1], tuple(ports[2:]))), [300, 80, -10, 0, 0, 30]
elif kind == "ur":
    arm, away = UR(at[0]), [0, -500, 200, 0, 0, -160]
else:
    arm, away = Magician(at[0]), [200, 150, 30, 0, 0, 10]
arm.connect()
arm.enable()
arm.set_speed({slow}, 30)
arm.move_linear(np.array(away, float), wait=False)
print("moves", flush=True)
{end}
time.sleep(60)
"""


def emulated(kind):
    if kind == "ur":
        return UrEmulator(host=None)
    return Mg400Emulator(port_offset=None, faults=("one-client",)) if kind == "mg400" else MagicianEmulator()


def started(kind, emulator, end=""):
    """A program that has sent a long move."""
    places = {"ur": lambda: [emulator.host], "magician": lambda: [emulator.device]}
    at = places.get(kind, lambda: [str(emulator.ports[port]) for port in (29999, 30003, 30004, 30005)])()
    process = subprocess.Popen([sys.executable, "-c", MOVES.format(slow=SLOW_MM_S, end=end), kind, *at], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline().strip() == "moves"
    return process


@pytest.mark.parametrize("end", ["", "import os\nif os.fork() == 0: time.sleep(30)"], ids=["alone", "with a child"])
@pytest.mark.parametrize("kind", ["mg400", "magician", "ur"])
def test_a_killed_program_leaves_an_arm_that_stands(kind, end):
    with emulated(kind) as emulator, started(kind, emulator, end) as process:
        time.sleep(0.3)
        process.send_signal(signal.SIGKILL)
        process.wait()
        killed = emulator.pose()
        time.sleep(WITHIN_S)
        stands = emulator.pose()
        time.sleep(0.3)
        assert np.array_equal(emulator.pose(), stands)
        assert np.linalg.norm(stands[:3] - killed[:3]) <= SLOW_MM_S * WITHIN_S
        if kind != "magician":
            assert not emulator.arm.enabled and not emulator.arm.busy()


@pytest.mark.parametrize("kind", ["mg400", "magician", "ur"])
def test_a_program_that_ends_as_it_should_leaves_no_supervisor(kind):
    with emulated(kind) as emulator, started(kind, emulator, "arm.disable()\narm.disconnect()\nsys.exit()") as process:
        assert process.wait(timeout=10) == 0
        time.sleep(0.3)
        if kind != "magician":
            assert not (emulator._streams if kind == "ur" else any(server.clients for server in emulator._servers.values()))


def test_it_sends_nothing_when_it_is_ended_and_all_when_its_program_is_gone():
    ours, its = os.pipe()
    Supervisor(lambda: its, (b"stop",)).end()
    gone = f"import os; from hardware.arms.supervisor import Supervisor; Supervisor(lambda: {its}, (b'stop', b'off')); os._exit(0)"
    subprocess.run([sys.executable, "-c", gone], pass_fds=(its,), check=True)
    os.close(its)
    with os.fdopen(ours, "rb") as pipe:
        assert pipe.read() == b"stopoff"
