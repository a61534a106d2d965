"""A stall of this program is no silence of the arm: a call that holds the interpreter's lock ends no healthy run."""

import ctypes
import threading
import time

import numpy as np
import pytest
from endurance import Child

from hardware.arms.awake import AwakeClock
from hardware.arms.magician import Magician
from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.errors import DeviceError
from hardware.safety.decide import SafetyLimits
from hardware.safety.eyes import ArmWatch
from hardware.safety.safe_arm import SafeArm

STALLS_S = (0.5, 0.5, 1.2)  # the last is longer than feedback may be old
NOTICED_S = 1.5
FREE = SafetyLimits(box_mm=((-2000, 2000),) * 3)
EMULATED = """
import sys
from hardware.emulators.{module} import {name}
with {name}({options}) as arm:
    print("ready", {where}, flush=True)
    for line in sys.stdin:
        arm.faults.add(line.strip())
"""


def hold_the_lock(seconds):
    """As a library's call does that does not release it."""
    ctypes.PyDLL(None).usleep(int(seconds * 1e6))


@pytest.fixture(params=["mg400", "magician"])
def emulated(request):
    """An arm whose emulator runs in another process, the fault with which it falls silent, and a way to make."""
    if request.param == "mg400":
        child = Child(EMULATED.format(module="mg400", name="Mg400Emulator", options="port_offset=None", where="*arm.ports.values()"))
        dashboard, motion, *feedback = (int(port) for port in child.answer.split()[1:])
        arm = MG400("127.0.0.1", ports=Mg400Ports(dashboard, motion, tuple(feedback)))
        home, silent = [300.0, 0, 0, 0, 0, 0], "silent-feedback=0"
    else:
        child = Child(EMULATED.format(module="magician", name="MagicianEmulator", options="", where="arm.device"))
        arm, home, silent = Magician(child.answer.split()[1]), [200.0, 0, 30, 0, 0, 0], "mute"
    try:
        with SafeArm(arm, FREE) as safe:
            safe.enable()
            yield safe, np.array(home), child, silent
    except DeviceError:
        pass  # an arm that fell silent can't be let go
    finally:
        child.kill()


def test_a_stall_is_no_silence_and_silence_is_noticed(emulated):
    arm, home, child, silent = emulated
    watch = ArmWatch(arm, report=lambda line: None)
    with watch.watching():
        arm.set_speed(50.0, 50.0)
        arm.move_linear(home)
        for n, stall_s in enumerate(STALLS_S):
            threading.Timer(0.2, hold_the_lock, (stall_s,)).start()
            for y_mm in (30.0, -30.0):
                arm.move_linear(home + [0, y_mm * (-1) ** n, 0, 0, 0, 0], timeout_s=20.0)
            watch.require()
        child.say(silent)
        begun_s = time.monotonic()
        with pytest.raises(DeviceError):
            while time.monotonic() - begun_s < 5.0:
                watch.require()
                time.sleep(0.01)
        noticed_s = time.monotonic() - begun_s
        assert noticed_s < NOTICED_S, noticed_s


def test_the_clock_leaves_out_stalls_and_counts_the_rest():
    clock = AwakeClock()
    begun_s, awake_s = time.monotonic(), clock()
    time.sleep(0.3)
    hold_the_lock(0.7)
    time.sleep(0.1)
    spent_s = time.monotonic() - begun_s
    assert spent_s >= 1.1 and 0.2 < clock() - awake_s < spent_s - 0.5
