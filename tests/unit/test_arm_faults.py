"""The values that an emulator's faults may have: a bad one is refused when it is given, and not met when the device runs."""

import math
import socket

import numpy as np
import pytest

from hardware.emulators import camera, magician, mg400
from hardware.emulators.faults import Faults
from hardware.emulators.mg400 import Mg400Emulator
from twin.errors import TwinError

DEVICES = {"mg400": mg400, "magician": magician, "camera": camera}
VALUED = [(device, name) for device, module in DEVICES.items() for name, fault in module.FAULTS.items() if fault.allowed]


def given(device, text):
    module = DEVICES[device]
    faults = Faults(module.FAULTS)
    faults.add(text)
    return faults


@pytest.mark.parametrize(("device", "name"), VALUED)
def test_a_fault_takes_the_values_of_its_range_and_no_others(device, name):
    allowed = DEVICES[device].FAULTS[name].allowed
    for value in (DEVICES[device].FAULTS[name].default, allowed.low, allowed.high):
        assert given(device, f"{name}={value}").value(name) == value
    beyond = [math.nextafter(allowed.low, -math.inf), math.nextafter(allowed.high, math.inf), math.nan, math.inf, -math.inf, -1.0]
    for value in (*beyond, *([allowed.low + 0.5] if allowed.whole else [])):
        with pytest.raises(TwinError) as raised:
            given(device, f"{name}={value}")
        assert f"{name} must be {allowed}, not {value}" in str(raised.value)


@pytest.mark.parametrize(
    ("device", "text"),
    [
        *(("mg400", text) for text in ("short-packets=0", "wrong-test-value=0.5", "slow=0", "slow=-1", "slow=nan", "error-groups=-5")),
        *(("magician", text) for text in ("wrong-checksum=0", "lost-reply=0.5", "noise=-1", "split-frames=-1", "slow=0")),
        *(("mg400", "frozen=nan"), ("mg400", "die=1e300"), ("camera", "dropped=0"), ("camera", "late=-1")),
    ],
)
def test_these_once_killed_an_emulator_or_meant_nothing(device, text):
    with pytest.raises(TwinError, match="must be"):
        given(device, text)


def test_a_refused_value_leaves_the_faults_as_they_are():
    faults = given("mg400", "slow=0.5")
    with pytest.raises(TwinError):
        faults.add("slow=0")
    assert faults.value("slow") == 0.5


def test_a_switch_takes_no_value():
    assert "one-client" in given("mg400", "one-client")
    with pytest.raises(TwinError, match="takes no value; give one-client alone"):
        given("mg400", "one-client=2")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_client_is_hung_up_on_when_its_thread_fails(monkeypatch):
    def fail(arm):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(mg400, "feedback_packet", fail)
    with Mg400Emulator(port_offset=None) as emulator, socket.create_connection(("127.0.0.1", emulator.ports[30004]), timeout=5) as client:
        assert client.recv(1) == b"" and np.isfinite(emulator.pose()).all()
