"""An arm that goes dead at a random moment: the driver ends with one clear error, soon, and hangs nowhere."""

import random
import time
from threading import Timer

import numpy as np
import pytest
from arms import bench

from hardware.errors import DeviceError

WITHIN_S = 4.0  # silence of a second, a reconnect refused, a loaded machine
KILL_WITHIN_S = 0.5


def survive(kind, seed):
    rng = random.Random(seed)
    with bench(kind, time_scale=1.0) as at:
        kill = at.device.kill if kind.startswith("mg400") else at.device.unplug
        timer = Timer(rng.uniform(0.0, KILL_WITHIN_S), kill)
        timer.start()
        begun = time.monotonic()
        with pytest.raises(DeviceError) as raised:
            at.arm.connect()
            at.arm.enable()
            while time.monotonic() - begun < 10.0:
                target = at.home + [0, rng.uniform(-30, 30), 0, 0, 0, 0]
                at.arm.move_linear(target, wait=rng.random() < 0.7)
        assert time.monotonic() - begun < KILL_WITHIN_S + WITHIN_S
        assert any(word in str(raised.value) for word in ("connect", "cable")), raised.value
        begun = time.monotonic()
        at.arm.disconnect()
        assert time.monotonic() - begun < WITHIN_S and not at.arm.is_connected
        with pytest.raises(DeviceError):
            at.arm.move_linear(np.zeros(6))
        timer.join()


@pytest.mark.parametrize("seed", range(7))
@pytest.mark.parametrize("kind", ["mg400", "mg400-old", "magician", "ur"])
def test_killed_at_a_random_moment(kind, seed):
    survive(kind, seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 167))
@pytest.mark.parametrize("kind", ["mg400", "mg400-old", "magician", "ur"])
def test_killed_at_many_random_moments(kind, seed):
    survive(kind, seed)


@pytest.mark.parametrize("kind", ["mg400", "mg400-old"])
def test_killed_while_it_is_enabled(kind, monkeypatch):
    with bench(kind, time_scale=1.0) as at:
        at.arm.connect()
        monkeypatch.setattr(at.arm, "_await_mode", lambda *_: at.device.kill() or at.arm._ask("RobotMode()"))
        with pytest.raises(DeviceError) as raised:
            at.arm.enable()
        assert "Press its emergency stop" in str(raised.value)
        at.arm.disconnect()  # says nothing more
        assert not at.arm.is_connected
